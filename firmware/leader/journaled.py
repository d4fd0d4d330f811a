"""A leader behind its journal: inputs and what matches found go to it.

Matching is not done again in a replay: the outcomes are inputs, in the order in which they came.
Whenever the graph was composed, the core itself is written down and only what comes later is
replayed; ISAM2, which is not written, has just been built from the ledger, and is so built again.
"""

import logging

from firmware.belief import Belief
from firmware.checkpoints import read, written
from firmware.dead_reckoning import ReckonedState
from firmware.inputs import Kind
from firmware.journal import Journal
from firmware.journaled import Journaled
from firmware.leader.core import LeaderCore
from firmware.leader.match_jobs import Findings, SheetJobs
from firmware.leader.matches import MatchOutcome, NoMatch
from firmware.leader.settings import LeaderSettings
from protocol.schedule import Slots

LOG = logging.getLogger(__name__)


class JournaledLeader(Journaled[LeaderCore]):
    """A leader's core behind its journal; its outcomes and beliefs are inputs, too.

    The start is that of a vehicle without a past.
    """

    def __init__(
        self,
        journal: Journal,
        start: ReckonedState,
        *,
        settings: LeaderSettings,
        slots: Slots,
    ) -> None:
        super().__init__(
            journal,
            start,
            lambda epoch, kept: LeaderCore(epoch, kept, settings=settings, slots=slots),
        )

    def tick(self, now_s: float) -> None:
        """Record and work; write the core down when its graph was composed."""
        before_s = self.core.composed_s
        super().tick(now_s)
        if self.core.composed_s != before_s:
            self._checkpoint()

    def next_jobs(self) -> SheetJobs | None:
        """Return the matches that wait; first those that a kill has cut short."""
        if self._unfinished:
            return self._unfinished.pop()
        if not self.core.has_jobs:
            return None
        self.recorder.note(Kind.JOBS)
        return self.core.next_jobs()

    def finish(self, done: SheetJobs, findings: Findings, now_s: float) -> None:
        """Record what the matches found, and judge it as a replay will.

        Where it cannot be recorded all of them have failed.
        """
        try:
            body = written(findings, (now_s,))
            findings, _ = read(body, Findings)
        except Exception:
            LOG.exception("what the matches of %s found cannot be recorded", done.sheet.id)
            self.recorder.journal.counters["store_outcomes_refused"] += 1
            failed = MatchOutcome(match=None, reason=NoMatch.RAISED)
            findings = Findings(outcomes=[failed] * len(done.jobs))
            body = written(findings, (now_s,))
        self.recorder.note(Kind.OUTCOMES, body)
        self.core.finish(done, findings, now_s)

    def belief(self) -> Belief:
        """Return where the leader believes itself to be; asking may settle the graph."""
        self.recorder.note(Kind.BELIEF)
        return self.core.belief()

    def _take_up(self) -> None:
        self._unfinished: list[SheetJobs] = []  # at most one: the worker takes one at a time
        self.core.atlas.shelf = self.recorder.journal

    def _replay(self, kind: int, body: bytes) -> None:
        match kind:
            case Kind.BELIEF:
                self.core.belief()
            case Kind.JOBS:
                jobs = self.core.next_jobs()
                self._unfinished = [] if jobs is None else [jobs]
            case Kind.OUTCOMES:
                findings, (now_s,) = read(body, Findings)
                self.core.finish(self._unfinished.pop(), findings, now_s)
            case _:
                super()._replay(kind, body)
