"""The wire in construct: the readable truth that the codec is held against.

The table in HEADER_FIELDS and BODIES also makes the fingerprint of the version, the C header and
the test of WIRE.md. The CRC is a plain field, checked outside.
"""

import hashlib
from collections.abc import Iterator

import construct as c

from protocol.packets import BODY_BYTES, SIZE_BYTES, Profile

HEADER_FIELDS: tuple[tuple[str, int], ...] = (
    ("version", 3),
    ("profile", 5),
    ("vehicle", 4),
    ("boot_epoch", 4),
    ("submap", 16),
    ("fragment", 4),
    ("fragment_count", 4),
    ("tx_second", 4),
    ("time_quarters", 20),
)
"""Name and bits, the most significant bit of the first byte first."""

BodyTable = tuple[tuple[str, str, int], ...]
"""Rows of (name, type, repetitions); types: f4 and u2 big-endian, byte, zero (reserved)."""


def _trajectory(states: int, spare: int) -> BodyTable:
    return ("states", "f4", 3 * states), ("reserved", "zero", spare)


def _paper(points: int) -> BodyTable:
    return (
        ("trajectory", "f4", 12),
        ("points_ned_m", "f4", 3 * points),
        ("hyperparameters", "f4", 4),
    )


_ANSWER: BodyTable = (("submap", "u2", 1), ("north_m", "f4", 1), ("east_m", "f4", 1))
_EXTENDED: BodyTable = (
    *_ANSWER,
    ("variance_m2", "f4", 1),
    ("leader_north_m", "f4", 1),
    ("leader_east_m", "f4", 1),
    ("leader_variance_m2", "f4", 1),
    ("repeat_submap", "u2", 1),
    ("missing_fragments", "u2", 1),
)

BODIES: dict[Profile, BodyTable] = {
    Profile.SUBMAP_PAPER: _paper(15),
    Profile.ANSWER: _ANSWER,
    Profile.TRAJECTORY: _trajectory(20, 4),
    Profile.ANSWER_EXTENDED: _EXTENDED,
    Profile.TRAJECTORY_SMALL: _trajectory(4, 2),
    Profile.SEALED_SUBMAP_PAPER: _paper(14),
    Profile.SEALED_ANSWER: _ANSWER,
    Profile.SEALED_TRAJECTORY: _trajectory(19, 4),
    Profile.SEALED_ANSWER_EXTENDED: _EXTENDED,
    Profile.SEALED_TRAJECTORY_SMALL: _trajectory(3, 2),
}
"""Every other profile has one row: its body as bytes, read by `firmware.compression`."""

_TYPES = {"f4": c.Float32b, "u2": c.Int16ub, "byte": c.Byte, "zero": c.Const(0, c.Byte)}
_SIZES = {"f4": 4, "u2": 2, "byte": 1, "zero": 1}

HEADER = c.BitStruct(*(name / c.BitsInteger(bits) for name, bits in HEADER_FIELDS))
SEAL = c.Struct("counter" / c.Int32ub, "tag" / c.Bytes(8))
CRC = c.Int32ul


def body_table(profile: Profile) -> BodyTable:
    """Return the rows of a profile's body."""
    return BODIES.get(profile, (("body", "byte", BODY_BYTES[profile]),))


def placed_fields(profile: Profile) -> Iterator[tuple[int, int, str, str, int]]:
    """Yield (offset, bytes, name, type, repetitions) of a body's rows."""
    offset = 0
    for name, kind, count in body_table(profile):
        size = _SIZES[kind] * count
        yield offset, size, name, kind, count
        offset += size


def frame_layout(profile: Profile) -> c.Struct:
    """Return the construct of a whole frame: header, the body's fields, seal if any, crc."""
    fields = [name / _field(kind, count) for name, kind, count in body_table(profile)]
    seal = ["seal" / SEAL] if profile.is_sealed else []
    return c.Struct("header" / HEADER, *fields, *seal, "crc" / CRC)


def _field(kind: str, count: int) -> c.Construct:
    if kind == "byte":
        return c.Bytes(count)
    return _TYPES[kind] if count == 1 else c.Array(count, _TYPES[kind])


FRAMES: dict[Profile, c.Struct] = {profile: frame_layout(profile) for profile in Profile}


def fingerprint() -> str:
    """Return 16 hex digits that change with any field, type, order or size of the layout."""
    table = [
        (int(profile), profile.name, SIZE_BYTES[profile], body_table(profile))
        for profile in Profile
    ]
    text = repr((HEADER_FIELDS, table, "crc32c little-endian"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]
