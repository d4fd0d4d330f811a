"""What the pose graph has been told, as plain records: the graph can be rebuilt from them alone.

Node states are (north, east, bias north, bias east); a vehicle's parameters are (heading bias in
rad, log scale). Every record computes its own error, in the units of its sigmas.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from firmware.geometry import Array

_HOUR_S = 3600.0
QUARTER_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])


@dataclass(frozen=True, slots=True, kw_only=True)
class Anchor:
    """A node, the offset by dead reckoning from it to the position that is meant, and a lever.

    The offset drifts with the node's bias for lag_s. The lever leads from the position to a place
    that the sonar saw. Both are told in the frame of the vehicle's own compass, and turn with its
    heading bias; the offset, which the log measured, stretches with its scale as well.
    apart_m2 (2, 2) is the covariance of the offset, where it was estimated once and for all or
    navigation was lost on the way.
    """

    key: int
    parameters: int
    offset_m: Array  # (2,)
    time_s: float
    lag_s: float = 0.0
    lever_m: Array = field(default_factory=lambda: np.zeros(2))  # (2,)
    apart_m2: Array = field(default_factory=lambda: np.zeros((2, 2)))

    @property
    def by_state(self) -> Array:
        """How the position moves with the node's state, (2, 4)."""
        return np.array([[1.0, 0.0, -self.lag_s, 0.0], [0.0, 1.0, 0.0, -self.lag_s]])

    @property
    def turning(self) -> Array:
        """Return by how much the place moves back per radian and unit of the parameters, (2, 2)."""
        return np.column_stack([QUARTER_TURN @ (self.offset_m + self.lever_m), self.offset_m])

    def position_m(self, state: Array, parameters: Array) -> Array:
        """Return the position (2,) by the node's state (4,) and the vehicle's parameters (2,).

        It is moved by as much as the compass moves the place that was seen along the lever: by
        `by_state` and `turning`, which are not built for it, since solvers ask so often.
        """
        heading_rad, scale = parameters
        turned_m = QUARTER_TURN @ (self.offset_m + self.lever_m)
        way_m = (1.0 - scale) * self.offset_m - heading_rad * turned_m - self.lag_s * state[2:]
        return np.asarray(state[:2] + way_m)


def as_reckoned(moved_m: Array, parameters: Array) -> Array:
    """Return how dead reckoning with a vehicle's parameters (2,) tells of a true way (2,)."""
    heading_rad, scale = parameters
    return np.linalg.solve((1.0 - scale) * np.eye(2) - heading_rad * QUARTER_TURN, moved_m)


States = Callable[[int], Array]  # tells the estimate of a variable by its key


def position_of(anchor: Anchor, states: States) -> Array:
    """Return the position (2,) of an anchor by an estimate."""
    return anchor.position_m(states(anchor.key), states(anchor.parameters))


@dataclass(frozen=True, slots=True, kw_only=True)
class PriorRecord:
    """A Gaussian belief about a whole variable: mean and sigmas of equal length."""

    key: int
    mean: Array
    sigmas: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryRecord:
    """Dead reckoning between two nodes: moved_m (2,) in interval_s, with the noise of both parts.

    Its error is the first line of Eq. 11: x' - x - moved + (bias + bias') dt / 2 + heading J moved
    + scale moved, where J turns by +90 degrees; the bias wanders, and so steps compose exactly.
    """

    origin: int
    target: int
    parameters: int
    moved_m: Array
    interval_s: float
    position_sigma_m: float
    bias_sigma_mps: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TieRecord(OdometryRecord):
    """Dead reckoning across a restart: from a node of one boot to the next one's first.

    The position's sigma holds how far the vehicle may have come unheard.
    """


@dataclass(frozen=True, slots=True, kw_only=True)
class SharedDriftRecord:
    """Two vehicles in one water: the biases of two nodes agree within the sigma."""

    origin: int
    target: int
    sigma_mps: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SharedWalkRecord:
    """Two vehicles in one water: between two times their biases changed alike, within the sigma.

    Keys are of nodes: origins of the two vehicles at the earlier time, targets at the later.
    """

    origins: tuple[int, int]
    targets: tuple[int, int]
    sigma_mps: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ClosureRecord:
    """A loop closure: position of target minus position of origin (2,), with its covariance.

    It says that both saw the same place, each along its own lever; the offset is the levers'
    difference.
    """

    origin: Anchor
    target: Anchor
    offset_m: Array
    covariance_m2: Array  # (2, 2)

    @property
    def from_lower_key(self) -> "ClosureRecord":
        """The same closure, told from the node of the lower key."""
        if self.origin.key <= self.target.key:
            return self
        return replace(self, origin=self.target, target=self.origin, offset_m=-self.offset_m)

    @property
    def information(self) -> float:
        """How much it tells, in 1/m^2, of both axes together."""
        return float(np.trace(np.linalg.inv(self.covariance_m2)))

    def innovation_m(self, states: States) -> Array:
        """Return estimated minus measured offset (2,)."""
        return position_of(self.target, states) - position_of(self.origin, states) - self.offset_m

    def chi_square(self, states: States) -> float:
        """Return the squared innovation in units of its covariance."""
        innovation_m = self.innovation_m(states)
        return float(innovation_m @ np.linalg.solve(self.covariance_m2, innovation_m))


def clock_row(time_s: float) -> Array:
    """Return what a clock's offset in m and rate in m/h add to a range sent at the time, (2,)."""
    return np.array([1.0, time_s / _HOUR_S])


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeRecord:
    """A one-way range between two anchors: the third line of Eq. 11.

    The target sent, by a clock that may be behind. A clock's state is how much it lengthens ranges:
    in m at mission time zero, and in m/h.
    """

    origin: Anchor
    target: Anchor
    range_m: float
    sigma_m: float
    clock: int | None = None

    @property
    def by_clock(self) -> Array:
        """How the range grows with the state (2,) of the sender's clock."""
        return clock_row(self.target.time_s)

    def innovation_m(self, states: States) -> tuple[float, Array]:
        """Return estimated minus measured range, and the unit vector (2,) from origin to target."""
        between_m = position_of(self.target, states) - position_of(self.origin, states)
        return self.miss_m(between_m, None if self.clock is None else states(self.clock))

    def miss_m(self, between_m: Array, clock: Array | None) -> tuple[float, Array]:
        """Return the same for the way (2,) from origin to target and the clock's state (2,)."""
        distance_m = math.hypot(*between_m)
        direction = between_m / distance_m if distance_m > 1e-6 else np.array([1.0, 0.0])
        late_m = 0.0 if clock is None else float(self.by_clock @ clock)
        return distance_m + late_m - self.range_m, direction


@dataclass(frozen=True, slots=True, kw_only=True)
class AbsoluteRecord:
    """An absolute horizontal position (GNSS at the surface, USBL) of an anchor."""

    anchor: Anchor
    position_m: Array
    covariance_m2: Array

    def innovation_m(self, states: States) -> Array:
        """Return estimated minus measured position (2,)."""
        return position_of(self.anchor, states) - self.position_m


Record = (
    PriorRecord
    | OdometryRecord
    | SharedDriftRecord
    | SharedWalkRecord
    | ClosureRecord
    | RangeRecord
    | AbsoluteRecord
)


@dataclass(slots=True)
class Entry:
    """A record, whether the estimate uses it, and the slot in which the solver holds it."""

    record: Record
    active: bool
    slot: int | None = None
