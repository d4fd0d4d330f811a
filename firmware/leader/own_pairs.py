"""Pairs of one vehicle's own sub-maps that told nothing sure, and searches for their common drift.

A pair that did not close is remembered. Once some are, and the vehicle's drift is still unknown,
they are weighed together (`drift_search.py`), again and again while sub-maps come in.
"""

import itertools
import logging
from collections import Counter, deque
from dataclasses import dataclass, field

from firmware.leader.atlas import Atlas, Sheet, SheetId, overlap_m2
from firmware.leader.closure_settings import ClosureSettings
from firmware.leader.closures import enter_hint
from firmware.leader.drift_search import DriftSearch, FoundDrift
from firmware.leader.judgement import Judgement
from firmware.leader.match_job import MatchJob
from firmware.leader.match_jobs import jobs_of
from firmware.leader.matches import MatchOutcome
from firmware.leader.offsets import Offset, Offsets
from firmware.leader.open_pairs import OpenPairs
from firmware.leader.pairing import Calibrations
from firmware.leader.pose_graph import PoseGraph
from protocol.errors import EstimationError

LOG = logging.getLogger(__name__)
_MOST_OPEN = 256  # pairs of a vehicle: a quarter of an hour
_APART_S = 30.0  # pairs of which both sub-maps are nearer in time share their soundings


@dataclass(frozen=True, slots=True, kw_only=True)
class _Pair:
    """A pair of sub-maps, when they were measured, and how much they were expected to overlap."""

    origin: SheetId
    target: SheetId
    times_s: tuple[float, float]
    area_m2: float

    def is_near(self, other: "_Pair") -> bool:
        """Return whether both sub-maps are neighbours of the other pair's."""
        return all(
            abs(one_s - two_s) < _APART_S
            for one_s, two_s in zip(self.times_s, other.times_s, strict=True)
        )


@dataclass(slots=True, kw_only=True)
class _Own:
    """A chain's open pairs, when they were last weighed, and the hint that this has left."""

    pairs: deque[_Pair] = field(default_factory=lambda: deque(maxlen=_MOST_OPEN))
    searched_s: float = -float("inf")
    hint: int | None = None


class OwnPairs:
    """Open pairs of every chain with itself."""

    def __init__(self, settings: ClosureSettings, drift_sigma_mps: float) -> None:
        self.counters: Counter[str] = Counter()
        self._settings, self._drift_sigma_mps = settings, drift_sigma_mps
        self._of: dict[int, _Own] = {}

    def note(self, job: MatchJob, outcome: MatchOutcome) -> None:
        """Remember a pair of one chain that gave no closure."""
        origin, target = job.origin, job.target
        if origin.id.chain != target.id.chain or outcome.match is not None:
            return
        first, second = sorted((origin, target), key=lambda sheet: sheet.time_s)
        own = self._of.setdefault(target.id.chain, _Own())
        known = {(pair.origin, pair.target) for pair in own.pairs}
        if (first.id, second.id) not in known:
            area_m2 = float(overlap_m2(origin, target, job.prior_shift_m[None])[0])
            own.pairs.append(
                _Pair(
                    origin=first.id,
                    target=second.id,
                    times_s=(first.time_s, second.time_s),
                    area_m2=area_m2,
                )
            )

    def search(
        self,
        sheet: Sheet,
        atlas: Atlas,
        graph: PoseGraph,
        offsets: Offsets,
        calibrations: Calibrations,
    ) -> DriftSearch | None:
        """Return the search that is due beside a new sheet of a chain, None where none is.

        None is while the graph knows the way from the first pass to the second well enough.
        """
        own, s = self._of.get(sheet.id.chain), self._settings
        if own is None or sheet.time_s - own.searched_s < s.drift_interval_s:
            return None
        pairs = self._chosen(own, sheet.time_s, atlas)
        if len(pairs) < s.drift_least_pairs:
            return None
        own.searched_s = sheet.time_s
        try:
            known = offsets.of([(atlas[pair.origin], atlas[pair.target]) for pair in pairs])
            if len(known) < s.drift_least_pairs or self._is_known(known):
                return None
            jobs = jobs_of(known, graph, s, calibrations)
        except EstimationError:
            return None
        except Exception:
            LOG.exception("the drift of %s cannot be searched", sheet.id)
            self.counters["drift_searches_raised"] += 1
            return None
        self.counters["drift_searches"] += 1
        return DriftSearch(
            jobs=jobs, wandering=graph.wandering, drift_sigma_mps=self._drift_sigma_mps
        )

    def take(
        self,
        search: DriftSearch,
        found: FoundDrift | None,
        graph: PoseGraph,
        judgement: Judgement,
        open_pairs: OpenPairs,
    ) -> None:
        """Tell the graph what a search found, in place of what it and its pairs told before."""
        if found is None:
            return
        own = self._of[found.job.target.id.chain]
        try:
            number = enter_hint(found.job, found.hint, graph, self._settings)
        except EstimationError:
            return
        if number is None:
            return
        if own.hint is not None and own.hint in graph:
            judgement.drop_hint(own.hint, graph)
        own.hint = number
        judgement.note_hint(number)
        for job in search.jobs:
            open_pairs.take_back(job.origin.id, job.target.id, graph, judgement)
        self.counters["drifts_found"] += 1

    def forget(self, before_s: float) -> None:
        """Forget chains of which nothing was heard since."""
        for chain, own in list(self._of.items()):
            if not own.pairs or own.pairs[-1].times_s[1] < before_s:
                del self._of[chain]

    def _chosen(self, own: _Own, now_s: float, atlas: Atlas) -> list[_Pair]:
        """Return pairs that overlap most, no two of them of the same soundings."""
        chosen, s = list[_Pair](), self._settings
        for pair in sorted(own.pairs, key=lambda pair: -pair.area_m2):
            is_held = pair.origin in atlas and pair.target in atlas
            if is_held and pair.times_s[1] > now_s - s.drift_memory_s:
                if not any(map(pair.is_near, chosen)):
                    chosen.append(pair)
        return list(itertools.islice(chosen, s.drift_pairs))

    def _is_known(self, offsets: list[Offset]) -> bool:
        """Return whether the offset of the passes farthest apart in time tells the drift."""
        farthest = max(offsets, key=_lag_s)
        return farthest.sigma_m <= self._settings.drift_sigma_mps * _lag_s(farthest)


def _lag_s(offset: Offset) -> float:
    return offset.target.time_s - offset.origin.time_s
