"""Dead reckoning: the Doppler log's velocity, integrated. Never corrected by anything."""

import math
from dataclasses import dataclass

from firmware.soundings import Odometry

_SET_BACK_SAMPLES = 5  # back in time one after the other: it is the clock that was set back
_DOUBTED_S = 5.0  # without a velocity for longer: nobody knows how far the vehicle went
_KEPT_S = 10.0  # until then speed and current change by 0.2 m/s: 2 m, as odometry errs in 100 s
_FASTEST_MPS = 15.0  # no survey vehicle's: a log without bottom may say -32.768 m/s
LOST_SIGMA_MPS = 3.0
"""Sigma, each axis, of how far a survey vehicle goes while nobody measures it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReckonedState:
    """Where dead reckoning believes the vehicle to be at one instant."""

    time_s: float
    north_m: float
    east_m: float
    yaw_rad: float
    depth_m: float
    velocity_mps: tuple[float, float] = (0.0, 0.0)  # north, east

    def position_at(self, time_s: float) -> tuple[float, float]:
        """Return north and east in m at a time near the state's, by its velocity."""
        (north_mps, east_mps), ahead_s = self.velocity_mps, time_s - self.time_s
        return self.north_m + north_mps * ahead_s, self.east_m + east_mps * ahead_s


class DeadReckoning:
    """Integrates odometry from a start; bad samples are counted.

    Where the log has no bottom the last velocity is kept for ten seconds, and turns with the
    compass; then the vehicle `is_lost`, and its position is held. From five seconds on `lost_s`
    tells of each step for how much of it nobody knows how far the vehicle went.
    """

    def __init__(self, start: ReckonedState) -> None:
        self.state = start
        self.bad_samples = 0
        self.lost_s, self.is_lost = 0.0, False
        self.set_back = 0
        self._backward = 0
        self._velocity_mps = (0.0, 0.0)
        self._measured_s = start.time_s

    def receive_odometry(self, odometry: Odometry) -> ReckonedState:
        """Advance to the sample's time with its mean velocity since the last one; return the state.

        Non-finite velocities, and those that no vehicle has, are replaced by the last good one;
        samples that go back in time, or carry no finite time, are dropped. Where they go on doing
        so, the clock was set back: the position is held, and time goes on from there.
        """
        self.lost_s = 0.0
        interval_s = odometry.time_s - self.state.time_s
        if not math.isfinite(interval_s):
            self.bad_samples += 1
            return self.state
        if interval_s < 0.0:
            self.bad_samples += 1
            self._backward += 1
            if self._backward < _SET_BACK_SAMPLES:
                return self.state
            self.set_back += 1
            self._measured_s += interval_s
            interval_s = 0.0
        self._backward = 0
        yaw_rad = _finite(odometry.yaw_rad, self.state.yaw_rad)
        velocity_mps = (odometry.velocity_north_mps, odometry.velocity_east_mps)
        if math.hypot(*velocity_mps) <= _FASTEST_MPS:
            self._velocity_mps, unmeasured_s = velocity_mps, interval_s
            self._measured_s = odometry.time_s
        else:
            self.bad_samples += 1
            unmeasured_s = odometry.time_s - self._measured_s
            self._velocity_mps = _turned(self._velocity_mps, yaw_rad - self.state.yaw_rad)
        if unmeasured_s > _DOUBTED_S:
            self.bad_samples += interval_s > _DOUBTED_S
            self.lost_s = interval_s
        self.is_lost = unmeasured_s > _KEPT_S
        sailed_mps = (0.0, 0.0) if self.is_lost else self._velocity_mps
        self.state = ReckonedState(
            time_s=odometry.time_s,
            north_m=self.state.north_m + sailed_mps[0] * interval_s,
            east_m=self.state.east_m + sailed_mps[1] * interval_s,
            yaw_rad=yaw_rad,
            depth_m=_finite(odometry.depth_m, self.state.depth_m),
            velocity_mps=sailed_mps,
        )
        return self.state


def _turned(velocity_mps: tuple[float, float], yaw_rad: float) -> tuple[float, float]:
    (north_mps, east_mps), sine, cosine = velocity_mps, math.sin(yaw_rad), math.cos(yaw_rad)
    return north_mps * cosine - east_mps * sine, north_mps * sine + east_mps * cosine


def _finite(value: float, otherwise: float) -> float:
    return value if math.isfinite(value) else otherwise
