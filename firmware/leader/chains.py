"""The nodes of one vehicle in the pose graph, and what ties those of two vehicles in one water."""

import bisect
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from firmware.dead_reckoning import LOST_SIGMA_MPS
from firmware.geometry import Array
from firmware.leader.ledger import OdometryRecord, SharedWalkRecord
from firmware.leader.trajectory import Trajectory
from firmware.leader.wander import bridged_m2

_MOST_SPANS = 1024  # of lost navigation; of more the two nearest become one, with what is between


@dataclass(slots=True)
class Chain:
    """The nodes of one vehicle, in time order, and the keys of its parameters and of its clock.

    There is no clock where none is estimated.

    `shape` is the trajectory as it was last estimated where only some nodes are left; apart_m2
    (S, 2, 2) are the covariances of the ways from its positions to the nodes nearest to them.
    `lost` are the spans, first and last second, in which the vehicle's motion is unknown.
    """

    number: int
    parameters: int
    clock: int | None = None
    times_s: list[float] = field(default_factory=list)
    reckoned_m: list[Array] = field(default_factory=list)  # (2,) each
    keys: list[int] = field(default_factory=list)
    added: int = 0
    shape: Trajectory | None = None
    apart_m2: Array = field(default_factory=lambda: np.zeros((0, 2, 2)))
    lost: list[tuple[float, float]] = field(default_factory=list)

    def lose(self, begin_s: float, end_s: float) -> None:
        """Remember a span of which nobody knows how far the vehicle went; bounded."""
        if self.lost and begin_s <= self.lost[-1][1] <= end_s:
            begin_s = min(begin_s, self.lost.pop()[0])
        self.lost.append((begin_s, end_s))
        if len(self.lost) > _MOST_SPANS:
            self.lost.sort()  # a clock that was set back tells of earlier ones later
            gaps_s = [after[0] - before[1] for before, after in itertools.pairwise(self.lost)]
            k = int(np.argmin(gaps_s))
            (begin_s, end_s), (_, other_s) = self.lost[k : k + 2]
            self.lost[k : k + 2] = [(begin_s, max(end_s, other_s))]

    def lost_m2(self, begin_s: float, end_s: float) -> float:
        """Return the variance, each axis, that lost spans add to the way in an interval."""
        return self.lost_by_m2(end_s) - self.lost_by_m2(begin_s)

    def lost_by_m2(self, time_s: float) -> float:
        """Return the variance, each axis, that lost spans have added to all of the way by a time.

        A vehicle mostly goes on as it went: since a span began sigma grows with the time itself,
        not with its root.
        """
        lasted_s = (min(max(time_s, begin_s), end_s) - begin_s for begin_s, end_s in self.lost)
        return LOST_SIGMA_MPS**2 * sum(s**2 for s in lasted_s)

    def newest_s(self, leap_s: float, lasting_s: float) -> float:
        """Return the time of the newest node, or of the last before a leap that has yet to last."""
        recent = bisect.bisect_left(self.times_s, self.times_s[-1] - lasting_s)
        for before_s, time_s in itertools.pairwise(self.times_s[max(recent - 1, 0) :]):
            if time_s - before_s > leap_s:
                return before_s
        return self.times_s[-1]

    def key_at(self, time_s: float) -> int | None:
        """Return the key of the node at exactly this time, or None."""
        at = bisect.bisect_left(self.times_s, time_s)
        return self.keys[at] if at < len(self.times_s) and self.times_s[at] == time_s else None

    def before(self, time_s: float) -> int:
        """Return the index of the last node at or before a time, or else of the first."""
        return max(bisect.bisect_right(self.times_s, time_s) - 1, 0)

    def nearest(self, time_s: float) -> int:
        """Return the index of the node nearest to a time, the earlier of two."""
        return _nearest(self.times_s, time_s)

    def in_shape_s(self, time_s: float) -> float:
        """Return the time of the shape's position that is nearest to a time."""
        assert self.shape is not None
        return float(self.shape.time_s[_nearest(self.shape.time_s, time_s)])

    def apart_at_m2(self, time_s: float) -> Array:
        """Return the covariance (2, 2) of the way from the shape's position at a time to its node.

        It is that of the nearest of its positions.
        """
        assert self.shape is not None
        return np.asarray(self.apart_m2[_nearest(self.shape.time_s, time_s)])

    def trajectory(self, states: Array) -> Trajectory:
        """Return the estimate at all nodes ever, from the states (K, 4) of those that are left."""
        times_s, reckoned_m = np.array(self.times_s), np.array(self.reckoned_m)
        whole = Trajectory(
            time_s=times_s,
            reckoned_m=reckoned_m,
            position_m=states[:, :2],
            bias_mps=states[:, 2:],
        )
        return whole if self.shape is None else self.shape.carried_by(whole)

    def owners(self, kept: NDArray[np.bool_]) -> dict[int, int]:
        """Return the key of each node that is not kept (K,), and of the kept one nearest to it."""
        stay = np.flatnonzero(kept)
        stay_s = [self.times_s[k] for k in stay]
        return {
            self.keys[k]: self.keys[stay[_nearest(stay_s, self.times_s[k])]]
            for k in np.flatnonzero(~kept)
        }

    def drop(
        self, kept: NDArray[np.bool_], trajectory: Trajectory, apart_m2: Mapping[int, Array]
    ) -> None:
        """Leave some nodes (K,) only; what lies between keeps the shape of the trajectory.

        apart_m2 has, by the key of each node that goes, the covariance (2, 2) of the way to the
        one nearest to it that stays.
        """
        went = [self.keys[self.nearest(time_s)] for time_s in trajectory.time_s]
        whole_m2 = np.array([apart_m2.get(key, np.zeros((2, 2))) for key in went])
        whole_m2[: len(self.apart_m2)] += self.apart_m2
        self.apart_m2 = whole_m2
        stay = np.flatnonzero(kept)
        self.times_s = [self.times_s[k] for k in stay]
        self.reckoned_m = [self.reckoned_m[k] for k in stay]
        self.keys = [self.keys[k] for k in stay]
        self.shape = trajectory

    def odometry(
        self, before: int, after: int, odometry_noise: float, bias_walk: float
    ) -> OdometryRecord:
        """Return dead reckoning between two nodes by their index."""
        interval_s = self.times_s[after] - self.times_s[before]
        variance_m2 = bridged_m2(interval_s, odometry_noise, bias_walk)
        variance_m2 += self.lost_m2(self.times_s[before], self.times_s[after])
        return OdometryRecord(
            origin=self.keys[before],
            target=self.keys[after],
            parameters=self.parameters,
            moved_m=self.reckoned_m[after] - self.reckoned_m[before],
            interval_s=interval_s,
            position_sigma_m=float(np.sqrt(variance_m2)),
            bias_sigma_mps=float(bias_walk * np.sqrt(interval_s)),
        )


def _nearest(times_s: Sequence[float] | Array, time_s: float) -> int:
    """Return the index of the time nearest to another, the earlier of two."""
    after = bisect.bisect_left(times_s, time_s)
    if after in (0, len(times_s)):
        return max(after - 1, 0)
    return after - (time_s - times_s[after - 1] <= times_s[after] - time_s)


def shared_walk(
    first: Chain, chain: Chain, begin_s: float, end_s: float, bias_walk_apart: float
) -> SharedWalkRecord | None:
    """Return the record that a chain's bias changed as the first chain's did.

    There is none of the first chain itself, nor where one of the four nodes is missing.
    """
    keys = [c.key_at(time_s) for time_s in (begin_s, end_s) for c in (first, chain)]
    nodes = [key for key in keys if key is not None]
    if chain is first or len(nodes) < len(keys):
        return None
    return SharedWalkRecord(
        origins=(nodes[0], nodes[1]),
        targets=(nodes[2], nodes[3]),
        sigma_mps=bias_walk_apart * float(np.sqrt(end_s - begin_s)),
    )
