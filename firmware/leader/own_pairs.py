"""Pairs of one vehicle's own sub-maps that told nothing sure, and searches for their common drift.

A pair that did not close is remembered. Once some are, and the vehicle's drift is still unknown,
they are weighed together (`drift_search.py`), again and again while sub-maps come in.
"""

import contextlib
import logging
from collections import Counter, OrderedDict
from dataclasses import dataclass, field

from firmware.leader.atlas import Atlas, Sheet, SheetId, overlap_m2
from firmware.leader.closure_settings import ClosureSettings
from firmware.leader.closures import enter_hint
from firmware.leader.drift_search import DriftSearch, FoundDrift
from firmware.leader.judgement import Judgement
from firmware.leader.match_job import MatchJob
from firmware.leader.match_jobs import jobs_of
from firmware.leader.matches import MatchOutcome, NoMatch
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
    """When two sub-maps were measured, and how much they were expected to overlap."""

    times_s: tuple[float, float]
    area_m2: float

    def is_near(self, other: "_Pair") -> bool:
        """Return whether both sub-maps are neighbours of the other pair's."""
        return all(
            abs(one_s - two_s) < _APART_S
            for one_s, two_s in zip(self.times_s, other.times_s, strict=True)
        )


Ends = tuple[SheetId, SheetId]
"""Both sub-maps of a pair, the earlier one first."""


@dataclass(slots=True, kw_only=True)
class _Own:
    """A chain's open pairs, when they were last weighed, and the hints that this has left.

    Each hint comes with the pairs that it was told by.
    """

    pairs: OrderedDict[Ends, _Pair] = field(default_factory=OrderedDict)
    searched_s: float = -float("inf")
    hints: dict[int, set[Ends]] = field(default_factory=dict)


class OwnPairs:
    """Open pairs of every chain with itself; drift_sigma_mps is that of `DriftSearch`."""

    def __init__(self, settings: ClosureSettings, drift_sigma_mps: float) -> None:
        self.counters: Counter[str] = Counter()
        self._settings, self._drift_sigma_mps = settings, drift_sigma_mps
        self._of: dict[int, _Own] = {}

    def note(self, job: MatchJob, outcome: MatchOutcome) -> None:
        """Remember a pair of one chain that gave no closure, and forget one that did."""
        origin, target = job.origin, job.target
        if origin.id.chain != target.id.chain or outcome.reason is NoMatch.RAISED:
            return
        own, ends = self._of.setdefault(target.id.chain, _Own()), _ends_of(job)
        if outcome.match is not None:
            own.pairs.pop(ends, None)
            return
        own.pairs[ends] = _Pair(
            times_s=(min(origin.time_s, target.time_s), max(origin.time_s, target.time_s)),
            area_m2=float(overlap_m2(origin, target, job.prior_shift_m[None])[0]),
        )
        if len(own.pairs) > _MOST_OPEN:
            own.pairs.popitem(last=False)
            self.counters["own_pairs_dropped"] += 1

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
            known = offsets.of([(atlas[first], atlas[second]) for first, second in pairs])
            if len(known) < s.drift_least_pairs or self._is_known(known):
                return None
            jobs = jobs_of(known, graph, s, calibrations)
        except EstimationError:
            self.counters["drift_searches_unplaceable"] += 1
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
        """Tell the graph what a search found, in place of what its pairs have told before.

        Where one of them has closed meanwhile, the closure tells.
        """
        if found is None:
            return
        job, told = search.jobs[found.pair], set(map(_ends_of, search.jobs))
        own = self._of.get(job.target.id.chain)
        if own is None or not told <= own.pairs.keys():
            self.counters["drifts_superseded"] += 1
            return
        number = None
        with contextlib.suppress(EstimationError):
            number = enter_hint(job, found.hint, graph, self._settings)
        if number is None:
            self.counters["drifts_refused"] += 1
            return
        for before, pairs in list(own.hints.items()):
            if pairs & told:
                judgement.drop_hint(before, graph)
            if pairs & told or before not in graph:  # then it was composed
                del own.hints[before]
        own.hints[number] = told
        judgement.note_hint(number)
        for ends in told:
            open_pairs.tell(*ends, graph, judgement)
        self.counters["drifts_found"] += 1

    def forget(self, before_s: float) -> None:
        """Forget pairs and hints of a past that was composed."""
        for chain, own in list(self._of.items()):
            for ends, pair in list(own.pairs.items()):
                if pair.times_s[1] < before_s:
                    del own.pairs[ends]
            if not own.pairs:
                del self._of[chain]

    def _chosen(self, own: _Own, now_s: float, atlas: Atlas) -> list[Ends]:
        """Return the pairs that overlap most, no two of them of the same soundings."""
        since_s = now_s - self._settings.drift_memory_s
        by_area = sorted(own.pairs.items(), key=lambda item: -item[1].area_m2)
        chosen = dict[Ends, _Pair]()
        for ends, pair in by_area:
            if pair.times_s[0] <= since_s or not all(sheet_id in atlas for sheet_id in ends):
                continue
            if not any(map(pair.is_near, chosen.values())):
                chosen[ends] = pair
        return list(chosen)[: self._settings.drift_pairs]

    def _is_known(self, offsets: list[Offset]) -> bool:
        """Return whether the offset of the passes farthest apart in time tells the drift."""
        farthest, s = max(offsets, key=_lag_s), self._settings
        return farthest.sigma_m <= max(s.hint_prior_m, s.drift_known_mps * _lag_s(farthest))


def _ends_of(job: MatchJob) -> Ends:
    first, second = sorted((job.origin, job.target), key=lambda sheet: sheet.time_s)
    return first.id, second.id


def _lag_s(offset: Offset) -> float:
    return offset.target.time_s - offset.origin.time_s
