"""Pairs of sub-maps that a match left open: looked at again once the graph knows their offset.

Where relief is faint a match finds several places, and the prior cannot tell them apart. Other
closures narrow the prior later; then one place is left, and the pair becomes a closure after all.
Until then it may leave a hint, if one vehicle saw both. Neighbouring pairs mistake the same hill
for the same other one, so what the second and third of them say counts for less.
"""

import logging
from collections import Counter, OrderedDict
from dataclasses import dataclass, replace

from firmware.leader.atlas import Atlas, Sheet, SheetId
from firmware.leader.closure_settings import ClosureSettings
from firmware.leader.closures import enter_hint
from firmware.leader.judgement import Judgement
from firmware.leader.match_job import MatchJob
from firmware.leader.match_jobs import jobs_again
from firmware.leader.matches import MatchOutcome, NoMatch
from firmware.leader.offsets import Offsets
from firmware.leader.pairing import Calibrations
from firmware.leader.pose_graph import PoseGraph
from protocol.errors import EstimationError

LOG = logging.getLogger(__name__)
_HEARD = 512  # hints whose neighbours are told from others
_ALIKE_S = 90.0  # between the middles of sub-maps that see much of the same ground
_OPEN = (NoMatch.AMBIGUOUS, NoMatch.LOOSE)  # what a narrower prior may decide

Ends = tuple[tuple[int, float], ...]
"""Chain and time of both sub-maps of a pair."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenPair:
    """The radius of the search at the last look, and the hint that a look left, if any.

    A pair that was told together with others leaves none any more.
    """

    radius_m: float
    hint: int | None = None
    is_told: bool = False


Turn = tuple[Sheet, list[tuple[Sheet, OpenPair]]]
"""A sheet to look at again, and its partners."""


class OpenPairs:
    """Open pairs by the sheet that was matched, bounded by the number of such sheets."""

    def __init__(self, settings: ClosureSettings) -> None:
        self.counters: Counter[str] = Counter()
        self._settings = settings
        self._of: OrderedDict[SheetId, dict[SheetId, OpenPair]] = OrderedDict()
        self._heard: OrderedDict[int, Ends] = OrderedDict()  # hints by number, the oldest first

    def note(self, job: MatchJob, outcome: MatchOutcome) -> None:
        """Remember a pair that a match left open; forget one that failed otherwise."""
        pairs = self._of.get(job.target.id, {})
        if outcome.reason in _OPEN:
            known = pairs.get(job.origin.id, OpenPair(radius_m=job.prior_radius_m))
            pairs[job.origin.id] = replace(known, radius_m=job.prior_radius_m)
            self._of[job.target.id] = pairs
        elif outcome.match is None:
            self.settle(job.origin.id, job.target.id)
        while len(self._of) > self._settings.open_submaps:
            self._of.popitem(last=False)
            self.counters["open_submaps_dropped"] += 1

    def hint(self, origin: SheetId, target: SheetId) -> int | None:
        """Return the hint that a look at the pair has left, if any."""
        pair = self._pair(origin, target)
        return None if pair is None else pair.hint

    def note_hint(self, origin: SheetId, target: SheetId, number: int | None) -> None:
        """Remember which hint stands for an open pair."""
        pairs = self._of.get(target, {})
        if number is not None and origin in pairs:
            pairs[origin] = replace(pairs[origin], hint=number)

    def settle(self, origin: SheetId, target: SheetId) -> None:
        """Forget a pair: it was decided."""
        pairs = self._of.get(target, {})
        pairs.pop(origin, None)
        if not pairs:
            self._of.pop(target, None)

    def second_looks(
        self, turns: list[Turn], offsets: Offsets, graph: PoseGraph, calibrations: Calibrations
    ) -> list[MatchJob]:
        """Return matches of open pairs whose offset is known better by now, beside a new sheet.

        Once there are as many as the new sheet may have, the other sheets keep their turn.
        """
        looks = list[MatchJob]()
        pairs = [(partner, target) for target, partners in turns for partner, _ in partners]
        try:
            found = {(o.origin.id, o.target.id): o for o in offsets.of(pairs)}
        except EstimationError:
            found = {}
        except Exception:
            LOG.exception("the offsets of open pairs were not found")
            self.counters["second_looks_raised"] += 1
            found = {}
        for target, partners in turns:
            if len(looks) >= self._settings.pairs_per_submap:
                break
            self._of.move_to_end(target.id)
            known = [
                (found[partner.id, target.id], pair.radius_m, pair.hint)
                for partner, pair in partners
                if (partner.id, target.id) in found
            ]
            self.counters["second_looks_unplaceable"] += not known
            try:
                looks += jobs_again(target, known, graph, self._settings, calibrations)
            except Exception:
                LOG.exception("second looks at %s failed", target.id)
                self.counters["second_looks_raised"] += 1
        self.counters["second_looks"] += len(looks)
        return looks

    def turns(self, beside: Sheet, atlas: Atlas, graph: PoseGraph) -> list[Turn]:
        """Return the sheets that were not looked at for longest, with the partners of each.

        The sheet that they go beside is left out. Sheets that are matched no more are
        forgotten. A partner whose hint was composed with others is passed over: nobody knows any
        more what the pair itself has told.
        """
        turns = list[Turn]()
        for target, pairs in list(self._of.items()):
            if len(turns) == self._settings.second_looks:
                break
            partners = [
                (atlas[origin], pair if graph.is_active(pair.hint) else replace(pair, hint=None))
                for origin, pair in pairs.items()
                if origin in atlas and (pair.hint is None or pair.hint in graph)
            ]
            if target not in atlas or not partners:
                del self._of[target]
            elif target != beside.id:
                turns.append((atlas[target], partners))
        return turns

    def keep_or_settle(
        self,
        job: MatchJob,
        outcome: MatchOutcome,
        graph: PoseGraph,
        judgement: Judgement,
    ) -> None:
        """Keep a pair open with the first hint that a look left; a match takes the hint's place.

        The hint goes before the match is gated, lest what the pair has told count twice. Raises
        EstimationError where a sub-map hangs on no node.
        """
        pair = job.origin.id, job.target.id
        known = self._pair(*pair)
        hint, is_told = (None, False) if known is None else (known.hint, known.is_told)
        self.note(job, outcome)
        if outcome.match is not None:
            self.settle(*pair)
            if hint is not None:
                judgement.drop_hint(hint, graph)
                self._heard.pop(hint, None)  # it lessens its neighbours' no more
        elif outcome.hint is not None and hint is None and not is_told:
            ends = _ends_of(job)
            told = outcome.hint.repeated(self._heard_alike(ends, graph))
            number = enter_hint(job, told, graph, self._settings)
            judgement.note_hint(number)
            self.note_hint(*pair, number)
            if number is not None:
                self._heard[number] = ends
            if len(self._heard) > _HEARD:
                self._heard.popitem(last=False)

    def tell(
        self, origin: SheetId, target: SheetId, graph: PoseGraph, judgement: Judgement
    ) -> None:
        """Let the hint of a pair go: it was told together with others. The pair stays open."""
        for first, second in ((origin, target), (target, origin)):
            pair = self._pair(first, second)
            if pair is not None:
                if pair.hint is not None:
                    judgement.drop_hint(pair.hint, graph)
                    self._heard.pop(pair.hint, None)
                self._of[second][first] = replace(pair, hint=None, is_told=True)

    def _heard_alike(self, ends: Ends, graph: PoseGraph) -> int:
        """Return how many hints of neighbours of a pair's sub-maps are believed."""
        return sum(
            graph.is_active(number) or number not in graph  # then it was composed
            for number, heard in self._heard.items()
            if _see_alike(heard, ends) or _see_alike(heard, ends[::-1])
        )

    def _pair(self, origin: SheetId, target: SheetId) -> OpenPair | None:
        return self._of.get(target, {}).get(origin)

    def __len__(self) -> int:
        return len(self._of)


def sheets_of(turns: list[Turn]) -> list[Sheet]:
    """Return the sheets that have a turn, and their partners."""
    return [
        s for target, partners in turns for s in (target, *(partner for partner, _ in partners))
    ]


def _ends_of(job: MatchJob) -> Ends:
    return tuple((sheet.id.chain, sheet.time_s) for sheet in (job.origin, job.target))


def _see_alike(some: Ends, others: Ends) -> bool:
    return all(
        one[0] == other[0] and abs(one[1] - other[1]) <= _ALIKE_S
        for one, other in zip(some, others, strict=True)
    )
