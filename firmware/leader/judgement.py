"""Which gated closures to believe: the graph, other closures and the map are asked in turn.

A closure is consistent when the graph already knew its offset to a few metres (then its gate was
proof enough), when another closure, of other soundings, closes a loop with it (pairwise
consistency), or, unless it holds along one axis only, when the map that it would build agrees where
the match did not look.
This is our reading of the paper's MCM, identification of invalid closures by the consistency of the
built map; its text is not public.
What is not yet believed waits, and is asked again when more is known. An audit takes back closures
that the estimate has come to contradict, and takes them in again when it no longer does. What it
takes back leaves a doubt: whether it was not the others that were false.
"""

from collections import Counter, deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware.geometry import Array
from firmware.leader.atlas import Atlas, Sheet
from firmware.leader.closures import Closure, Stage
from firmware.leader.consistency import (
    CandidateClosure,
    ConsistencySettings,
    Keys,
    consistent_set,
)
from firmware.leader.map_vote import VoteSettings, VoteWindow, carried, vote
from firmware.leader.nonconvexity import Doubt
from firmware.leader.pairing import Calibrations, side_of
from firmware.leader.pose_graph import PoseGraph
from protocol.settings import Settings, setting

_SUBMAP_S = 40.0  # overlaps that lie nearer in time may share soundings
_NEXT_S = (35.0, 90.0)
"""Neighbours share no soundings with the matched sub-map, and dead reckoning still holds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgementSettings(Settings):
    """What it takes to believe a closure."""

    known_sigma_m: float = setting(
        7.0, "m", "an offset known so well leaves a false match no room", minimum=0.1
    )
    waiting: int = setting(
        48, "closures", "gated but not believed; the oldest is given up", minimum=2, maximum=200
    )
    hints: int = setting(2000, "hints", "kept in doubt; older ones stay as they are", minimum=1)
    vote_windows: int = setting(
        4, "pairs", "of neighbouring sub-maps asked; each costs as much as a match", minimum=1
    )
    vote_ratio: float = setting(3.0, "log ratio", "twenty to one that the map agrees", minimum=0.0)
    drift_sigma_mps: float = setting(
        0.05, "m/s", "drift that remains once the estimated one is taken out", minimum=1e-4
    )
    reject_chi_square: float = setting(
        16.0, "1", "four sigmas: active closures beyond it are taken back", minimum=1.0
    )
    accept_chi_square: float = setting(
        6.0, "1", "95 %: a taken-back closure within it is taken in again", minimum=1.0
    )
    pairwise: ConsistencySettings = setting(ConsistencySettings, "", "pairwise consistency")
    vote: VoteSettings = setting(VoteSettings, "", "map consistency")


class Judgement:
    """Decides on gated closures; keeps those that wait, bounded."""

    def __init__(self, settings: JudgementSettings, calibrations: Calibrations) -> None:
        self.counters: Counter[str] = Counter()
        self._settings, self._calibrations = settings, calibrations
        self._settled: frozenset[int] = frozenset()  # closures that the last doubt found false
        self._waiting: deque[Closure] = deque(maxlen=settings.waiting)
        self._hints: deque[int] = deque(maxlen=settings.hints)

    def consider(self, gated: list[Closure], atlas: Atlas, graph: PoseGraph) -> None:
        """Believe what can be believed of the new closures and of those that wait."""
        doubtful = []
        for closure in gated:
            if closure.predicted_sigma_m <= self._settings.known_sigma_m:
                self._believe(closure, graph, "graph")
            else:
                doubtful.append(closure)
        candidates = [*self._waiting, *doubtful]
        if len(candidates) > 1:
            odometry = _Odometry(candidates, graph, self._settings)
            found = consistent_set(
                [_candidate(k, c) for k, c in enumerate(candidates)],
                odometry,
                self._settings.pairwise,
                odometry.alike(),
            )
            for k, closure in enumerate(candidates):
                if found.believed[k] and found.partners[k] > 0:
                    self._believe(closure, graph, "partners")
        for closure in doubtful:
            slides = closure.axis_deg is not None  # and the map beside it slides along
            if not slides and not closure.active and self._map_agrees(closure, atlas, graph):
                self._believe(closure, graph, "map")
        waiting = [c for c in candidates if not c.active]
        self.counters["closures_given_up"] += max(0, len(waiting) - self._settings.waiting)
        self._waiting = deque(waiting, self._settings.waiting)

    def note_hint(self, number: int | None) -> None:
        """Remember a hint that the graph took, so that audits can doubt it."""
        if number is not None:
            self._hints.append(number)
            self.counters["hints_taken"] += 1

    def drop_hint(self, number: int, graph: PoseGraph) -> None:
        """Let a hint go for good: a closure says the same, and more surely."""
        if number in self._hints:
            self._hints.remove(number)
        if number in graph:
            graph.set_active(number, active=False)

    def audit(self, closures: list[Closure], graph: PoseGraph) -> None:
        """Take back active closures that the estimate contradicts; take in those it confirms."""
        for closure in closures:
            if closure.number is None or closure.stage is not Stage.CONSISTENT:
                continue
            chi_square = graph.chi_square(closure.number)
            if closure.active and chi_square > self._settings.reject_chi_square:
                closure.active = False
                self.counters["closures_taken_back"] += 1
            elif not closure.active and chi_square < self._settings.accept_chi_square:
                closure.active = True
                self.counters["closures_taken_in_again"] += 1
            graph.set_active(closure.number, active=closure.active)
        for number in self._hints:
            fits = graph.chi_square(number) < self._settings.accept_chi_square
            graph.set_active(number, active=fits)

    def doubt(self, closures: list[Closure], graph: PoseGraph) -> Doubt | None:
        """Return all closures as a doubt once an audit has taken back some more, else None."""
        active = {
            c.number: c.active
            for c in closures
            if c.number is not None and c.stage is Stage.CONSISTENT and c.number in graph
        }
        if self._settled.issuperset(n for n, is_active in active.items() if not is_active):
            return None
        s = self._settings
        return graph.doubt(active, (s.accept_chi_square, s.reject_chi_square))

    def settle(
        self, doubt: Doubt, false: list[int], closures: list[Closure], graph: PoseGraph
    ) -> None:
        """Let the closures of a doubt be as active as its solution says."""
        self._settled = frozenset(false)
        for closure in closures:
            number = closure.number
            if number is None or number not in doubt.doubted or number not in graph:
                continue
            was, closure.active = closure.active, number not in false
            self.counters["closures_thrown_out"] += was and not closure.active
            self.counters["closures_restored"] += closure.active and not was
            graph.set_active(number, active=closure.active)

    def forget(self, before_s: float, graph: PoseGraph) -> None:
        """Wait no longer for closures found before a time; drop hints that the graph let go."""
        self._hints = deque((n for n in self._hints if n in graph), self._settings.hints)
        waiting = [c for c in self._waiting if c.time_s >= before_s]
        self.counters["closures_given_up"] += len(self._waiting) - len(waiting)
        self._waiting = deque(waiting, self._settings.waiting)

    def _believe(self, closure: Closure, graph: PoseGraph, reason: str) -> None:
        if closure.number is None or closure.number not in graph:
            return
        closure.stage, closure.active = Stage.CONSISTENT, True
        graph.set_active(closure.number, active=True)
        self.counters[f"closures_believed_by_{reason}"] += 1

    def _map_agrees(self, closure: Closure, atlas: Atlas, graph: PoseGraph) -> bool:
        """Ask neighbouring sub-maps, carried along by dead reckoning, whether they fit as well."""
        if closure.origin not in atlas or closure.target not in atlas:  # dropped meanwhile
            return False
        origin, target = atlas[closure.origin], atlas[closure.target]
        windows = [
            self._window(closure, (origin, target), pair, graph)
            for pair in _neighbour_pairs(origin, target, atlas)[: self._settings.vote_windows]
        ]
        if not windows:
            return False
        outcome = vote(windows, self._settings.vote, closure.misfit)
        return outcome.informed > 0 and outcome.log_ratio > self._settings.vote_ratio

    def _window(
        self,
        closure: Closure,
        matched: tuple[Sheet, Sheet],
        neighbours: tuple[Sheet, Sheet],
        graph: PoseGraph,
    ) -> VoteWindow:
        shift_m = closure.offset_m - (closure.target_reckoned_m - closure.origin_reckoned_m)
        trajectories = [graph.trajectory(sheet.id.chain) for sheet in matched]
        reference, query = (
            side_of(sheet, trajectory)
            for sheet, trajectory in zip(neighbours, trajectories, strict=True)
        )
        matching = self._calibrations.matching
        sigmas = self._calibrations.sigmas_of(reference, query, shift_m)
        ages_s = (
            neighbours[0].time_s - closure.origin_anchor.time_s,
            neighbours[1].time_s - closure.target_anchor.time_s,
        )
        anchors = closure.origin_anchor, closure.target_anchor
        lost_m2 = sum(
            graph.lost_m2(sheet.id.chain, anchor.time_s, sheet.time_s)
            for sheet, anchor in zip(neighbours, anchors, strict=True)
        )
        shift_m, covariance_m2 = carried(
            shift_m,
            closure.covariance_m2 + lost_m2 * np.eye(2),
            ages_s,
            (reference.drift_mps, query.drift_mps),
            matching,
        )
        return VoteWindow(
            reference=self._calibrations.level(reference),
            query=self._calibrations.level(query),
            matching=matching,
            sigmas=sigmas,
            shift_m=shift_m,
            covariance_m2=covariance_m2,
        )


class _Odometry:
    """Offsets between the ends of closures by dead reckoning alone; even keys are origins."""

    def __init__(
        self, closures: list[Closure], graph: PoseGraph, settings: JudgementSettings
    ) -> None:
        ends = [
            end
            for c in closures
            for end in (
                (c.origin.chain, c.origin_anchor.time_s, c.origin_reckoned_m),
                (c.target.chain, c.target_anchor.time_s, c.target_reckoned_m),
            )
        ]
        self._noise, self._drift_sigma_mps = graph.wandering.noise, settings.drift_sigma_mps
        self._chain = np.array([chain for chain, _, _ in ends])
        self._time_s = np.array([time_s for _, time_s, _ in ends])
        self._reckoned_m = np.array([reckoned_m for _, _, reckoned_m in ends])
        self._bias_mps = np.array([graph.trajectory(chain).bias_at(t) for chain, t, _ in ends])
        self._lost_m2 = np.array([graph.lost_m2(chain, -np.inf, t) for chain, t, _ in ends])

    def __call__(self, first: Keys, second: Keys) -> tuple[Array, Array]:
        """Return offsets (P, 2) and covariances (P, 2, 2), NaN between chains."""
        later_s = self._time_s[second] - self._time_s[first]
        bias_mps = (self._bias_mps[first] + self._bias_mps[second]) / 2.0
        offset_m = self._reckoned_m[second] - self._reckoned_m[first] - bias_mps * later_s[:, None]
        apart_s = np.abs(later_s)
        variance_m2 = self._noise**2 * apart_s + (self._drift_sigma_mps * apart_s) ** 2
        variance_m2 += np.abs(self._lost_m2[second] - self._lost_m2[first])
        other = self._chain[first] != self._chain[second]
        offset_m[other], variance_m2[other] = np.nan, np.nan
        return offset_m, variance_m2[:, None, None] * np.eye(2)

    def alike(self) -> NDArray[np.bool_]:
        """Return which closures (K, K) may share soundings at both ends, whichever way round."""
        near = np.abs(self._time_s[:, None] - self._time_s) < _SUBMAP_S
        near &= self._chain[:, None] == self._chain
        straight = near[::2, ::2] & near[1::2, 1::2]
        return np.asarray(straight | (near[::2, 1::2] & near[1::2, ::2]))


def _candidate(position: int, closure: Closure) -> CandidateClosure:
    return CandidateClosure(
        origin=2 * position,
        target=2 * position + 1,
        offset_m=closure.offset_m,
        covariance_m2=closure.covariance_m2,
    )


def _neighbour_pairs(origin: Sheet, target: Sheet, atlas: Atlas) -> list[tuple[Sheet, Sheet]]:
    """Return pairs of sub-maps measured just before or after the matched ones, nearest first."""

    def near(sheet: Sheet) -> list[Sheet]:
        same = [o for o in atlas if o.id.chain == sheet.id.chain and o.id != sheet.id]
        apart = [(abs(o.time_s - sheet.time_s), k) for k, o in enumerate(same)]
        return [same[k] for gap_s, k in sorted(apart) if _NEXT_S[0] < gap_s < _NEXT_S[1]]

    pairs = [(o, target) for o in near(origin)] + [(origin, t) for t in near(target)]
    pairs += [(o, t) for o in near(origin) for t in near(target)]
    return [pair for pair in pairs if pair[0].id != pair[1].id]
