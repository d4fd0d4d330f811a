"""A core's inputs as the bytes of its store, exactly: what is read back is what the core was given.

Slant ranges are kept as float32 (8 micrometres at 100 m), so the core is given them so rounded.
Their bytes are stored plane by plane: the high ones of neighbouring beams are alike and compress.
"""

import enum
import math
import struct
from dataclasses import dataclass

import numpy as np

from firmware.dead_reckoning import ReckonedState
from firmware.geometry import Array
from firmware.soundings import Fix, Odometry, Ping

_FIVE = struct.Struct("<5d")
_FIX = struct.Struct("<i3d")
_PING = struct.Struct("<5dI")
_HEARD = struct.Struct("<2d")
_INSTANT = struct.Struct("<d")
_MOST_BEAMS = 4096  # of a ping that is kept; none of ours has more than half of it


class Kind(enum.IntEnum):
    """What an input is; the numbers are those of the store's schema."""

    ODOMETRY = 1
    PING = 2
    FRAME = 3
    TICK = 4
    POLL = 5
    BELIEF = 6
    JOBS = 7
    OUTCOMES = 8
    FAN = 9


@dataclass(frozen=True, slots=True, kw_only=True)
class Heard:
    """A frame with its arrival; toa_s is None where the modem does not vouch for it."""

    frame: bytes
    toa_s: float | None
    now_s: float


def from_odometry(odometry: Odometry) -> bytes:
    """Return odometry as bytes."""
    body = _FIVE.pack(
        odometry.time_s,
        odometry.velocity_north_mps,
        odometry.velocity_east_mps,
        odometry.yaw_rad,
        odometry.depth_m,
    )
    fix = odometry.fix
    if fix is None:
        return body
    return body + _FIX.pack(fix.vehicle, fix.north_m, fix.east_m, fix.sigma_m)


def to_odometry(body: bytes) -> Odometry:
    """Return the odometry of bytes."""
    time_s, north_mps, east_mps, yaw_rad, depth_m = _FIVE.unpack_from(body)
    fix = None
    if len(body) > _FIVE.size:
        vehicle, north_m, east_m, sigma_m = _FIX.unpack_from(body, _FIVE.size)
        fix = Fix(vehicle=vehicle, north_m=north_m, east_m=east_m, sigma_m=sigma_m)
    return Odometry(
        time_s=time_s,
        velocity_north_mps=north_mps,
        velocity_east_mps=east_mps,
        yaw_rad=yaw_rad,
        depth_m=depth_m,
        fix=fix,
    )


def fan_of(ping: Ping) -> bytes:
    """Return the beams' angles as bytes; pings of one sonar share them."""
    ranges_m, angles_rad = np.asarray(ping.slant_ranges_m), np.asarray(ping.beam_angles_rad)
    if ranges_m.ndim != 1 or ranges_m.shape != angles_rad.shape or ranges_m.size > _MOST_BEAMS:
        return b""  # a ping of no use: its beams are counted, and that is all
    return np.asarray(angles_rad, dtype="<f8").tobytes()


def from_ping(ping: Ping) -> bytes:
    """Return a ping without its angles as bytes."""
    ranges_m = np.asarray(ping.slant_ranges_m)
    head = _PING.pack(
        ping.time_s, ping.roll_rad, ping.pitch_rad, ping.yaw_rad, ping.depth_m, ranges_m.size
    )
    if not fan_of(ping):
        return head
    with np.errstate(over="ignore", invalid="ignore"):
        return head + _planes(np.asarray(ranges_m, dtype="<f4"))


def to_ping(body: bytes, fan: bytes) -> Ping:
    """Return the ping of bytes, with the angles of its fan."""
    time_s, roll_rad, pitch_rad, yaw_rad, depth_m, beams = _PING.unpack_from(body)
    angles_rad: Array = np.frombuffer(fan, dtype="<f8").copy()
    planes = np.frombuffer(body, dtype=np.uint8, offset=_PING.size).reshape(4, -1)
    ranges_m = np.ascontiguousarray(planes.T).view("<f4").ravel().astype(np.float64)
    if not ranges_m.size:
        ranges_m = np.full(min(beams, _MOST_BEAMS), np.nan)
        angles_rad = np.zeros(ranges_m.size)
    return Ping(
        time_s=time_s,
        slant_ranges_m=ranges_m,
        beam_angles_rad=angles_rad,
        roll_rad=roll_rad,
        pitch_rad=pitch_rad,
        yaw_rad=yaw_rad,
        depth_m=depth_m,
    )


def from_heard(heard: Heard) -> bytes:
    """Return a frame and its arrival as bytes."""
    toa_s = math.nan if heard.toa_s is None else heard.toa_s
    return _HEARD.pack(toa_s, heard.now_s) + heard.frame


def to_heard(body: bytes) -> Heard:
    """Return the frame and arrival of bytes."""
    toa_s, now_s = _HEARD.unpack_from(body)
    return Heard(frame=body[_HEARD.size :], toa_s=None if math.isnan(toa_s) else toa_s, now_s=now_s)


def from_instant(now_s: float) -> bytes:
    """Return a time as bytes."""
    return _INSTANT.pack(now_s)


def to_instant(body: bytes) -> float:
    """Return the time of bytes."""
    (now_s,) = _INSTANT.unpack(body)
    return float(now_s)


def from_state(state: ReckonedState) -> str:
    """Return a start as text that reads back exactly."""
    values = (state.time_s, state.north_m, state.east_m, state.yaw_rad, state.depth_m)
    return " ".join(float(value).hex() for value in values)


def to_state(text: str) -> ReckonedState:
    """Return the start of a text."""
    time_s, north_m, east_m, yaw_rad, depth_m = map(float.fromhex, text.split())
    return ReckonedState(
        time_s=time_s, north_m=north_m, east_m=east_m, yaw_rad=yaw_rad, depth_m=depth_m
    )


def _planes(values: np.ndarray) -> bytes:
    return values.view(np.uint8).reshape(-1, values.itemsize).T.tobytes()
