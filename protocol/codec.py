"""Packets to bytes and back: the hot path, held against `protocol.layouts` by a property test.

`decode` takes any bytes whatever and either returns a packet or raises RemoteProtocolError; for a
frame that it accepts, encoding the result gives the same frame again.
"""

import math
import struct
from dataclasses import replace

import numpy as np

from protocol.crc import crc32c, with_crc
from protocol.errors import LocalProtocolError, RemoteProtocolError
from protocol.packets import (
    BODY_BYTES,
    CRC_BYTES,
    HEADER_BYTES,
    OPAQUE,
    POINTS_PER_FRAGMENT,
    POINTS_PER_SEALED_FRAGMENT,
    SEAL_BYTES,
    SEALED,
    SIZE_BYTES,
    STATES_PER_FRAGMENT,
    VERSION,
    Answer,
    Array32,
    ExtendedAnswer,
    Header,
    Packet,
    Profile,
    SealedFrame,
    SubmapFragment,
    SubmapPacket,
    TrajectoryPacket,
)

SMALLEST_BYTES = HEADER_BYTES + CRC_BYTES
_WIRE_FLOAT = np.dtype(">f4")
_ANSWER = struct.Struct(">Hff")
_EXTENDED_ANSWER = struct.Struct(">HffffffHH")
_COUNTER = struct.Struct(">I")
_PROFILES = {int(profile): (profile, size) for profile, size in SIZE_BYTES.items()}
_UNKNOWN = (None, 0)
_STATE_BYTES = 12


def encode(packet: Packet) -> bytes:
    """Return the frame of a packet.

    Raises
    ------
    LocalProtocolError
        When the packet's content does not fit its profile: a bug on this side.
    """
    header = packet.header
    body = encode_body(packet)
    if len(body) != BODY_BYTES[header.profile]:
        raise LocalProtocolError(
            f"a {header.profile.name} body has {BODY_BYTES[header.profile]} bytes, not {len(body)}"
        )
    if isinstance(packet, SealedFrame):
        body += _COUNTER.pack(packet.counter) + packet.tag
    if len(body) != SIZE_BYTES[header.profile] - HEADER_BYTES - CRC_BYTES:
        raise LocalProtocolError(f"only a sealed frame is sent as {header.profile.name}")
    return with_crc(encode_header(header) + body)


def decode(frame: bytes) -> Packet:
    """Return the packet in a frame; sealed ones come back as SealedFrame, not yet verified.

    Raises
    ------
    RemoteProtocolError
        For anything that is not exactly a frame of this version; its `cause` is size, crc,
        version, profile or layout.
    """
    size = len(frame)
    if size < SMALLEST_BYTES:
        raise RemoteProtocolError(
            f"{size} bytes: the smallest frame has {SMALLEST_BYTES}", cause="size"
        )
    word = int.from_bytes(frame[:HEADER_BYTES], "big")
    profile, right_size = _PROFILES.get(word >> 56 & 31, _UNKNOWN)
    found = int.from_bytes(frame[-CRC_BYTES:], "little")
    if found != crc32c(frame[:-CRC_BYTES]):
        raise _damaged(frame, word, profile)
    if word >> 61 != VERSION:
        raise RemoteProtocolError(
            f"version {word >> 61} from vehicle {word >> 52 & 15}: this side speaks version"
            f" {VERSION}; bring both vehicles to one release",
            cause="version",
        )
    if profile is None:
        raise RemoteProtocolError(f"profile {word >> 56 & 31} is not in WIRE.md", cause="profile")
    if size != right_size:
        raise RemoteProtocolError(f"{size} bytes: {profile.name} has {right_size}", cause="size")
    return _read(_header(word, profile), frame)


def encode_header(header: Header) -> bytes:
    """Return the eight bytes of a header."""
    word = (
        header.version << 61
        | header.profile << 56
        | header.vehicle << 52
        | header.boot_epoch << 48
        | header.submap << 32
        | header.fragment << 28
        | header.fragment_count << 24
        | header.tx_second << 20
        | header.time_quarters
    )
    return word.to_bytes(HEADER_BYTES, "big")


def restamp(frame: bytes, tx_second: int) -> bytes:
    """Return a plain frame as sent again at another second: only that and the CRC change."""
    packet = decode(frame)
    if isinstance(packet, SealedFrame):
        raise LocalProtocolError("a sealed frame is sealed again, never restamped")
    return encode(replace(packet, header=replace(packet.header, tx_second=tx_second)))


def encode_body(packet: Packet) -> bytes:
    """Return the bytes between header and CRC (or seal), in the packet's own profile."""
    plain = packet.header.profile.plain
    if isinstance(packet, SubmapFragment | SealedFrame):
        return packet.body
    try:
        if isinstance(packet, SubmapPacket) and plain is Profile.SUBMAP_PAPER:
            is_sealed = packet.header.profile.is_sealed
            points = POINTS_PER_SEALED_FRAGMENT if is_sealed else POINTS_PER_FRAGMENT
            return (
                _floats(packet.trajectory, (STATES_PER_FRAGMENT, 3))
                + _floats(packet.points_ned_m, (points, 3))
                + _floats(packet.hyperparameters, (4,))
            )
        if isinstance(packet, TrajectoryPacket) and plain in _TRAJECTORIES:
            size = BODY_BYTES[packet.header.profile]
            return _floats(packet.states, (size // _STATE_BYTES, 3)) + bytes(size % _STATE_BYTES)
        if isinstance(packet, Answer) and plain is Profile.ANSWER:
            return _ANSWER.pack(packet.submap, packet.north_m, packet.east_m)
        if isinstance(packet, ExtendedAnswer) and plain is Profile.ANSWER_EXTENDED:
            return _EXTENDED_ANSWER.pack(
                packet.submap,
                packet.north_m,
                packet.east_m,
                packet.variance_m2,
                packet.leader_north_m,
                packet.leader_east_m,
                packet.leader_variance_m2,
                packet.repeat_submap,
                packet.missing_fragments,
            )
    except (struct.error, OverflowError) as error:
        raise LocalProtocolError(f"{packet} does not fit its fields: {error}") from error
    raise LocalProtocolError(f"{type(packet).__name__} cannot have profile {plain.name}")


def decode_body(header: Header, body: bytes) -> Packet:
    """Return the packet of a header and a body, as long as that profile's is, sealed or not.

    Raises
    ------
    RemoteProtocolError
        For a fragment outside its count, reserved bytes that are not zero, and an answer whose
        position is not finite or whose variance is negative or NaN (infinite means unknown).
    """
    plain = header.profile & ~SEALED
    if plain == Profile.ANSWER:
        return _answer(header, body)
    if plain == Profile.ANSWER_EXTENDED:
        return _extended_answer(header, body)
    if header.fragment >= header.fragment_count:
        raise RemoteProtocolError(
            f"fragment {header.fragment} of {header.fragment_count} in submap {header.submap}"
        )
    if plain == Profile.SUBMAP_PAPER:
        return _submap(header, body)
    if plain in OPAQUE:
        return SubmapFragment(header=header, body=body)
    return _trajectory(header, body)


_TRAJECTORIES = (Profile.TRAJECTORY, Profile.TRAJECTORY_SMALL)


def _header(word: int, profile: Profile) -> Header:
    return Header(
        profile=profile,
        vehicle=word >> 52 & 15,
        boot_epoch=word >> 48 & 15,
        submap=word >> 32 & 0xFFFF,
        fragment=word >> 28 & 15,
        fragment_count=word >> 24 & 15,
        tx_second=word >> 20 & 15,
        time_quarters=word & 0xFFFFF,
        version=word >> 61,
    )


def _read(header: Header, frame: bytes) -> Packet:
    if not header.profile.is_sealed:
        return decode_body(header, frame[HEADER_BYTES:-CRC_BYTES])
    seal = len(frame) - CRC_BYTES - SEAL_BYTES
    return SealedFrame(
        header=header,
        body=frame[HEADER_BYTES:seal],
        counter=_COUNTER.unpack_from(frame, seal)[0],
        tag=frame[seal + _COUNTER.size : -CRC_BYTES],
    )


def _submap(header: Header, body: bytes) -> SubmapPacket:
    values = np.frombuffer(body, _WIRE_FLOAT).astype(np.float32)
    values.setflags(write=False)
    return SubmapPacket(
        header=header,
        trajectory=values[:12].reshape(4, 3),
        points_ned_m=values[12:-4].reshape(-1, 3),
        hyperparameters=values[-4:],
    )


def _trajectory(header: Header, body: bytes) -> TrajectoryPacket:
    used = len(body) // _STATE_BYTES * _STATE_BYTES
    if any(body[used:]):
        raise RemoteProtocolError(f"reserved bytes of {header.profile.name} are not zero")
    states = np.frombuffer(body[:used], _WIRE_FLOAT).astype(np.float32)
    states.setflags(write=False)
    return TrajectoryPacket(header=header, states=states.reshape(-1, 3))


def _answer(header: Header, body: bytes) -> Answer:
    submap, north_m, east_m = _ANSWER.unpack(body)
    _require_finite(north_m, east_m)
    return Answer(header=header, submap=submap, north_m=north_m, east_m=east_m)


def _extended_answer(header: Header, body: bytes) -> ExtendedAnswer:
    values = _EXTENDED_ANSWER.unpack(body)
    _require_finite(values[1], values[2], values[4], values[5])
    if not (values[3] >= 0.0 and values[6] >= 0.0):
        raise RemoteProtocolError(f"variances {values[3]} and {values[6]} m2 in an answer")
    return ExtendedAnswer(
        header=header,
        submap=values[0],
        north_m=values[1],
        east_m=values[2],
        variance_m2=values[3],
        leader_north_m=values[4],
        leader_east_m=values[5],
        leader_variance_m2=values[6],
        repeat_submap=values[7],
        missing_fragments=values[8],
    )


def _require_finite(*positions_m: float) -> None:
    if not all(map(math.isfinite, positions_m)):
        raise RemoteProtocolError(f"position {positions_m} m in an answer is not finite")


def _floats(values: Array32, shape: tuple[int, ...]) -> bytes:
    if values.shape != shape:
        raise LocalProtocolError(f"an array of shape {values.shape} where the frame has {shape}")
    return np.asarray(values, dtype=np.float32).astype(_WIRE_FLOAT).tobytes()


def _damaged(frame: bytes, word: int, profile: Profile | None) -> RemoteProtocolError:
    """Return the error for a wrong CRC, with what the header claims as a place to look."""
    found = int.from_bytes(frame[-CRC_BYTES:], "little")
    expected = crc32c(frame[:-CRC_BYTES])
    name = "an unknown profile" if profile is None else profile.name
    size = ""
    if profile is not None and len(frame) != SIZE_BYTES[profile]:
        size = f" ({len(frame)} bytes, {name} has {SIZE_BYTES[profile]})"
    return RemoteProtocolError(
        f"{name}, vehicle {word >> 52 & 15}, fragment {word >> 28 & 15} of submap"
        f" {word >> 32 & 0xFFFF}{size}: CRC {found:#010x}, expected {expected:#010x}",
        cause="crc",
    )
