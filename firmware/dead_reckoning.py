"""Dead reckoning: the Doppler log's velocity, integrated. Never corrected by anything."""

import math
from dataclasses import dataclass

from firmware.soundings import Odometry

_SET_BACK_SAMPLES = 5  # back in time one after the other: it is the clock that was set back
_LONGEST_STEP_S = 5.0  # a longer gap is not bridged with one velocity: the position is held
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


class DeadReckoning:
    """Integrates odometry from a start; bad samples are counted.

    The last velocity is kept for five seconds. After that the position is held, and `lost_s` tells
    of each step for how much of it nobody knows how far the vehicle went.
    """

    def __init__(self, start: ReckonedState) -> None:
        self.state = start
        self.bad_samples = 0
        self.lost_s = 0.0
        self.set_back = 0
        self._backward = 0
        self._velocity_mps = (0.0, 0.0)
        self._measured_s = start.time_s

    def receive_odometry(self, odometry: Odometry) -> ReckonedState:
        """Advance to the sample's time with its mean velocity since the last one; return the state.

        Non-finite velocities, and those that no vehicle has, are replaced by the last good ones;
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
        velocity_mps = (odometry.velocity_north_mps, odometry.velocity_east_mps)
        if math.hypot(*velocity_mps) <= _FASTEST_MPS:
            self._velocity_mps, unmeasured_s = velocity_mps, interval_s
            self._measured_s = odometry.time_s
        else:
            self.bad_samples += 1
            unmeasured_s = odometry.time_s - self._measured_s
        if unmeasured_s > _LONGEST_STEP_S:
            self.bad_samples += interval_s > _LONGEST_STEP_S
            self.lost_s, interval_s = interval_s, 0.0
        self.state = ReckonedState(
            time_s=odometry.time_s,
            north_m=self.state.north_m + self._velocity_mps[0] * interval_s,
            east_m=self.state.east_m + self._velocity_mps[1] * interval_s,
            yaw_rad=_finite(odometry.yaw_rad, self.state.yaw_rad),
            depth_m=_finite(odometry.depth_m, self.state.depth_m),
        )
        return self.state


def _finite(value: float, otherwise: float) -> float:
    return value if math.isfinite(value) else otherwise
