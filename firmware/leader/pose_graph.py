"""The pose graph of all vehicles (Eq. 11), incremental in gtsam, rebuilt at will from its ledger.

A node is a vehicle's position and dead-reckoning bias at one of the common epochs. Dead reckoning
is a linear factor between consecutive nodes; it carries the bias as a velocity that wanders, and
one heading bias and log scale per vehicle. Closures and ranges speak of arbitrary times; they are
moved to the nearest node by dead reckoning, so that no node is ever inserted between two others.
"""

import itertools
from dataclasses import replace

import gtsam
import numpy as np

from firmware.dead_reckoning import LOST_SIGMA_MPS
from firmware.geometry import Array
from firmware.leader.chains import Chain, shared_walk
from firmware.leader.composition import (
    Composition,
    CompositionSettings,
    detail_from_s,
    kept_nodes,
    pinned_keys,
)
from firmware.leader.estimate import Estimate
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
    TieRecord,
)
from firmware.leader.wander import bridged_m2, expected_walk, likely_walk, reckoned_m2
from firmware.submaps import Track
from protocol.errors import EstimationError

_STEADY_M_PER_H = 0.01  # of a clock whose rate is not asked for


class PoseGraph(Estimate):
    """Every vehicle's trajectory, and what ties them together: an estimate, and what it is told."""

    def __init__(self, settings: GraphSettings) -> None:
        super().__init__(settings)
        self._chain_walk = settings.bias_walk  # of a chain by itself: ties between chains tell, too
        self._entered = 0

    def add_chain(self, chain_id: int, time_s: float, reckoned_m: Array, start_m: Array) -> None:
        """Start a vehicle's chain at a position (2,), as uncertain as its time says.

        Its drift is like that of the first chain.
        """
        s = self._settings
        number = len(self._chains)
        chain = Chain(number=number, parameters=gtsam.symbol("p", number))
        if number > 0 and s.clock_offset_sigma_ms > 0.0:
            chain.clock = self._new_clock(number)
        self._chains[chain_id] = chain
        state = np.concatenate([start_m, np.zeros(2)])
        key = self._append(chain, time_s, reckoned_m, state)
        self._solver.introduce(chain.parameters, np.zeros(2))
        sigmas = np.repeat([s.start_sigma_at(time_s), s.bias_sigma_mps], 2)
        self._enter(PriorRecord(key=key, mean=state, sigmas=sigmas))
        calibration = np.array([np.radians(s.heading_bias_sigma_deg), s.log_scale_sigma])
        self._enter(PriorRecord(key=chain.parameters, mean=np.zeros(2), sigmas=calibration))
        if number > 0:
            first = next(iter(self._chains.values()))
            self._enter(
                SharedDriftRecord(
                    origin=first.keys[first.nearest(time_s)],
                    target=key,
                    sigma_mps=s.bias_difference_mps,
                )
            )

    def add_boot(
        self,
        chain_id: int,
        time_s: float,
        reckoned_m: Array,
        *,
        after: int,
        reached_m: Array,
        sigma_m: float,
    ) -> None:
        """Start the chain of a vehicle's next boot, which goes on where the chain `after` ends.

        reached_m (2,) is where that chain's dead reckoning would have it by then, within sigma_m.
        Compass, log and clock are the same as before, and so is the drift, but for its wandering.
        """
        s, old = self._settings, self._chains[after]
        chain = Chain(number=len(self._chains), parameters=old.parameters, clock=old.clock)
        self._chains[chain_id] = chain
        origin, moved_m = old.keys[-1], reached_m - old.reckoned_m[-1]
        passed_s = time_s - old.times_s[-1]
        interval_s = max(passed_s, 0.0)  # of a clock that was set back nobody knows it
        variance_m2 = sigma_m**2 + bridged_m2(interval_s, s.odometry_noise, self._chain_walk)
        wandered_mps = self._chain_walk * np.sqrt(abs(passed_s) + s.node_interval_s)
        state = self._state(origin).copy()
        state[:2] += moved_m - state[2:] * interval_s
        target = self._append(chain, time_s, reckoned_m, state)
        self._enter(
            TieRecord(
                origin=origin,
                target=target,
                parameters=chain.parameters,
                moved_m=moved_m,
                interval_s=interval_s,
                position_sigma_m=float(np.sqrt(variance_m2)),
                bias_sigma_mps=float(wandered_mps),
            )
        )

    def extend(self, chain_id: int, track: Track) -> None:
        """Add the nodes that a vehicle's newly known track allows.

        Epochs in a gap of the track are passed over: positions are composed, so the next node
        ties to the last across the gap.
        """
        if not track.time_s.size:
            return
        chain, s = self._chains[chain_id], self._settings
        interval_s = s.node_interval_s
        first = np.floor(chain.times_s[-1] / interval_s + 1e-9) + 1
        last = np.floor(track.time_s[-1] / interval_s + 1e-9)
        near = track.time_s[np.searchsorted(track.time_s, (first - 1) * interval_s) :] / interval_s
        epochs = np.unique([np.floor(near), np.ceil(near)])  # few, however far a clock leaps
        for epoch in epochs[(first <= epochs) & (epochs <= last)].tolist():
            time_s = epoch * interval_s
            if track.gap_s(time_s) <= interval_s / 2:
                self._step(chain, time_s, track.position_at(time_s))
                if time_s % s.alike_interval_s == 0.0:
                    self._walk_alike(chain, time_s - s.alike_interval_s, time_s)

    def lose(self, chain_id: int, begin_s: float, end_s: float) -> None:
        """Say of a span, before it has nodes, that nobody knows how far a vehicle went in it."""
        self._chains[chain_id].lose(begin_s, end_s)

    def set_back(self, chain_id: int, from_s: float, to_s: float) -> None:
        """Doubt the way on from a vehicle's newest node, since its clock was set back.

        Once the clock has caught up with that node it tells of less time than may have passed: the
        way becomes as unsure as dead reckoning for as long, as if navigation were lost meanwhile.
        """
        chain, s = self._chains[chain_id], self._settings
        passed_m2 = reckoned_m2(
            from_s - to_s, s.odometry_noise, self._walk, drift_mps=s.bias_sigma_mps
        )
        newest_s = chain.times_s[-1]
        chain.lose(newest_s, newest_s + float(np.sqrt(passed_m2)) / LOST_SIGMA_MPS)

    def add_closure(
        self, origin: Anchor, target: Anchor, offset_m: Array, covariance_m2: Array, *, active: bool
    ) -> int:
        """Enter a closure, target minus origin (2,) in metres, and return its number."""
        floor_m2 = self._settings.closure_floor_m**2 * np.eye(2)
        record = ClosureRecord(
            origin=origin,
            target=target,
            offset_m=offset_m,
            covariance_m2=covariance_m2 + floor_m2 + origin.apart_m2 + target.apart_m2,
        )
        return self._enter(record, active=active)

    def add_range(
        self,
        origin: Anchor,
        target: Anchor,
        range_m: float,
        spread_m: float = 0.0,
        *,
        sender: int | None = None,
    ) -> int:
        """Enter a one-way range between two anchors, active, and return its number.

        spread_m is its sigma beside that of the settings and of the ways to the nodes; the target
        is of the sender, whose clock may err.
        """
        record = RangeRecord(
            origin=origin,
            target=target,
            range_m=range_m,
            sigma_m=float(np.hypot(self._settings.range_sigma_m, spread_m)),
            clock=None if sender is None else self._chains[sender].clock,
        )
        _, along = record.innovation_m(self._state)
        apart_m = np.sqrt(along @ (origin.apart_m2 + target.apart_m2) @ along)
        return self._enter(replace(record, sigma_m=float(np.hypot(record.sigma_m, apart_m))))

    def add_absolute(self, anchor: Anchor, position_m: Array, covariance_m2: Array) -> int:
        """Enter an absolute position (2,) of an anchor, active, and return its number."""
        record = AbsoluteRecord(
            anchor=anchor, position_m=position_m, covariance_m2=covariance_m2 + anchor.apart_m2
        )
        return self._enter(record)

    def set_active(self, number: int, *, active: bool) -> None:
        """Take a record into the estimate, or out of it, from the next update on."""
        entry = self._ledger[number]
        if entry.active != active:
            entry.active = active
            self._solver.note(number)

    def record(self, number: int) -> Record:
        """Return a record of the ledger."""
        return self._ledger[number].record

    def is_active(self, number: int | None) -> bool:
        """Return whether the estimate uses a record; False if there is none of that number."""
        return number in self._ledger and self._ledger[number].active

    def __contains__(self, number: object) -> bool:
        return number in self._ledger

    @property
    def records(self) -> int:
        """How many records the ledger holds."""
        return len(self._ledger)

    def compose(self, now_s: float, settings: CompositionSettings) -> None:
        """Make the past coarse, learn how much drift wanders, and restart ISAM2 from the ledger."""
        self.update()
        walks = self._learned_walks(now_s)
        estimate = self._states()
        pinned, detail_s = pinned_keys(self._ledger.values()), detail_from_s(now_s, settings)
        kept = {
            chain_id: kept_nodes(chain, now_s, pinned, settings)
            for chain_id, chain in self._chains.items()
        }
        owners: dict[int, int] = {}
        for chain_id, chain in self._chains.items():
            owners |= chain.owners(kept[chain_id])
        apart_m2 = self.apart_m2(owners)
        shapes = {chain_id: self.trajectory(chain_id).until(detail_s) for chain_id in self._chains}
        self._walk, self._chain_walk = walks
        for chain_id, chain in self._chains.items():
            chain.drop(kept[chain_id], shapes[chain_id], apart_m2)
        old = {
            key
            for chain in self._chains.values()
            for key, time_s in zip(chain.keys, chain.times_s, strict=True)
            if time_s < detail_s
        }
        composition = Composition(owners, apart_m2, old, estimate, settings)
        coarse = composition.coarse(self._ledger)
        self._ledger.clear()
        self._ledger.update(coarse.kept)
        for record in coarse.new:
            self._enter(record)
        self._join_all()
        self._solver.restart(self._states())
        self._forget_solution()

    def _learned_walks(self, now_s: float) -> tuple[float, float]:
        """Return the walk of the water's drift, and that with which tied chains expect as much."""
        s = self._settings
        try:
            changes = self.drift_changes(now_s)
        except EstimationError:  # what is not known now may be the next time
            changes = []
        if not changes:
            return self._walk, self._chain_walk
        walk = likely_walk(changes, s.bias_walk, s.walk_factor)
        return walk, self._chain_walk * walk / expected_walk(changes)

    def _append(self, chain: Chain, time_s: float, reckoned_m: Array, state: Array) -> int:
        key: int = gtsam.symbol("x", (chain.number << 24) | chain.added)
        chain.added += 1
        chain.times_s.append(time_s)
        chain.reckoned_m.append(np.asarray(reckoned_m, dtype=np.float64))
        chain.keys.append(key)
        self._solver.introduce(key, state)
        self._forget_solution()
        return key

    def _step(self, chain: Chain, time_s: float, reckoned_m: Array) -> None:
        moved_m = reckoned_m - chain.reckoned_m[-1]
        state = self._state(chain.keys[-1]).copy()
        state[:2] += moved_m - state[2:] * (time_s - chain.times_s[-1])
        self._append(chain, time_s, reckoned_m, state)
        self._join(chain, len(chain.keys) - 1)

    def _new_clock(self, number: int) -> int:
        """Return the key of a clock that nothing is known of yet."""
        key, s = gtsam.symbol("c", number), self._settings
        self._solver.introduce(key, np.zeros(2))
        drift_m_per_h = max(s.clock_drift_sigma_m_per_h, _STEADY_M_PER_H)
        sigmas = np.array([s.clock_offset_sigma_m, drift_m_per_h])
        self._enter(PriorRecord(key=key, mean=np.zeros(2), sigmas=sigmas))
        return int(key)

    def _join(self, chain: Chain, node: int) -> None:
        noise = self._settings.odometry_noise
        self._enter(chain.odometry(node - 1, node, noise, self._chain_walk))

    def _walk_alike(self, chain: Chain, begin_s: float, end_s: float) -> None:
        first = next(iter(self._chains.values()))
        alike = shared_walk(first, chain, begin_s, end_s, self.wandering.apart)
        if alike is not None:
            self._enter(alike)

    def _join_all(self) -> None:
        """Say anew of the nodes that are left how dead reckoning and the water join them."""
        for chain in self._chains.values():
            for node in range(1, len(chain.keys)):
                self._join(chain, node)
            alike_s = self._settings.alike_interval_s
            told_s = [time_s for time_s in chain.times_s if time_s % alike_s == 0.0]
            for before_s, time_s in itertools.pairwise(told_s):
                self._walk_alike(chain, before_s, time_s)

    def _enter(self, record: Record, *, active: bool = True) -> int:
        number, self._entered = self._entered, self._entered + 1
        self._ledger[number] = Entry(record=record, active=active)
        if active:
            self._solver.note(number)
        return number
