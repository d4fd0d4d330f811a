"""The golden vectors: examples of every frame, and of what is rejected, for other decoders.

`python -m protocol.vectors tests/vectors` writes them again; a test holds the files to this module,
so a changed byte shows as a changed file, a new version and a line in the changelog.
"""

import json
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from protocol.codec import encode
from protocol.crc import crc32c, with_crc
from protocol.framing import wrap
from protocol.layouts import fingerprint
from protocol.packets import (
    VERSION,
    Answer,
    Array32,
    ExtendedAnswer,
    Header,
    Packet,
    Profile,
    SubmapFragment,
    SubmapPacket,
    TrajectoryPacket,
)
from protocol.seal import Keys, Sealer


def _header(profile: Profile, **changes: int) -> Header:
    header = Header(
        profile=profile,
        vehicle=2,
        boot_epoch=5,
        submap=0x1234,
        fragment=7,
        fragment_count=10,
        tx_second=12,
        time_quarters=0xABCDE,
    )
    return replace(header, **cast(dict[str, Any], changes))


def _ramp(rows: int, columns: int, start: float) -> Array32:
    values = start + 0.25 * np.arange(rows * columns, dtype=np.float32)
    return cast(Array32, values.astype(np.float32).reshape(rows, columns))


def _paper_packets() -> dict[str, Packet]:
    paper = SubmapPacket(
        header=_header(Profile.SUBMAP_PAPER),
        trajectory=_ramp(4, 3, -100.0),
        points_ned_m=_ramp(15, 3, 40.0),
        hyperparameters=np.array([0.02, 6.5, 0.0225, 47.3], np.float32),
    )
    unused = paper.trajectory.copy()
    unused[2:] = np.nan
    absurd = paper.points_ned_m.copy()
    absurd[0] = (np.inf, -np.inf, np.nan)
    absurd[1] = (3.0e38, -3.0e38, 1.0e-45)
    return {
        "paper": paper,
        "paper, two states unused": replace(paper, trajectory=unused),
        "paper, absurd values pass the codec": replace(paper, points_ned_m=absurd),
        "paper, all fields at their largest": replace(
            paper,
            header=_header(
                Profile.SUBMAP_PAPER,
                vehicle=15,
                boot_epoch=15,
                submap=0xFFFF,
                fragment=14,
                fragment_count=15,
                tx_second=15,
                time_quarters=0xFFFFF,
            ),
        ),
    }


def packets() -> dict[str, Packet]:
    """Return one packet or more of every plain profile, by the name of its vector."""
    single = {"fragment": 0, "fragment_count": 1}
    answer = Answer(
        header=_header(Profile.ANSWER, vehicle=0, boot_epoch=1, fragment=2, fragment_count=5),
        submap=0x1234,
        north_m=123.5,
        east_m=-4567.25,
    )
    body = bytes(range(244))
    return {
        **_paper_packets(),
        "answer": answer,
        "answer to a vehicle 0 in epoch 0": replace(
            answer, header=_header(Profile.ANSWER, fragment=0, fragment_count=0)
        ),
        "trajectory": TrajectoryPacket(
            header=_header(Profile.TRAJECTORY, **single), states=_ramp(20, 3, 7.0)
        ),
        "dense": SubmapFragment(header=_header(Profile.SUBMAP_DENSE), body=body),
        "lattice": SubmapFragment(header=_header(Profile.SUBMAP_LATTICE), body=body[::-1]),
        "lattice, small": SubmapFragment(
            header=_header(Profile.SUBMAP_LATTICE_SMALL), body=body[:50]
        ),
        "extended answer": ExtendedAnswer(
            header=replace(answer.header, profile=Profile.ANSWER_EXTENDED),
            submap=answer.submap,
            north_m=answer.north_m,
            east_m=answer.east_m,
            variance_m2=2.25,
            leader_north_m=-31.125,
            leader_east_m=99.0,
            leader_variance_m2=float("inf"),
            repeat_submap=0x1233,
            missing_fragments=0b0000_0010_0000_0101,
        ),
        "trajectory, small": TrajectoryPacket(
            header=_header(Profile.TRAJECTORY_SMALL, **single), states=_ramp(4, 3, 7.0)
        ),
    }


SEAL_KEY = bytes(range(32))
SEAL_COUNTER = 0x01020304


class _OneCounter:
    """Seals every vector with the same number, which a vehicle would never do."""

    def next(self) -> int:
        return SEAL_COUNTER


def sealed() -> dict[str, tuple[bytes, Packet]]:
    """Return frames sealed by BLAKE2s with the packet that they open to."""
    sealer = Sealer(Keys(SEAL_KEY), _OneCounter())
    found = {}
    for name, packet in packets().items():
        if isinstance(packet, SubmapPacket):
            packet = replace(packet, points_ned_m=packet.points_ned_m[:14])  # noqa: PLW2901
        elif isinstance(packet, TrajectoryPacket):
            packet = replace(packet, states=packet.states[:-1])  # noqa: PLW2901
        elif isinstance(packet, SubmapFragment):
            packet = replace(packet, body=packet.body[:-12])  # noqa: PLW2901
        found[f"{name}, sealed"] = sealer.seal(packet), packet
    return found


def rejects() -> dict[str, tuple[bytes, str]]:
    """Return bytes that are no frame, with the cause of rejection, by the name of the vector."""
    known = packets()
    paper = encode(known["paper"])
    answer = encode(known["answer"])[:-4]
    trajectory = encode(known["trajectory"])[:-4]
    extended = encode(known["extended answer"])[:-4]
    nan, minus_one = b"\x7f\xc0\x00\x00", b"\xbf\x80\x00\x00"
    big_endian = paper[:-4] + crc32c(paper[:-4]).to_bytes(4, "big")
    return {
        "nothing": (b"", "size"),
        "eleven zeros": (bytes(11), "size"),
        "twelve zeros": (bytes(12), "crc"),
        "one bit turned in the first byte": (bytes([paper[0] ^ 1]) + paper[1:], "crc"),
        "one bit turned in the CRC": (paper[:-1] + bytes([paper[-1] ^ 128]), "crc"),
        "truncated by one byte": (paper[:-1], "crc"),
        "one byte too many": (paper + b"\x00", "crc"),
        "CRC in the wrong byte order": (big_endian, "crc"),
        "version 0": (with_crc(bytes([paper[0] & 31]) + paper[1:-4]), "version"),
        "version 2": (with_crc(bytes([2 << 5 | paper[0] & 31]) + paper[1:-4]), "version"),
        "profile 0": (with_crc(bytes([VERSION << 5]) + paper[1:-4]), "profile"),
        "profile 31": (with_crc(bytes([VERSION << 5 | 31]) + paper[1:-4]), "profile"),
        "an answer as long as a sub-map": (with_crc(answer + bytes(234)), "size"),
        "a sub-map as short as an answer": (with_crc(paper[:18]), "size"),
        "fragment 10 of 10": (with_crc(paper[:4] + b"\xaa" + paper[5:-4]), "layout"),
        "fragment 0 of 0": (with_crc(paper[:4] + b"\x00" + paper[5:-4]), "layout"),
        "reserved byte set": (with_crc(trajectory[:-1] + b"\x01"), "layout"),
        "answer at no position": (with_crc(answer[:-4] + nan), "layout"),
        "negative variance": (with_crc(extended[:18] + minus_one + extended[22:]), "layout"),
    }


def line() -> dict[str, tuple[bytes, list[bytes]]]:
    """Return bytes of a raw serial line and the frames in them, by the name of the vector."""
    one, two = b"\x00\x01\x00\xff", bytes(range(256))
    return {
        "two frames": (wrap(one) + wrap(two), [one, two]),
        "delimiters shared": (wrap(one)[:-1] + wrap(two), [one, two]),
        "text before a frame": (b"boot 1.2\r\n" + wrap(one), [one]),
        "half a frame, then a whole one": (wrap(two)[:100] + wrap(one), [one]),
        "600 bytes without delimiter": (b"\x55" * 600 + wrap(one), [one]),
        "254 bytes without zero": (wrap(b"\x01" * 254), [b"\x01" * 254]),
    }


def frames_document() -> dict[str, object]:
    """Return the vectors of the codec as they stand in frames.json."""
    return {
        "version": VERSION,
        "fingerprint": fingerprint(),
        "accepted": [
            {"name": name, "hex": encode(packet).hex(), "fields": packet_fields(packet)}
            for name, packet in packets().items()
        ],
        "rejected": [
            {"name": name, "hex": data.hex(), "cause": cause}
            for name, (data, cause) in rejects().items()
        ],
    }


def seal_document() -> dict[str, object]:
    """Return the vectors of sealed frames as they stand in seal.json."""
    return {
        "key": SEAL_KEY.hex(),
        "counter": SEAL_COUNTER,
        "accepted": [
            {"name": name, "hex": frame.hex(), "opened": packet_fields(packet)}
            for name, (frame, packet) in sealed().items()
        ],
    }


def line_document() -> dict[str, object]:
    """Return the vectors of the serial framing as they stand in line.json."""
    return {
        "vectors": [
            {"name": name, "hex": data.hex(), "frames": [frame.hex() for frame in frames]}
            for name, (data, frames) in line().items()
        ]
    }


def packet_fields(packet: Packet) -> dict[str, object]:
    """Return a packet's fields as JSON can hold them; NaN and infinities as text."""
    found: dict[str, object] = {}
    for field in fields(packet):
        value = getattr(packet, field.name)
        if isinstance(value, Header):
            found |= {f.name: getattr(value, f.name) for f in fields(Header)}
        elif isinstance(value, np.ndarray):
            found[field.name] = [_json_float(float(x)) for x in value.ravel()]
        elif isinstance(value, bytes):
            found[field.name] = value.hex()
        else:
            found[field.name] = _json_float(value) if isinstance(value, float) else value
    return found


def _json_float(value: float) -> float | str:
    return value if np.isfinite(value) else str(value)


def main(arguments: list[str]) -> None:
    """Write all vector files into the folder given."""
    folder = Path(arguments[0])
    documents = {"frames": frames_document(), "line": line_document(), "seal": seal_document()}
    for name, document in documents.items():
        (folder / f"{name}.json").write_text(json.dumps(document, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
