"""The pose graph of all vehicles (Eq. 11), incremental in gtsam, rebuilt at will from its ledger.

A node is a vehicle's position and dead-reckoning bias at one of the common epochs. Dead reckoning
is a linear factor between consecutive nodes; it carries the bias as a velocity that wanders, and
one heading bias and log scale per vehicle. Closures and ranges speak of arbitrary times; they are
moved to the nearest node by dead reckoning, so that no node is ever inserted between two others.

The ISAM2 object is a cache of the ledger: poisoned as soon as it raises, and rebuilt.
"""

import itertools
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from firmware.geometry import Array
from firmware.leader.chains import Chain, shared_walk
from firmware.leader.factors import factor_of
from firmware.leader.ledger import (
    AbsoluteRecord,
    Anchor,
    ClosureRecord,
    Entry,
    OdometryRecord,
    PriorRecord,
    RangeRecord,
    Record,
    SharedDriftRecord,
)
from firmware.leader.solver import new_isam
from firmware.leader.trajectory import Trajectory
from firmware.submaps import Track
from protocol.errors import EstimationError
from protocol.settings import Settings, setting

_SETTLING_STEPS = 4  # a robust weight follows its residual one step late


@dataclass(frozen=True, slots=True, kw_only=True)
class GraphSettings(Settings):
    """What the graph believes of dead reckoning, closures and ranges."""

    node_interval_s: float = setting(
        10.0, "s", "key-frame spacing; dead reckoning adds 0.6 m of noise in it", minimum=1.0
    )
    start_sigma_m: float = setting(
        0.5, "m", "uncertainty of each start in the common datum", minimum=1e-3
    )
    odometry_noise: float = setting(
        0.2, "m/sqrt(s)", "random part of dead reckoning: variance 0.04 a second", minimum=1e-4
    )
    bias_sigma_mps: float = setting(
        0.2, "m/s", "unmeasured current at the start, each axis", minimum=1e-4
    )
    bias_difference_mps: float = setting(
        0.2, "m/s", "vehicles drift in the same water: their biases differ by less", minimum=1e-4
    )
    bias_walk: float = setting(
        0.002, "m/s/sqrt(s)", "lets a current of 0.2 m/s turn within an hour", minimum=1e-7
    )
    bias_walk_apart: float = setting(
        0.0007, "m/s/sqrt(s)", "a current turns for all vehicles in it alike, nearly", minimum=1e-7
    )
    alike_interval_s: float = setting(
        60.0, "s", "how often that is said: chains stay loosely coupled", minimum=10.0
    )
    heading_bias_sigma_deg: float = setting(
        0.5, "degree", "mounting error of the attitude reference", minimum=1e-6
    )
    log_scale_sigma: float = setting(0.005, "1", "scale error of the Doppler log", minimum=1e-9)
    range_sigma_m: float = setting(
        2.0, "m", "noise of a range (1 m, Eq. 13) and of the way to its key frames", minimum=1e-3
    )
    closure_floor_m: float = setting(
        0.4, "m", "strain within a sub-map that no match can see", minimum=0.0
    )
    robust_kernel: float = setting(
        3.0, "sigma", "Huber: convex, so that large true innovations cannot stick", minimum=0.1
    )


class PoseGraph:
    """Every vehicle's trajectory, and what ties them together."""

    def __init__(self, settings: GraphSettings) -> None:
        self._settings = settings
        self._chains: dict[int, Chain] = {}
        self._ledger: list[Entry] = []
        self._changed: set[int] = set()
        self._values = gtsam.Values()
        self._fresh = gtsam.Values()
        self._factorization = "CHOLESKY"  # until it calls a long chain indeterminate: then QR
        self._isam = new_isam(self._factorization)
        self._factorised: tuple[SuperLU, dict[int, int]] | None = None
        self._trajectories: dict[int, Trajectory] = {}  # both until the next change
        self._newest_covariance: dict[int, Array] = {}
        self.rebuilds = 0

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
        """Start a vehicle's chain at a position (2,), as uncertain as the settings say, or as told.

        Its drift is like that of the first chain; or of the chain `like`, an earlier boot's, whose
        newest drift it goes on with.
        """
        s = self._settings
        number = len(self._chains)
        chain = Chain(number=number, parameters=gtsam.symbol("p", number))
        self._chains[vehicle] = chain
        state = np.concatenate([start_m, np.zeros(2)])
        key = self._append(chain, time_s, reckoned_m, state)
        self._fresh.insert(chain.parameters, np.zeros(2))
        sigmas = np.repeat([start_sigma_m or s.start_sigma_m, s.bias_sigma_mps], 2)
        self._enter(PriorRecord(key=key, mean=state, sigmas=sigmas))
        calibration = np.array([np.radians(s.heading_bias_sigma_deg), s.log_scale_sigma])
        self._enter(PriorRecord(key=chain.parameters, mean=np.zeros(2), sigmas=calibration))
        if number > 0:
            first = next(iter(self._chains.values())) if like is None else self._chains[like]
            nearest = int(np.argmin(np.abs(np.asarray(first.times_s) - time_s)))
            gap_s = abs(time_s - first.times_s[nearest])
            wandered_mps = float(s.bias_walk * np.sqrt(gap_s + s.node_interval_s))
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
            if np.min(np.abs(track.time_s - time_s)) <= interval_s / 2:
                self._step(chain, time_s, track.position_at(time_s))
                first = next(iter(self._chains.values()))
                for tie in shared_walk(first, chain, s.alike_interval_s, s.bias_walk_apart):
                    self._enter(tie)
                added += 1
        return added

    def anchor(self, vehicle: int, time_s: float, track: Track) -> Anchor:
        """Return the node nearest in time, and the offset from it to the position at the time.

        Raises EstimationError if the vehicle has no node within two intervals of the time.
        """
        if vehicle not in self._chains:
            raise EstimationError(f"vehicle {vehicle} has no chain in the graph")
        chain = self._chains[vehicle]
        nearest = int(np.argmin(np.abs(np.asarray(chain.times_s) - time_s)))
        lag_s = time_s - chain.times_s[nearest]
        if abs(lag_s) > 2 * self._settings.node_interval_s:
            raise EstimationError(
                f"vehicle {vehicle} has no node near {time_s:.1f} s; the nearest is at "
                f"{chain.times_s[nearest]:.1f} s"
            )
        bias_mps = self._state(chain.keys[nearest])[2:]
        moved_m = track.position_at(time_s) - chain.reckoned_m[nearest]
        return Anchor(key=chain.keys[nearest], offset_m=moved_m - bias_mps * lag_s, time_s=time_s)

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
            self._changed.add(number)

    def record(self, number: int) -> Record:
        """Return a record of the ledger."""
        return self._ledger[number].record

    def update(self) -> None:
        """Bring the estimate up to the ledger: incrementally, or from scratch if gtsam gives up."""
        if not self._changed and self._fresh.size() == 0:
            return
        added, numbers, removed = gtsam.NonlinearFactorGraph(), [], []
        for number in sorted(self._changed):
            entry = self._ledger[number]
            if entry.active and entry.slot is None:
                added.push_back(factor_of(entry.record, self._settings.robust_kernel))
                numbers.append(number)
            elif not entry.active and entry.slot is not None:
                removed.append(entry.slot)
                entry.slot = None
        try:
            result = self._isam.update(added, self._fresh, removed)
            for number, slot in zip(numbers, result.getNewFactorsIndices(), strict=True):
                self._ledger[number].slot = slot
            for _ in range(_SETTLING_STEPS if numbers or removed else 0):
                if self._isam.update().getVariablesRelinearized() == 0:
                    break
            self._values = self._isam.calculateEstimate()
        except RuntimeError:
            self._factorization = "QR"
            self._values.insert(self._fresh)
            self._rebuild(self._values)
        self._fresh = gtsam.Values()
        self._changed.clear()
        self._forget_solution()

    def solve_batch(self) -> None:
        """Solve the ledger from scratch by Levenberg-Marquardt and restart ISAM2 from there."""
        self.update()
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setLinearSolverType("MULTIFRONTAL_QR")
        graph, _ = self._active_factors()
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, self._values, parameters)
        self._rebuild(optimizer.optimize())

    def trajectory(self, vehicle: int) -> Trajectory:
        """Return the estimate of one vehicle at all of its nodes."""
        if vehicle not in self._trajectories:
            chain = self._chains[vehicle]
            states = np.array([self._state(key) for key in chain.keys])
            self._trajectories[vehicle] = Trajectory(
                time_s=np.array(chain.times_s),
                reckoned_m=np.array(chain.reckoned_m),
                position_m=states[:, :2],
                bias_mps=states[:, 2:],
            )
        return self._trajectories[vehicle]

    def parameters(self, vehicle: int) -> Array:
        """Return a vehicle's heading bias in rad and log scale, (2,)."""
        return self._state(self._chains[vehicle].parameters)

    def position(self, anchor: Anchor) -> Array:
        """Return the estimated position (2,) of an anchor."""
        return self._state(anchor.key)[:2] + anchor.offset_m

    def covariance(self, anchors: list[Anchor]) -> Array:
        """Return the joint covariance (2A, 2A) in m^2 of the positions of A anchors.

        Raises EstimationError if the information matrix is singular.
        """
        solver, columns = self._factorisation()
        rows = np.array([columns[a.key] + axis for a in anchors for axis in (0, 1)])
        unit = np.zeros((solver.shape[0], rows.size))
        unit[rows, np.arange(rows.size)] = 1.0
        return np.asarray(solver.solve(unit)[rows])

    def predicted_covariance(self, vehicle: int, time_s: float) -> Array:
        """Return the covariance (2, 2) in m^2 of a vehicle's position at or after its last node."""
        chain, s = self._chains[vehicle], self._settings
        if vehicle not in self._newest_covariance:
            solver, columns = self._factorisation()
            rows = columns[chain.keys[-1]] + np.arange(4)
            unit = np.zeros((solver.shape[0], 4))
            unit[rows, np.arange(4)] = 1.0
            self._newest_covariance[vehicle] = solver.solve(unit)[rows]
        ahead_s = max(time_s - chain.times_s[-1], 0.0)
        carry = np.hstack([np.eye(2), -ahead_s * np.eye(2)])
        grown_m2 = s.odometry_noise**2 * ahead_s + s.bias_walk**2 * ahead_s**3 / 3
        covariance = self._newest_covariance[vehicle]
        return np.asarray(carry @ covariance @ carry.T + grown_m2 * np.eye(2))

    def innovation(self, number: int) -> Array:
        """Return estimated minus measured offset (2,) of a closure, in metres."""
        record = self._closure(number)
        return record.innovation_m(
            self._state(record.origin.key)[:2], self._state(record.target.key)[:2]
        )

    def chi_square(self, number: int) -> float:
        """Return the squared innovation of a closure in units of its covariance."""
        innovation_m = self.innovation(number)
        return float(
            innovation_m @ np.linalg.solve(self._closure(number).covariance_m2, innovation_m)
        )

    def _closure(self, number: int) -> ClosureRecord:
        record = self._ledger[number].record
        if not isinstance(record, ClosureRecord):
            raise EstimationError(f"record {number} is not a closure")
        return record

    def _append(self, chain: Chain, time_s: float, reckoned_m: Array, state: Array) -> int:
        key: int = gtsam.symbol("x", (chain.number << 24) | len(chain.keys))
        chain.times_s.append(time_s)
        chain.reckoned_m.append(np.asarray(reckoned_m, dtype=np.float64))
        chain.keys.append(key)
        self._fresh.insert(key, np.asarray(state, dtype=np.float64))
        self._trajectories.clear()
        self._newest_covariance.clear()
        return key

    def _step(self, chain: Chain, time_s: float, reckoned_m: Array) -> None:
        s = self._settings
        before, interval_s = chain.keys[-1], time_s - chain.times_s[-1]
        moved_m = reckoned_m - chain.reckoned_m[-1]
        state = self._state(before).copy()
        state[:2] += moved_m - state[2:] * interval_s
        self._enter(
            OdometryRecord(
                origin=before,
                target=self._append(chain, time_s, reckoned_m, state),
                parameters=chain.parameters,
                moved_m=moved_m,
                interval_s=interval_s,
                position_sigma_m=s.odometry_noise * np.sqrt(interval_s),
                bias_sigma_mps=s.bias_walk * np.sqrt(interval_s),
            )
        )

    def _enter(self, record: Record, *, active: bool = True) -> int:
        self._ledger.append(Entry(record=record, active=active))
        number = len(self._ledger) - 1
        if active:
            self._changed.add(number)
        return number

    def _state(self, key: int) -> Array:
        values = self._values if self._values.exists(key) else self._fresh
        return np.asarray(values.atVector(key))

    def _active_factors(self) -> tuple[gtsam.NonlinearFactorGraph, list[Entry]]:
        graph, entries = gtsam.NonlinearFactorGraph(), []
        for entry in self._ledger:
            if entry.active:
                graph.push_back(factor_of(entry.record, self._settings.robust_kernel))
                entries.append(entry)
        return graph, entries

    def _rebuild(self, values: gtsam.Values) -> None:
        for entry in self._ledger:
            entry.slot = None
        graph, entries = self._active_factors()
        self._isam = new_isam(self._factorization)
        result = self._isam.update(graph, values)
        for entry, slot in zip(entries, result.getNewFactorsIndices(), strict=True):
            entry.slot = slot
        self._values = self._isam.calculateEstimate()
        self._forget_solution()
        self.rebuilds += 1

    def _forget_solution(self) -> None:
        self._factorised = None
        self._trajectories.clear()
        self._newest_covariance.clear()

    def _factorisation(self) -> tuple[SuperLU, dict[int, int]]:
        """Return the factorised information matrix, and the first column of every variable."""
        if self._changed or self._fresh.size():
            self.update()
        if self._factorised is None:
            linear = self._isam.getFactorsUnsafe().linearize(self._values)
            rows, columns, entries = linear.sparseJacobian_()
            keys = sorted(self._values.keys())
            sizes = [self._values.atVector(key).size for key in keys]
            first = dict(zip(keys, itertools.accumulate([0, *sizes[:-1]]), strict=True))
            size = sum(sizes)
            jacobian = sparse.csr_matrix(
                (entries, (rows.astype(int) - 1, columns.astype(int) - 1)),
                shape=(int(rows.max()), size + 1),
            )[:, :size]
            try:
                solver = splu((jacobian.T @ jacobian).tocsc())
            except RuntimeError as error:
                raise EstimationError("the information matrix is singular") from error
            self._factorised = solver, first
        return self._factorised
