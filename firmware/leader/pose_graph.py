"""The pose graph of all vehicles (Eq. 11), incremental in gtsam, rebuilt at will from its ledger.

A node is a vehicle's position and dead-reckoning bias at one of the common epochs. Dead reckoning
is a linear factor between consecutive nodes; it carries the bias as a velocity that wanders, and
one heading bias and log scale per vehicle. Closures and ranges speak of arbitrary times; they are
moved to the nearest node by dead reckoning, so that no node is ever inserted between two others.
"""

import itertools
from collections.abc import Mapping

import gtsam
import numpy as np

from firmware.geometry import Array
from firmware.leader.chains import Chain, shared_walk
from firmware.leader.composition import (
    Composition,
    CompositionSettings,
    detail_from_s,
    kept_nodes,
    pinned_keys,
)
from firmware.leader.graph_settings import GraphSettings
from firmware.leader.ledger import (
    AbsoluteRecord,
    Anchor,
    ClosureRecord,
    Entry,
    PriorRecord,
    RangeRecord,
    Record,
    SharedDriftRecord,
)
from firmware.leader.solver import Solver
from firmware.leader.trajectory import Trajectory
from firmware.leader.wander import changes_of, expected_walk, likely_walk
from firmware.submaps import Track
from protocol.errors import EstimationError

_POSITION, _BIAS = slice(2), slice(2, 4)  # of a node's state


class PoseGraph:
    """Every vehicle's trajectory, and what ties them together."""

    def __init__(self, settings: GraphSettings) -> None:
        self._settings = settings
        self._chains: dict[int, Chain] = {}
        self._ledger: dict[int, Entry] = {}
        self._entered = 0
        self._walk = settings.bias_walk
        self._solver = Solver(self._ledger, settings.robust_kernel)
        self._trajectories: dict[int, Trajectory] = {}  # both until the next change
        self._newest_covariance: dict[int, Array] = {}

    @property
    def rebuilds(self) -> int:
        """How often gtsam gave up, and was built anew."""
        return self._solver.rebuilds

    def add_vehicle(
        self,
        vehicle: int,
        time_s: float,
        reckoned_m: Array,
        start_m: Array,
        *,
        start_sigma_m: float | None = None,
        like: int | None = None,
    ) -> None:
        """Start a vehicle's chain at a position (2,), as uncertain as its time says, or as told.

        Its drift is like that of the first chain; or of the chain `like`, an earlier boot's, whose
        newest drift it goes on with.
        """
        s = self._settings
        number = len(self._chains)
        chain = Chain(number=number, parameters=gtsam.symbol("p", number))
        self._chains[vehicle] = chain
        state = np.concatenate([start_m, np.zeros(2)])
        key = self._append(chain, time_s, reckoned_m, state)
        self._solver.introduce(chain.parameters, np.zeros(2))
        sigmas = np.repeat([start_sigma_m or s.start_sigma_at(time_s), s.bias_sigma_mps], 2)
        self._enter(PriorRecord(key=key, mean=state, sigmas=sigmas))
        calibration = np.array([np.radians(s.heading_bias_sigma_deg), s.log_scale_sigma])
        self._enter(PriorRecord(key=chain.parameters, mean=np.zeros(2), sigmas=calibration))
        if number > 0:
            first = next(iter(self._chains.values())) if like is None else self._chains[like]
            nearest = first.nearest(time_s)
            gap_s = abs(time_s - first.times_s[nearest])
            wandered_mps = float(self._walk * np.sqrt(gap_s + s.node_interval_s))
            self._enter(
                SharedDriftRecord(
                    origin=first.keys[nearest],
                    target=key,
                    sigma_mps=s.bias_difference_mps if like is None else wandered_mps,
                )
            )

    def vehicles(self) -> list[int]:
        """Return the vehicles that have a chain."""
        return list(self._chains)

    def extend(self, vehicle: int, track: Track) -> int:
        """Add the nodes that a vehicle's newly known track allows; return how many.

        Epochs in a gap of the track are passed over: positions are composed, so the next node
        ties to the last across the gap.
        """
        chain, s = self._chains[vehicle], self._settings
        interval_s = s.node_interval_s
        begin = int(np.floor(chain.times_s[-1] / interval_s + 1e-9)) + 1
        end = int(np.floor(track.time_s[-1] / interval_s + 1e-9))
        added = 0
        for epoch in range(begin, end + 1):
            time_s = epoch * interval_s
            if track.gap_s(time_s) <= interval_s / 2:
                self._step(chain, time_s, track.position_at(time_s))
                if time_s % s.alike_interval_s == 0.0:
                    self._tie(chain, time_s - s.alike_interval_s, time_s)
                added += 1
        return added

    def anchor(self, vehicle: int, time_s: float, track: Track) -> Anchor:
        """Return the node nearest in time, and the offset from it to the position at the time.

        Raises EstimationError if the vehicle has no node within two intervals of the time.
        """
        if vehicle not in self._chains:
            raise EstimationError(f"vehicle {vehicle} has no chain in the graph")
        chain = self._chains[vehicle]
        nearest = chain.nearest(time_s)
        key, lag_s = chain.keys[nearest], time_s - chain.times_s[nearest]
        if chain.shape is not None and time_s < chain.shape.time_s[-1]:
            return self._anchor_in_shape(vehicle, key, time_s, track)
        if abs(lag_s) > 2 * self._settings.node_interval_s:
            raise EstimationError(
                f"vehicle {vehicle} has no node near {time_s:.1f} s; the nearest is at "
                f"{chain.times_s[nearest]:.1f} s"
            )
        bias_mps = self._state(key)[2:]
        moved_m = track.position_at(time_s) - chain.reckoned_m[nearest]
        return Anchor(
            key=key,
            parameters=chain.parameters,
            offset_m=moved_m - bias_mps * lag_s,
            time_s=time_s,
        )

    def add_closure(
        self, origin: Anchor, target: Anchor, offset_m: Array, covariance_m2: Array, *, active: bool
    ) -> int:
        """Enter a closure, target minus origin (2,) in metres, and return its number."""
        floor_m2 = self._settings.closure_floor_m**2
        record = ClosureRecord(
            origin=origin,
            target=target,
            offset_m=offset_m,
            covariance_m2=covariance_m2 + floor_m2 * np.eye(2),
        )
        return self._enter(record, active=active)

    def add_range(
        self, origin: Anchor, target: Anchor, range_m: float, spread_m: float = 0.0
    ) -> int:
        """Enter a one-way range between two anchors, active, and return its number.

        spread_m is its sigma beside that of the settings.
        """
        sigma_m = float(np.hypot(self._settings.range_sigma_m, spread_m))
        return self._enter(
            RangeRecord(origin=origin, target=target, range_m=range_m, sigma_m=sigma_m)
        )

    def add_absolute(self, anchor: Anchor, position_m: Array, covariance_m2: Array) -> int:
        """Enter an absolute position (2,) of an anchor, active, and return its number."""
        return self._enter(
            AbsoluteRecord(anchor=anchor, position_m=position_m, covariance_m2=covariance_m2)
        )

    def set_active(self, number: int, *, active: bool) -> None:
        """Take a record into the estimate, or out of it, from the next update on."""
        entry = self._ledger[number]
        if entry.active != active:
            entry.active = active
            self._solver.note(number)

    def record(self, number: int) -> Record:
        """Return a record of the ledger."""
        return self._ledger[number].record

    def closure(self, number: int) -> ClosureRecord:
        """Return a closure or hint of the ledger.

        Raises EstimationError if the record is none.
        """
        record = self._ledger[number].record
        if not isinstance(record, ClosureRecord):
            raise EstimationError(f"record {number} is not a closure")
        return record

    def is_active(self, number: int | None) -> bool:
        """Return whether the estimate uses a record; False if there is none of that number."""
        return number in self._ledger and self._ledger[number].active

    def __contains__(self, number: object) -> bool:
        return number in self._ledger

    @property
    def records(self) -> int:
        """How many records the ledger holds."""
        return len(self._ledger)

    @property
    def nodes(self) -> int:
        """How many nodes there are."""
        return sum(len(chain.keys) for chain in self._chains.values())

    def update(self) -> None:
        """Bring the estimate up to the ledger: incrementally, or from scratch if gtsam gives up."""
        if self._solver.update():
            self._forget_solution()

    def compose(self, now_s: float, settings: CompositionSettings) -> None:
        """Make the past coarse, learn how much drift wanders, and restart ISAM2 from the ledger."""
        self.update()
        self._learn_walk(now_s)
        estimate = {
            key: self._state(key)[:2]
            for chain in self._chains.values()
            for key in (*chain.keys, chain.parameters)
        }
        pinned, detail_s = pinned_keys(self._ledger.values()), detail_from_s(now_s, settings)
        owners: dict[int, int] = {}
        for vehicle, chain in self._chains.items():
            kept = kept_nodes(chain, now_s, pinned, settings)
            owners |= chain.drop(kept, self.trajectory(vehicle).until(detail_s))
        apart_m2 = self._apart(owners)
        old = {
            key
            for chain in self._chains.values()
            for key, time_s in zip(chain.keys, chain.times_s, strict=True)
            if time_s < detail_s
        }
        coarse = Composition(owners, apart_m2, old, estimate, settings).coarse(self._ledger)
        self._ledger.clear()
        self._ledger.update(coarse.kept)
        for record in coarse.new:
            self._enter(record)
        self._join_all()
        self._solver.restart(
            {
                key: self._state(key)
                for chain in self._chains.values()
                for key in (*chain.keys, chain.parameters)
            }
        )
        self._forget_solution()

    def solve_batch(self) -> None:
        """Solve the ledger from scratch by Levenberg-Marquardt and restart ISAM2 from there."""
        self.update()
        self._solver.solve_batch()
        self._forget_solution()

    def trajectory(self, vehicle: int) -> Trajectory:
        """Return the estimate of one vehicle at all of its nodes."""
        if vehicle not in self._trajectories:
            chain = self._chains[vehicle]
            states = np.array([self._state(key) for key in chain.keys])
            self._trajectories[vehicle] = chain.trajectory(states)
        return self._trajectories[vehicle]

    def parameters(self, vehicle: int) -> Array:
        """Return a vehicle's heading bias in rad and log scale, (2,)."""
        return self._state(self._chains[vehicle].parameters)

    def position(self, anchor: Anchor) -> Array:
        """Return the estimated position (2,) of an anchor."""
        return self._state(anchor.key)[:2] + anchor.offset_m

    def offset(self, origin: Anchor, target: Anchor) -> Array:
        """Return what a closure between two anchors would measure by this estimate, (2,)."""
        places_m = [
            self.position(end) - end.turning @ self._state(end.parameters)
            for end in (origin, target)
        ]
        return np.asarray(places_m[1] - places_m[0])

    def covariance(self, anchors: list[Anchor]) -> Array:
        """Return the joint covariance (2A, 2A) in m^2 of the positions of A anchors.

        Raises EstimationError if the information matrix is singular.
        """
        keys = list(dict.fromkeys(anchor.key for anchor in anchors))
        row = {key: 2 * k for k, key in enumerate(keys)}
        rows = [row[anchor.key] + axis for anchor in anchors for axis in (0, 1)]
        return np.asarray(self._joint_covariance(keys)[np.ix_(rows, rows)])

    def predicted_covariance(self, vehicle: int, time_s: float) -> Array:
        """Return the covariance (2, 2) in m^2 of a vehicle's position at or after its last node."""
        chain, s = self._chains[vehicle], self._settings
        if vehicle not in self._newest_covariance:
            self.update()
            self._newest_covariance[vehicle] = self._solver.covariance([chain.keys[-1]])
        ahead_s = max(time_s - chain.times_s[-1], 0.0)
        carry = np.hstack([np.eye(2), -ahead_s * np.eye(2)])
        grown_m2 = s.odometry_noise**2 * ahead_s + self._walk**2 * ahead_s**3 / 3
        covariance = self._newest_covariance[vehicle]
        return np.asarray(carry @ covariance @ carry.T + grown_m2 * np.eye(2))

    def innovation(self, number: int) -> Array:
        """Return estimated minus measured offset (2,) of a closure, in metres."""
        record = self.closure(number)
        ends = (record.origin, record.target)
        origin_m, target_m = (self._state(end.key)[:2] for end in ends)
        parameters = [self._state(end.parameters) for end in ends]
        return record.innovation_m(origin_m, target_m, (parameters[0], parameters[1]))

    def newest_covariance(self, vehicles: list[int], *, reckoned: bool) -> Array:
        """Return the joint covariance (4V, 4V) of vehicles' newest states.

        `reckoned` leaves out closures, ranges and fixes: what dead reckoning alone would know.
        Raises EstimationError if the information matrix is singular.
        """
        self.update()
        keys = [self._chains[vehicle].keys[-1] for vehicle in vehicles]
        return self._solver.covariance(keys, reckoned=reckoned)

    def newest_with(self, vehicles: list[int], anchors: list[Anchor]) -> Array:
        """Return the joint covariance of vehicles' newest states and of anchors' positions.

        It is (4V + 2A, 4V + 2A). Raises EstimationError if the information matrix is singular.
        """
        self.update()
        newest = [self._chains[vehicle].keys[-1] for vehicle in vehicles]
        keys = list(dict.fromkeys([*newest, *(anchor.key for anchor in anchors)]))
        joint = self._solver.covariance(keys)
        first = dict(zip(keys, range(0, 4 * len(keys), 4), strict=True))
        rows = [first[key] + k for key in newest for k in range(4)]
        rows += [first[anchor.key] + axis for anchor in anchors for axis in (0, 1)]
        return np.asarray(joint[np.ix_(rows, rows)])

    def chi_square(self, number: int) -> float:
        """Return the squared innovation of a closure in units of its covariance."""
        innovation_m = self.innovation(number)
        return float(
            innovation_m @ np.linalg.solve(self.closure(number).covariance_m2, innovation_m)
        )

    def _append(self, chain: Chain, time_s: float, reckoned_m: Array, state: Array) -> int:
        key: int = gtsam.symbol("x", (chain.number << 24) | chain.added)
        chain.added += 1
        chain.times_s.append(time_s)
        chain.reckoned_m.append(np.asarray(reckoned_m, dtype=np.float64))
        chain.keys.append(key)
        self._solver.introduce(key, state)
        self._trajectories.clear()
        self._newest_covariance.clear()
        return key

    def _step(self, chain: Chain, time_s: float, reckoned_m: Array) -> None:
        moved_m = reckoned_m - chain.reckoned_m[-1]
        state = self._state(chain.keys[-1]).copy()
        state[:2] += moved_m - state[2:] * (time_s - chain.times_s[-1])
        self._append(chain, time_s, reckoned_m, state)
        self._join(chain, len(chain.keys) - 1)

    def _join(self, chain: Chain, node: int) -> None:
        noise = self._settings.odometry_noise
        self._enter(chain.odometry(node - 1, node, noise, self._walk))

    def _tie(self, chain: Chain, begin_s: float, end_s: float) -> None:
        first, apart = next(iter(self._chains.values())), self._settings.walk_apart * self._walk
        for tie in shared_walk(first, chain, begin_s, end_s, apart):
            self._enter(tie)

    def _joint_covariance(
        self, keys: list[int], part: slice = _POSITION, *, reckoned: bool = False
    ) -> Array:
        """Return the joint covariance (2K, 2K) of the positions in m, or biases, of K nodes."""
        self.update()
        joint = self._solver.covariance(keys, reckoned=reckoned)
        rows = (4 * np.arange(len(keys))[:, None] + np.arange(4)[part]).ravel()
        return np.asarray(joint[np.ix_(rows, rows)])

    def _learn_walk(self, now_s: float) -> None:
        """Learn from the first chain, whose wandering all share, how much drift wanders."""
        s = self._settings
        chain = next(iter(self._chains.values()))
        epochs_s = np.arange(chain.times_s[-1], now_s - s.walk_memory_s, -s.walk_interval_s)[::-1]
        nodes = sorted({chain.nearest(epoch_s) for epoch_s in epochs_s})
        keys = [chain.keys[node] for node in nodes]
        if len(keys) < 2:
            return
        changes = changes_of(
            np.array([chain.times_s[node] for node in nodes]),
            np.array([self._state(key)[2:] for key in keys]),
            self._joint_covariance(keys, _BIAS, reckoned=True),
            self._joint_covariance(keys, _BIAS),
        )
        self._walk *= likely_walk(changes, s.bias_walk, s.walk_factor) / expected_walk(changes)

    def _apart(self, owners: Mapping[int, int]) -> dict[int, Array]:
        """Return the covariance (2, 2) of the way between each node and its owner."""
        keys = list(dict.fromkeys([*owners, *owners.values()]))
        joint_m2 = self._joint_covariance(keys) if keys else np.zeros((0, 0))
        rows = {key: slice(2 * k, 2 * k + 2) for k, key in enumerate(keys)}
        apart_m2 = {}
        for key, owner in owners.items():
            a, b = rows[key], rows[owner]
            apart_m2[key] = joint_m2[a, a] + joint_m2[b, b] - joint_m2[a, b] - joint_m2[b, a]
        return apart_m2

    def _join_all(self) -> None:
        """Say anew of the nodes that are left how dead reckoning and the water join them."""
        for chain in self._chains.values():
            for node in range(1, len(chain.keys)):
                self._join(chain, node)
            alike_s = self._settings.alike_interval_s
            told_s = [time_s for time_s in chain.times_s if time_s % alike_s == 0.0]
            for before_s, time_s in itertools.pairwise(told_s):
                self._tie(chain, before_s, time_s)

    def _anchor_in_shape(self, vehicle: int, key: int, time_s: float, track: Track) -> Anchor:
        here_m = self.trajectory(vehicle).correct(time_s, track.position_at(time_s))
        moved_m, parameters = here_m - self._state(key)[:2], self._chains[vehicle].parameters
        return Anchor(key=key, parameters=parameters, offset_m=moved_m, time_s=time_s)

    def _enter(self, record: Record, *, active: bool = True) -> int:
        number, self._entered = self._entered, self._entered + 1
        self._ledger[number] = Entry(record=record, active=active)
        if active:
            self._solver.note(number)
        return number

    def _state(self, key: int) -> Array:
        return self._solver.state(key)

    def _forget_solution(self) -> None:
        self._trajectories.clear()
        self._newest_covariance.clear()
