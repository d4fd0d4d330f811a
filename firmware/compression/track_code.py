"""A sub-map's whole trajectory in some twenty bytes, so that every frame can carry it.

Layout, big-endian: states - 1 (1 byte), degrees of position and yaw (two nibbles), north and east
of the fit's first term in quarter metres (2 x 3 bytes, signed), then for each further Chebyshev
term north and east in 1/16 m (2 x 2 bytes, signed), then the yaw terms: the first in 1/65536 turns
(2 bytes), the others in 1/512 turns (1 byte each, signed), or in 1/128 turns where 8 is added to
the degree of yaw: a vehicle that circles. States are one a second from the header's time; yaw is
unwrapped.
"""

import numpy as np
from numpy.polynomial import chebyshev

from firmware.geometry import Array, wrap_angle
from firmware.submaps import Track
from protocol.errors import LocalProtocolError, RemoteProtocolError

USUAL_TRACK_BYTES = 20  # a straight track takes 15, a turn some more
_FINE_M = 1.0 / 16.0
_COARSE_M = 0.25
_TURN_FIRST, _TURN_REST, _TURN_CIRCLING = 2.0 * np.pi / np.array([65536.0, 512.0, 128.0])
_CIRCLES = 8  # added to the degree of yaw
_GOOD_ENOUGH_M = 0.4  # dead reckoning itself wanders by 0.2 m in a second
_GOOD_ENOUGH_RAD = 0.03
_MAX_DEGREE = 7
_MAX_STATES = 256


def encode_track(track: Track, most_bytes: int = 45) -> bytes:
    """Return the bytes of a track of one state a second; missing seconds are interpolated.

    In few bytes a turn is smoothed; a straight track takes 15. Raises LocalProtocolError for a
    track that is no sub-map's.
    """
    if not track.time_s.size:
        return bytes([0, 0]) + bytes(6) + bytes(2)
    seconds = track.time_s - track.time_s[0]
    count = min(round(float(seconds[-1])) + 1, _MAX_STATES)
    at = np.arange(count, dtype=np.float64)
    position_m = np.column_stack(
        [np.interp(at, seconds, track.north_m), np.interp(at, seconds, track.east_m)]
    )
    yaw_rad = np.interp(at, seconds, np.unwrap(track.yaw_rad))
    where = _places(count)
    position = _fitted(where, position_m, _GOOD_ENOUGH_M, (most_bytes - 11) // 4)
    left_bytes = most_bytes - 10 - 4 * (len(position) - 1)
    yaw = _fitted(where, yaw_rad[:, None], _GOOD_ENOUGH_RAD, left_bytes)
    mean = _whole(position[0] / _COARSE_M, 24)
    terms = _whole(position[1:] / _FINE_M, 16)
    turns = int(np.round(yaw[0, 0] / _TURN_FIRST)) & 0xFFFF
    circles = _CIRCLES if np.abs(yaw[1:]).max(initial=0.0) > 127 * _TURN_REST else 0
    rest = np.round(yaw[1:, 0] / (_TURN_CIRCLING if circles else _TURN_REST))
    rest = np.clip(rest, -127, 127)  # beyond two turns it spins
    return b"".join(
        [
            bytes([count - 1, (len(position) - 1) << 4 | circles | (len(yaw) - 1)]),
            *(int(value).to_bytes(3, "big", signed=True) for value in mean),
            *(int(value).to_bytes(2, "big", signed=True) for value in terms.ravel()),
            turns.to_bytes(2, "big"),
            *(int(value).to_bytes(1, "big", signed=True) for value in rest),
        ]
    )


def decode_track(data: bytes, first_s: float) -> tuple[Track, int]:
    """Return the track and how many bytes it took.

    Raises
    ------
    RemoteProtocolError
        When the data end before the track does.
    """
    if len(data) < 2:
        raise RemoteProtocolError("a track needs at least two bytes")
    count, degree, yaw_degree = data[0] + 1, data[1] >> 4, data[1] & (_CIRCLES - 1)
    length = 8 + 4 * degree + 2 + yaw_degree
    if len(data) < length:
        raise RemoteProtocolError(f"a track of {length} bytes in {len(data)}")
    numbers = np.array(
        [
            int.from_bytes(data[at : at + 2], "big", signed=True)
            for at in range(8, 8 + 4 * degree, 2)
        ]
    )
    mean = [int.from_bytes(data[at : at + 3], "big", signed=True) for at in (2, 5)]
    position = np.vstack([_COARSE_M * np.array(mean), _FINE_M * numbers.reshape(degree, 2)])
    turns = int.from_bytes(data[8 + 4 * degree : 10 + 4 * degree], "big")
    rest = np.frombuffer(data[10 + 4 * degree : length], dtype=np.int8).astype(np.float64)
    unit = _TURN_CIRCLING if data[1] & _CIRCLES else _TURN_REST
    yaw = np.append(_TURN_FIRST * turns, unit * rest)
    where = _places(count)
    position_m = chebyshev.chebval(where, position)
    track = Track(
        time_s=first_s + np.arange(count, dtype=np.float64),
        north_m=position_m[0],
        east_m=position_m[1],
        yaw_rad=wrap_angle(chebyshev.chebval(where, yaw)),
    )
    return track, length


def _places(count: int) -> Array:
    return np.linspace(-1.0, 1.0, count) if count > 1 else np.zeros(1)


def _fitted(where: Array, values: Array, good_enough: float, highest: int) -> Array:
    """Return the terms (degree + 1, columns) of the lowest degree that is good enough."""
    highest = min(highest, _MAX_DEGREE, len(where) - 1)
    for degree in range(min(1, highest), highest + 1):
        terms = np.asarray(chebyshev.chebfit(where, values, degree), dtype=np.float64)
        misfit = chebyshev.chebval(where, terms).T - values
        if np.sqrt(np.mean(misfit**2)) < good_enough:
            break
    return terms


def _whole(values: Array, bits: int) -> Array:
    whole = np.round(values)
    if np.abs(whole).max(initial=0.0) >= 2 ** (bits - 1):
        raise LocalProtocolError(
            "a track beyond 2000 km from the datum, or of 2 km, is no sub-map's"
        )
    return whole
