"""A leader behind its journal: inputs and what matches found go to it.

Matching is not done again in a replay: the outcomes are inputs, in the order in which they came.
Whenever the graph was composed, the core itself is written down and only what comes later is
replayed; ISAM2, which is not written, has just been built from the ledger, and is so built again.
"""

import dataclasses
import json
import struct
from typing import Any

import numpy as np

from firmware.belief import Belief
from firmware.checkpoints import NotNowError
from firmware.dead_reckoning import ReckonedState
from firmware.inputs import Kind
from firmware.journal import Journal
from firmware.journaled import Journaled
from firmware.leader.core import LeaderCore
from firmware.leader.match_jobs import Findings, SheetJobs
from firmware.leader.matches import Hint, Match, MatchOutcome, NoMatch
from firmware.leader.settings import LeaderSettings
from protocol.schedule import Slots

_NOW = struct.Struct("<d")


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
            try:
                self._checkpoint()
            except NotNowError:
                self.recorder.journal.counters["store_checkpoints_put_off"] += 1

    def next_jobs(self) -> SheetJobs | None:
        """Return the matches that wait; first those that a kill has cut short."""
        if self._unfinished:
            return self._unfinished.pop()
        if not self.core.has_jobs:
            return None
        self.recorder.note(Kind.JOBS)
        return self.core.next_jobs()

    def finish(self, done: SheetJobs, findings: Findings, now_s: float) -> None:
        """Record what the matches found, and judge it as a replay will."""
        body = from_findings(findings, now_s)
        self.recorder.note(Kind.OUTCOMES, body)
        self.core.finish(done, to_findings(body)[0], now_s)

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
                findings, now_s = to_findings(body)
                self.core.finish(self._unfinished.pop(), findings, now_s)
            case _:
                super()._replay(kind, body)


def from_findings(findings: Findings, now_s: float) -> bytes:
    """Return findings and the time of their judgement as bytes; numbers read back exactly."""
    rows = [
        (_columns(o.match), _columns(o.hint), None if o.reason is None else o.reason.name)
        for o in findings.outcomes
    ]
    plain = (rows, findings.false_closures)
    return _NOW.pack(now_s) + json.dumps(plain, separators=(",", ":")).encode()


def to_findings(body: bytes) -> tuple[Findings, float]:
    """Return the findings and the time of bytes."""
    (now_s,) = _NOW.unpack_from(body)
    outcomes = []
    rows, false_closures = json.loads(body[_NOW.size :])
    for found, hint, reason in rows:
        outcomes.append(
            MatchOutcome(
                match=None if found is None else Match(**_values(found)),
                reason=None if reason is None else NoMatch[reason],
                hint=None if hint is None else Hint(**_values(hint)),
            )
        )
    return Findings(outcomes=outcomes, false_closures=false_closures), now_s


def _columns(found: Match | Hint | None) -> dict[str, object] | None:
    if found is None:
        return None
    return {field.name: _plain(getattr(found, field.name)) for field in dataclasses.fields(found)}


def _values(columns: dict[str, Any]) -> dict[str, Any]:
    return {k: np.array(v) if isinstance(v, list) else v for k, v in columns.items()}


def _plain(value: object) -> object:
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value
