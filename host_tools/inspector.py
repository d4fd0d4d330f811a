"""`fathomlink inspect FILE`: what the frames of a file say, one line each."""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from host_tools.capture import LATEST_S, Captured, write_pcap
from host_tools.commands import Command, check_apart
from protocol.codec import decode
from protocol.errors import ConfigError, RemoteProtocolError
from protocol.packets import (
    SIZE_BYTES,
    Answer,
    ExtendedAnswer,
    Packet,
    Profile,
    SealedFrame,
    SubmapFragment,
    SubmapPacket,
    TrajectoryPacket,
    usable_points,
    usable_states,
)

SIZES = {int(profile): size for profile, size in SIZE_BYTES.items()}


def read_frames(path: Path) -> Iterator[tuple[str, Captured]]:
    """Yield where it stands and the frame, of an air.jsonl or of a file of frames back to back.

    Bytes of such a file that are no frame come as a piece of their own. Frames of a file without
    times are given a second each.

    Raises
    ------
    ConfigError
        When the file cannot be read, or is no air.jsonl, which may be empty, and holds no whole
        frame.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from error
    if not data and path.suffix == ".jsonl":
        return  # a mission of one vehicle
    if not data:
        raise ConfigError(f"{path} is empty; give a file of frames or an air.jsonl")
    if data.lstrip()[:1] == b"{":
        yield from _read_air(path, data)
    else:
        pieces = list(_split(data))
        if not any(_decodes(piece) for _, piece in pieces):
            raise ConfigError(
                f"{path} holds no whole frame; give frames back to back, or an air.jsonl"
            )
        for second, (offset, piece) in enumerate(pieces):
            yield f"{offset:8d}", Captured(time_s=float(second), frame=piece)


def inspect_file(path: Path) -> Iterator[str]:
    """Yield one line for every frame of a file; raises as `read_frames` does."""
    for place, captured in read_frames(path):
        if captured.source is None and not _decodes(captured.frame):
            yield f"{place}  {len(captured.frame)} bytes that are no frame"
        else:
            yield f"{place}  {describe(captured.frame)}"


def _read_air(path: Path, data: bytes) -> Iterator[tuple[str, Captured]]:
    for number, line in enumerate(data.splitlines(), start=1):
        try:
            record = json.loads(line)
            captured = Captured(
                time_s=float(record["t_tx_s"] if record["t_rx_s"] is None else record["t_rx_s"]),
                frame=bytes.fromhex(record["hex"]),
                source=int(record["source"]),
                destination=int(record["destination"]),
                fate=str(record["fate"]),
            )
            if not 0.0 <= captured.time_s < LATEST_S:
                raise ValueError(f"a frame at {captured.time_s:g} s")
            head = (
                f"{record['t_tx_s']:10.3f} s  {record['source']} -> {record['destination']}"
                f"  {record['fate']:<11}"
            )
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            raise ConfigError(
                f"{path}, line {number}: not a line of air.jsonl ({error})"
            ) from error
        yield head, captured


def _split(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield offset and frame; after damage, look for the next byte at which a frame decodes."""
    offset = begun = 0
    while offset < len(data):
        size = SIZES.get(data[offset] & 31, 0)
        frame = data[offset : offset + size]
        if size and len(frame) == size and _decodes(frame):
            if begun < offset:
                yield begun, data[begun:offset]
            yield offset, frame
            offset += size
            begun = offset
        else:
            offset += 1
    if begun < offset:
        yield begun, data[begun:offset]


def _decodes(frame: bytes) -> bool:
    try:
        decode(frame)
    except RemoteProtocolError:
        return False
    return True


def describe(frame: bytes) -> str:
    """Return a line on what a frame holds, or why it would be dropped."""
    try:
        packet = decode(frame)
    except RemoteProtocolError as error:
        return f"{len(frame)} bytes, dropped: {error}"
    header = packet.header
    name = Profile(header.profile).name.lower().replace("_", " ")
    sender = f"vehicle {header.vehicle} epoch {header.boot_epoch}"
    part = f"submap {header.submap} fragment {header.fragment}/{header.fragment_count}  "
    part = part if "submap" in name else ""  # in others these fields mean something else
    when = f"t {header.time_quarters / 4:.2f} s, sent at second {header.tx_second} of 16"
    return f"{name:<16} {sender}  {part}{when}  {_content(packet)}"


def _content(packet: Packet) -> str:
    match packet:
        case SubmapPacket():
            states = int(usable_states(packet.trajectory).sum())
            points = int(usable_points(packet.points_ned_m).sum())
            b, c, sigma2_m2, mean_m = (float(value) for value in packet.hyperparameters)
            return (
                f"{states} states, {points} points, b {b:.4g}, c {c:.4g}, "
                f"sigma2 {sigma2_m2:.4g} m2, mean depth {mean_m:.2f} m"
            )
        case TrajectoryPacket():
            good = usable_states(packet.states)
            if not good.any():
                return "no states"
            last = packet.states[np.flatnonzero(good)[-1]]
            return f"{int(good.sum())} states to north {last[0]:.1f} m, east {last[1]:.1f} m"
        case Answer() | ExtendedAnswer():
            return (
                f"to vehicle {packet.to_vehicle} epoch {packet.to_boot_epoch}, "
                f"submap {packet.submap}: "
                f"north {packet.north_m:.1f} m, east {packet.east_m:.1f} m"
            )
        case SubmapFragment():
            return f"{len(packet.body)} bytes of body"
        case SealedFrame():
            return f"sealed, counter {packet.counter}"


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, metavar="FILE", help="frames back to back, or air.jsonl")
    parser.add_argument(
        "--pcap",
        type=Path,
        metavar="OUT",
        help="write a capture for Wireshark and tshark instead (-X lua_script:fathomlink.lua)",
    )


def _run(arguments: argparse.Namespace) -> None:
    if arguments.pcap is not None:
        check_apart(arguments.file, arguments.pcap)
        print(f"{write_capture(arguments.file, arguments.pcap)} frames in {arguments.pcap}")
        return
    for line in inspect_file(arguments.file):
        print(line)


def write_capture(path: Path, out: Path) -> int:
    """Write the frames of a file as a capture; return how many.

    Raises
    ------
    ConfigError
        As `read_frames` does, and when the capture cannot be written.
    """
    frames = [captured for _, captured in read_frames(path)]
    try:
        with out.open("wb") as stream:
            return write_pcap(stream, frames)
    except OSError as error:
        raise ConfigError(f"cannot write {out}: {error.strerror}") from error


COMMAND = Command(name="inspect", help="print what frames hold", configure=_configure, run=_run)
