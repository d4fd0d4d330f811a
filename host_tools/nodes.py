"""A vehicle in a mission: its simulated sensors joined to the core that would run aboard."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Protocol

import numpy as np

from firmware.belief import Belief
from firmware.dead_reckoning import ReckonedState
from firmware.soundings import Odometry, Ping
from firmware.vehicle_core import Navigator

if TYPE_CHECKING:  # a follower's process holds nothing of the leader
    from firmware.follower.core import FollowerCore
    from firmware.follower.journaled import JournaledFollower
    from firmware.leader.core import LeaderCore
    from firmware.leader.journaled import JournaledLeader

Steps = Iterator[tuple[Odometry, Ping | None]]


Row = tuple[float, ...]
ROW_NUMBERS = 10
YAW = 9


def belief_row(belief: Belief, reckoned: ReckonedState) -> Row:
    """Return one second of a belief log."""
    return (
        belief.time_s,
        *belief.position_m,
        *belief.covariance_m2.ravel(),
        reckoned.north_m,
        reckoned.east_m,
        reckoned.yaw_rad,
    )


def belief_columns(rows: np.ndarray) -> dict[str, np.ndarray]:
    """Return time_s (T,), live_m (T, 2), covariance_m2 (T, 2, 2), reckoned_m, yaw_rad of rows."""
    return {
        "time_s": rows[:, 0],
        "live_m": rows[:, 1:3],
        "live_covariance_m2": rows[:, 3:7].reshape(-1, 2, 2),
        "reckoned_m": rows[:, 7:9],
        "yaw_rad": rows[:, YAW],
    }


class BeliefLog:
    """What a vehicle believed of itself at each whole second, beside raw dead reckoning."""

    def __init__(self) -> None:
        self._rows: list[Row] = []

    def note(self, belief: Belief, reckoned: ReckonedState) -> None:
        """Keep one second."""
        self._rows.append(belief_row(belief, reckoned))

    def columns(self) -> dict[str, np.ndarray]:
        """Return the columns of the seconds kept."""
        return belief_columns(np.array(self._rows))


class Node(Protocol):
    """One vehicle as the mission's clock drives it."""

    log: BeliefLog

    def hear(self, frame: bytes, toa_s: float | None, now_s: float) -> None:
        """Take a frame from the water."""

    def tick(self, now_s: float) -> bytes | None:
        """Take the sensors' step of this instant; return the frame to transmit, if any."""


class FollowerNode:
    """A follower with its sensors."""

    def __init__(self, core: "FollowerCore | JournaledFollower", steps: Steps) -> None:
        self.core, self._steps, self.log = core, steps, BeliefLog()

    def hear(self, frame: bytes, toa_s: float | None, now_s: float) -> None:
        """Take a frame and the arrival of its first bit."""
        self.core.receive_frame(frame, toa_s, now_s)

    def tick(self, now_s: float) -> bytes | None:
        """Feed one step of the sensors, do a slice of work, and ask for a frame."""
        _feed(self.core, self._steps)
        self.core.tick(now_s)
        if now_s == np.floor(now_s):
            self.log.note(self.core.belief(), self.core.reckoned)
        return self.core.poll(now_s)


class LeaderNode:
    """The leader with its sensors; matches run at once, so that a mission is deterministic."""

    def __init__(self, core: "LeaderCore | JournaledLeader", steps: Steps) -> None:
        self.core, self._steps, self.log = core, steps, BeliefLog()

    def hear(self, frame: bytes, toa_s: float | None, now_s: float) -> None:
        """Take a frame and the arrival of its first bit."""
        self.core.receive_frame(frame, toa_s, now_s)

    def tick(self, now_s: float) -> bytes | None:
        """Feed one step of the sensors, do all work that waits, and ask for a frame."""
        _feed(self.core, self._steps)
        self.core.tick(now_s)
        while (waiting := self.core.next_jobs()) is not None:
            self.core.finish(waiting, waiting.run(), now_s)
        if now_s == np.floor(now_s):
            self.log.note(self.core.belief(), self.core.reckoned)
        return self.core.poll(now_s)


def _feed(core: Navigator, steps: Steps) -> None:
    step = next(steps, None)
    if step is None:
        return
    odometry, ping = step
    core.receive_odometry(odometry)
    if ping is not None:
        core.receive_ping(ping)
