"""What the pose graph makes of its ledger: where everyone was, and how sure that is.

Nothing is entered here. `update` brings an estimate up to its ledger, and so does asking for a
covariance.
"""

import itertools
from collections.abc import Mapping

import numpy as np

from firmware.geometry import Array, offset_covariance
from firmware.leader.chains import Chain
from firmware.leader.graph_settings import GraphSettings
from firmware.leader.ledger import (
    Anchor,
    ClosureRecord,
    Entry,
    as_reckoned,
    clock_row,
    position_of,
)
from firmware.leader.nonconvexity import Doubt
from firmware.leader.solver import Solver
from firmware.leader.trajectory import Trajectory
from firmware.leader.wander import DriftChange, Wandering, changes_of, reckoned_m2
from firmware.submaps import Track
from protocol.errors import EstimationError

_POSITION, _BIAS = slice(2), slice(2, 4)  # of a node's state
_APART_AT_ONCE = 64  # nodes of a chain beside each other: fewer ask more often, more cost more


class Estimate:
    """Every vehicle's trajectory, as the ledger has it.

    Each boot of a vehicle has a chain of nodes of its own, known by an id (`atlas.chain_of`).
    """

    def __init__(self, settings: GraphSettings) -> None:
        self._settings = settings
        self._chains: dict[int, Chain] = {}
        self._ledger: dict[int, Entry] = {}
        self._walk = settings.bias_walk  # of the water, as far as it is known by now
        self._solver = Solver(self._ledger, settings.robust_kernel)
        self._trajectories: dict[int, Trajectory] = {}  # both until the next change
        self._covariances: dict[int, Array] = {}  # of nodes by their keys

    @property
    def rebuilds(self) -> int:
        """How often gtsam gave up, and was built anew."""
        return self._solver.rebuilds

    @property
    def nodes(self) -> int:
        """How many nodes there are."""
        return sum(len(chain.keys) for chain in self._chains.values())

    def newest_s(self, leap_s: float, lasting_s: float) -> float:
        """Return the time of the newest node of all vehicles, whatever a clock says.

        Nodes after a gap of more than leap_s count once they have gone on for lasting_s: a clock
        may have leapt.
        """
        return max(chain.newest_s(leap_s, lasting_s) for chain in self._chains.values())

    @property
    def wandering(self) -> Wandering:
        """How dead reckoning errs, as far as it is known by now."""
        apart = self._settings.walk_apart * self._walk
        return Wandering(noise=self._settings.odometry_noise, walk=self._walk, apart=apart)

    def chains(self) -> list[int]:
        """Return the ids of all chains."""
        return list(self._chains)

    def update(self) -> None:
        """Bring the estimate up to the ledger: incrementally, or from scratch if gtsam gives up."""
        if self._solver.update():
            self._forget_solution()

    def solve_batch(self) -> None:
        """Solve the ledger from scratch by Levenberg-Marquardt and restart ISAM2 from there."""
        self.update()
        self._solver.solve_batch()
        self._forget_solution()

    def anchor(self, chain_id: int, time_s: float, track: Track) -> Anchor:
        """Return the node nearest in time, and the offset from it to the position at the time.

        Raises EstimationError if the chain has no node within two intervals of the time, or the
        track no state within half of one, as `PoseGraph.extend` wants of a node.
        """
        if chain_id not in self._chains:
            raise EstimationError(f"there is no chain {chain_id} in the graph")
        chain = self._chains[chain_id]
        nearest = chain.nearest(time_s)
        key, lag_s = chain.keys[nearest], time_s - chain.times_s[nearest]
        in_shape = chain.shape is not None and time_s < chain.shape.time_s[-1]
        known_s = chain.in_shape_s(time_s) if in_shape else chain.times_s[nearest]
        if abs(time_s - known_s) > 2 * self._settings.node_interval_s:
            raise EstimationError(
                f"chain {chain_id} has no node near {time_s:.1f} s; the nearest is at"
                f" {known_s:.1f} s"
            )
        if track.gap_s(time_s) > self._settings.node_interval_s / 2:
            raise EstimationError(f"the track of chain {chain_id} has no state near {time_s:.1f} s")
        if in_shape:
            return self._anchor_in_shape(chain_id, key, time_s, track)
        lost_m2 = self.lost_m2(chain_id, chain.times_s[nearest], time_s)
        return Anchor(
            key=key,
            parameters=chain.parameters,
            offset_m=track.position_at(time_s) - chain.reckoned_m[nearest],
            time_s=time_s,
            lag_s=lag_s,
            apart_m2=lost_m2 * np.eye(2),
        )

    def lost_m2(self, chain_id: int, begin_s: float, end_s: float) -> float:
        """Return the variance, each axis, that lost navigation adds to the way between two times.

        They come in either order.
        """
        return abs(self._chains[chain_id].lost_m2(begin_s, end_s))

    def trajectory(self, chain_id: int) -> Trajectory:
        """Return the estimate of one chain at all of its nodes."""
        if chain_id not in self._trajectories:
            chain = self._chains[chain_id]
            states = np.array([self._state(key) for key in chain.keys])
            self._trajectories[chain_id] = chain.trajectory(states)
        return self._trajectories[chain_id]

    def parameters(self, chain_id: int) -> Array:
        """Return a vehicle's heading bias in rad and log scale, (2,)."""
        return self._state(self._chains[chain_id].parameters)

    def clock(self, chain_id: int, time_s: float) -> tuple[float, float]:
        """Return by how much a vehicle's clock lengthens a range sent at the time, and the sigma.

        Both are in m, and zero where no clock is estimated.
        """
        key = self._chains[chain_id].clock
        if key is None:
            return 0.0, 0.0
        self.update()
        row = clock_row(time_s)
        variance_m2 = float(row @ self._solver.covariance([key]) @ row)
        return float(row @ self._state(key)), float(np.sqrt(variance_m2))

    def position(self, anchor: Anchor) -> Array:
        """Return the estimated position (2,) of an anchor; with a lever, as a closure sees it."""
        return position_of(anchor, self._state)

    def offset(self, origin: Anchor, target: Anchor) -> Array:
        """Return what a closure between two anchors would measure by this estimate, (2,)."""
        return self.position(target) - self.position(origin)

    def closure(self, number: int) -> ClosureRecord:
        """Return a closure or hint of the ledger.

        Raises EstimationError if the record is none.
        """
        record = self._ledger[number].record
        if not isinstance(record, ClosureRecord):
            raise EstimationError(f"record {number} is not a closure")
        return record

    def doubt(self, closures: Mapping[int, bool], limits: tuple[float, float]) -> Doubt:
        """Return closures, and whether each is active, as doubted by all else that is believed.

        limits are the chi squares within which one that is not active comes back, and beyond
        which an active one is false.
        """
        return Doubt(
            believed=tuple(
                entry.record
                for number, entry in self._ledger.items()
                if entry.active and number not in closures
            ),
            doubted={number: self.closure(number) for number in closures},
            taken_back=frozenset(number for number, active in closures.items() if not active),
            estimate=self._states(),
            robust_kernel=self._settings.robust_kernel,
            accept_chi_square=limits[0],
            reject_chi_square=limits[1],
        )

    def chi_square(self, number: int) -> float:
        """Return the squared innovation of a closure in units of its covariance."""
        return self.closure(number).chi_square(self._state)

    def covariance(self, anchors: list[Anchor]) -> Array:
        """Return the joint covariance (2A, 2A) in m^2 of the positions of A anchors.

        Raises EstimationError if the information matrix is singular.
        """
        positions_m2 = self.state_covariance(anchors)[:, _POSITION, :, _POSITION]
        return np.asarray(positions_m2.reshape(2 * len(anchors), 2 * len(anchors)))

    def state_covariance(self, anchors: list[Anchor]) -> Array:
        """Return the joint covariance (A, 4, A, 4) of positions in m and drifts in m/s of anchors.

        Raises EstimationError if the information matrix is singular.
        """
        return self._anchored_covariance([], anchors).reshape(len(anchors), 4, len(anchors), 4)

    def predicted_covariance(self, chain_id: int, time_s: float) -> Array:
        """Return the covariance (2, 2) in m^2 of a vehicle's position, from the last node before.

        That is its newest one, unless its clock was set back.
        """
        chain, s = self._chains[chain_id], self._settings
        node = chain.before(time_s)
        key, node_s = chain.keys[node], chain.times_s[node]
        if key not in self._covariances:
            self.update()
            self._covariances[key] = self._solver.covariance([key])
        ahead_s = max(time_s - node_s, 0.0)
        carry = np.hstack([np.eye(2), -ahead_s * np.eye(2)])
        grown_m2 = reckoned_m2(ahead_s, s.odometry_noise, self._walk)
        grown_m2 += chain.lost_m2(node_s, node_s + ahead_s)
        covariance = self._covariances[key]
        return np.asarray(carry @ covariance @ carry.T + grown_m2 * np.eye(2))

    def newest_covariance(self, chain_ids: list[int], *, reckoned: bool) -> Array:
        """Return the joint covariance (4V, 4V) of chains' newest states.

        `reckoned` leaves out closures, ranges and fixes: what dead reckoning alone would know.
        Raises EstimationError if the information matrix is singular.
        """
        self.update()
        keys = [self._chains[chain_id].keys[-1] for chain_id in chain_ids]
        return self._solver.covariance(keys, reckoned=reckoned)

    def newest_with(self, chain_ids: list[int], anchors: list[Anchor]) -> Array:
        """Return the joint covariance of chains' newest states and of anchors' positions.

        It is (4V + 2A, 4V + 2A). Raises EstimationError if the information matrix is singular.
        """
        newest = [self._chains[chain_id].keys[-1] for chain_id in chain_ids]
        joint = self._anchored_covariance(newest, anchors)
        states = 4 * len(newest)
        positions = states + (4 * np.arange(len(anchors))[:, None] + [0, 1]).ravel()
        rows = np.concatenate([np.arange(states), positions])
        return np.asarray(joint[np.ix_(rows, rows)])

    def drift_changes(self, now_s: float) -> list[DriftChange]:
        """Return how the drift of the first chain has changed, whose wandering all share."""
        s = self._settings
        chain = next(iter(self._chains.values()))
        epochs_s = np.arange(chain.times_s[-1], now_s - s.walk_memory_s, -s.walk_interval_s)[::-1]
        nodes = sorted({chain.nearest(epoch_s) for epoch_s in epochs_s})
        if len(nodes) < 2:
            return []
        keys = [chain.keys[node] for node in nodes]
        return changes_of(
            np.array([chain.times_s[node] for node in nodes]),
            np.array([self._state(key)[2:] for key in keys]),
            self._joint_covariance(keys, _BIAS, reckoned=True),
            self._joint_covariance(keys, _BIAS),
        )

    def apart_m2(self, owners: Mapping[int, int]) -> dict[int, Array]:
        """Return the covariance (2, 2) of the way between each node and its owner.

        They are asked for in batches of neighbours: the cost grows with the cube of what is joint.
        """
        nodes, apart_m2 = list(owners), dict[int, Array]()
        for k in range(0, len(nodes), _APART_AT_ONCE):
            ends = [(node, owners[node]) for node in nodes[k : k + _APART_AT_ONCE]]
            keys = list(dict.fromkeys(itertools.chain.from_iterable(ends)))
            joint_m2 = self._joint_covariance(keys)
            rows = {key: (2 * row, 2 * row + 1) for row, key in enumerate(keys)}
            for node, owner in ends:
                both = (*rows[node], *rows[owner])
                apart_m2[node] = offset_covariance(joint_m2[np.ix_(both, both)])
        return apart_m2

    def _state(self, key: int) -> Array:
        return self._solver.state(key)

    def _states(self) -> dict[int, Array]:
        """Return every node's state (4,), and every vehicle's parameters (2,) and clock (2,)."""
        return {
            key: self._state(key)
            for chain in self._chains.values()
            for key in (*chain.keys, chain.parameters, chain.clock)
            if key is not None
        }

    def _anchored_covariance(self, nodes: list[int], anchors: list[Anchor]) -> Array:
        """Return the joint covariance of the states (4,) of nodes and then of anchors."""
        ends = [*nodes, *(anchor.key for anchor in anchors)]
        keys = list(dict.fromkeys(ends))
        parameters = list(dict.fromkeys(anchor.parameters for anchor in anchors))
        first = {key: 4 * k for k, key in enumerate(keys)}
        first |= {key: 4 * len(keys) + 2 * k for k, key in enumerate(parameters)}
        self.update()
        joint = self._solver.covariance([*keys, *parameters])
        rows, whole = np.zeros((len(ends), 4, len(joint))), np.eye(4)
        for row, key in zip(rows, ends, strict=True):
            row[:, first[key] : first[key] + 4] = whole
        for row, anchor in zip(rows[len(nodes) :], anchors, strict=True):
            state, turned = first[anchor.key], first[anchor.parameters]
            row[_POSITION, state : state + 4] = anchor.by_state
            row[_POSITION, turned : turned + 2] = -anchor.turning
        by_all = rows.reshape(-1, len(joint))
        covariance = by_all @ joint @ by_all.T
        for k, anchor in enumerate(anchors, start=len(nodes)):
            covariance[4 * k : 4 * k + 2, 4 * k : 4 * k + 2] += anchor.apart_m2
        return np.asarray(covariance)

    def _joint_covariance(
        self, keys: list[int], part: slice = _POSITION, *, reckoned: bool = False
    ) -> Array:
        """Return the joint covariance (2K, 2K) of the positions in m, or biases, of K nodes."""
        self.update()
        joint = self._solver.covariance(keys, reckoned=reckoned)
        rows = (4 * np.arange(len(keys))[:, None] + np.arange(4)[part]).ravel()
        return np.asarray(joint[np.ix_(rows, rows)])

    def _anchor_in_shape(self, chain_id: int, key: int, time_s: float, track: Track) -> Anchor:
        chain = self._chains[chain_id]
        here_m = self.trajectory(chain_id).correct(time_s, track.position_at(time_s))
        moved_m = here_m - self._state(key)[:2]
        lost_m2 = self.lost_m2(chain_id, chain.in_shape_s(time_s), time_s)
        return Anchor(
            key=key,
            parameters=chain.parameters,
            offset_m=as_reckoned(moved_m, self._state(chain.parameters)),
            time_s=time_s,
            apart_m2=chain.apart_at_m2(time_s) + lost_m2 * np.eye(2),
        )

    def _forget_solution(self) -> None:
        self._trajectories.clear()
        self._covariances.clear()
