"""From sheets to closures that the estimate uses: jobs out, outcomes in.

A closure stays at hand while something may yet be decided on it; then only its verdict is kept.
"""

import logging
from collections import Counter, deque
from collections.abc import Iterator

from firmware.leader.atlas import Atlas, Sheet
from firmware.leader.closure_log import ClosureLog, Verdict, verdict_of
from firmware.leader.closures import Closure, closure_of, gated
from firmware.leader.judgement import Judgement
from firmware.leader.match_job import MatchJob
from firmware.leader.match_jobs import Findings, SheetJobs, jobs_for
from firmware.leader.nonconvexity import Doubt
from firmware.leader.offsets import Offsets
from firmware.leader.open_pairs import OpenPairs, sheets_of
from firmware.leader.own_pairs import OwnPairs
from firmware.leader.pairing import Calibrations
from firmware.leader.pose_graph import PoseGraph
from firmware.leader.settings import LeaderSettings
from protocol.errors import EstimationError

LOG = logging.getLogger(__name__)
_SHEETS_WAITING = 16  # five minutes of own sub-maps


class LoopClosing:
    """Sheets that wait for their matches, and what became of those that had theirs."""

    def __init__(self, graph: PoseGraph, atlas: Atlas, settings: LeaderSettings) -> None:
        self._counters: Counter[str] = Counter()
        self.is_matching = False  # jobs are out, and their outcomes have not come yet
        self._graph, self._atlas, self._settings = graph, atlas, settings
        self._waiting: deque[Sheet] = deque(maxlen=_SHEETS_WAITING)
        self._calibrations = Calibrations(settings.matching)
        self._judgement = Judgement(settings.judgement, self._calibrations)
        self._open = OpenPairs(settings.closures)
        self._own = OwnPairs(settings.closures, settings.graph.bias_sigma_mps)
        self._sheets_judged = 0
        self._doubt: Doubt | None = None  # to go with the next matches
        self._closures: list[Closure] = []  # on which something may yet be decided
        self._settled = ClosureLog()

    def add(self, sheet: Sheet) -> None:
        """Let a sheet of the atlas wait for its matches; the oldest gives way, counted."""
        if len(self._waiting) == self._waiting.maxlen:
            self._counters["submaps_unmatched"] += 1
        self._waiting.append(sheet)

    @property
    def has_jobs(self) -> bool:
        """Whether a sheet waits for its matches."""
        return bool(self._waiting)

    def next_jobs(self) -> SheetJobs | None:
        """Return the matches of the oldest sheet that still waits for them, or None.

        Where they cannot be made it has none; second looks and a doubt go out all the same.
        """
        if not self._waiting:
            return None
        self._graph.update()
        sheet, settings = self._waiting.popleft(), self._settings.closures
        turns = self._open.turns(sheet, self._atlas, self._graph)
        offsets = Offsets(self._graph, expected=sheets_of(turns))
        jobs: list[MatchJob] = []
        try:
            jobs = jobs_for(sheet, self._atlas, self._graph, offsets, settings, self._calibrations)
        except EstimationError:
            self._counters["submaps_unplaceable"] += 1
        except Exception:
            LOG.exception("the matches of %s cannot be made", sheet.id)
            self._counters["submaps_unmatched"] += 1
        looks = self._open.second_looks(turns, offsets, self._graph, self._calibrations)
        search = self._own.search(sheet, self._atlas, self._graph, offsets, self._calibrations)
        doubt, self._doubt = self._doubt, None
        self.is_matching = True
        return SheetJobs(sheet=sheet, jobs=(*jobs, *looks), doubt=doubt, search=search)

    def finish(self, done: SheetJobs, findings: Findings, now_s: float) -> None:
        """Judge what the matches of one sheet found, and bring the estimate up to it.

        Whatever that raises, the next sheet has its turn, and the past can be composed.
        """
        self.is_matching = False
        false = findings.false_closures
        if done.doubt is not None and false is not None:
            self._judgement.settle(done.doubt, false, self._closures, self._graph)
        found = []
        for job, outcome in zip(done.jobs, findings.outcomes, strict=True):
            if outcome.reason is not None:
                self._counters[f"match_{outcome.reason.name.lower()}"] += 1
            self._own.note(job, outcome)
            try:
                self._open.keep_or_settle(job, outcome, self._graph, self._judgement)
                closure = closure_of(job, outcome, self._graph, now_s)
            except EstimationError:
                self._counters["closures_unplaceable"] += 1
                continue
            if closure is not None:
                found.append(closure)
        if done.search is not None:
            self._own.take(done.search, findings.drift, self._graph, self._judgement, self._open)
        self._closures += found
        try:
            passed = gated(found, self._graph, self._settings.closures)
        except EstimationError:
            self._counters["closures_unplaceable"] += len(found)
            passed = []
        self._judgement.consider(passed, self._atlas, self._graph)
        self._graph.update()
        self._sheets_judged += 1
        if self._sheets_judged % self._settings.sheets_between_audits == 0:
            self._judgement.audit(self._closures, self._graph)
            self._graph.update()
            self._doubt = self._judgement.doubt(self._closures, self._graph)

    def forget(self, before_s: float) -> None:
        """Settle the closures of a past that was composed: nothing is decided on them any more."""
        self._judgement.forget(before_s, self._graph)
        self._own.forget(before_s)
        self._doubt = None
        known, self._closures = self._closures, []
        for closure in known:
            newest_s = max(closure.origin_anchor.time_s, closure.target_anchor.time_s)
            if closure.number in self._graph and newest_s >= before_s:
                self._closures.append(closure)
            else:
                self._settled.add(closure)

    def verdicts(self) -> Iterator[Verdict]:
        """Yield every closure that was detected, and how far it has come."""
        yield from self._settled
        yield from map(verdict_of, self._closures)

    def status(self) -> dict[str, int]:
        """Return every counter, those of judgement and of open pairs among them."""
        return {
            **self._counters,
            **self._judgement.counters,
            **self._open.counters,
            **self._own.counters,
            "verdicts_overwritten": self._settled.overwritten,
            "open_submaps": len(self._open),
        }
