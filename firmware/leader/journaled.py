"""A leader that survives a kill: inputs and what matches found go to a journal.

Matching is not done again in a replay: the outcomes are inputs, in the order in which they came.
Whenever the graph was composed, the core itself is written down and only what comes later is
replayed; ISAM2, which is not written, has just been built from the ledger, and is so built again.
"""

import contextlib
import dataclasses
import json
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np

from firmware.belief import Belief
from firmware.checkpoints import NotNowError, read, written
from firmware.dead_reckoning import ReckonedState
from firmware.inputs import Heard, Kind, from_state, to_state
from firmware.journal import Journal
from firmware.leader.core import LeaderCore
from firmware.leader.match_jobs import Findings, SheetJobs
from firmware.leader.matches import Hint, Match, MatchOutcome, NoMatch
from firmware.leader.settings import LeaderSettings
from firmware.recorder import CoreInputs, Recorder
from firmware.soundings import Odometry, Ping
from firmware.store_file import StoreUnusableError
from protocol.schedule import Slots

_RECORDER = "recorder"
_NOW = struct.Struct("<d")


class JournaledLeader(LeaderCore):
    """A leader's core behind its journal; resumed from it where there is something to resume.

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
        self.recorder = Recorder(journal)
        self._made_with = (settings, slots)
        self._is_within = False
        self._unfinished: list[SheetJobs] = []  # at most one: the worker takes one at a time
        self._make(start)
        if journal.is_resumed:
            try:
                self._resume()
            except StoreUnusableError as error:
                journal.give_up(str(error))
                self.recorder, self._unfinished = Recorder(journal), []
                self._make(start)

    def receive_odometry(self, odometry: Odometry) -> None:
        """Record and advance."""
        fresh = self.recorder.odometry(odometry)
        if fresh is not None:
            super().receive_odometry(fresh)

    def receive_ping(self, ping: Ping) -> None:
        """Record and add a ping."""
        fresh = self.recorder.ping(ping)
        if fresh is not None:
            super().receive_ping(fresh)

    def receive_frame(self, frame: bytes, toa_s: float | None, now_s: float) -> None:
        """Take a frame and the arrival of its first bit; both are on disk when this returns."""
        if self.recorder.frame(Heard(frame=frame, toa_s=toa_s, now_s=now_s)):
            super().receive_frame(frame, toa_s, now_s)

    def tick(self, now_s: float) -> None:
        """Record and work; write the core down when its graph was composed."""
        if self.recorder.tick(now_s):
            before_s = self.composed_s
            super().tick(now_s)
            if self.composed_s != before_s:
                self._checkpoint()

    def next_jobs(self) -> SheetJobs | None:
        """Return the matches that wait; first those that a kill has cut short."""
        if self._unfinished:
            return self._unfinished.pop()
        if not self.has_jobs:
            return None
        self.recorder.note(Kind.JOBS)
        return super().next_jobs()

    def finish(self, done: SheetJobs, findings: Findings, now_s: float) -> None:
        """Record what the matches found, and judge it as a replay will."""
        body = from_findings(findings, now_s)
        self.recorder.note(Kind.OUTCOMES, body)
        super().finish(done, to_findings(body)[0], now_s)

    def poll(self, now_s: float) -> bytes | None:
        """Return the answer to transmit now, or None; what led to it is on disk."""
        if not self.recorder.poll(now_s):
            return self.recorder.polled(now_s)
        with self._within():
            frame = super().poll(now_s)
        return self.recorder.before_sending(frame)

    def belief(self) -> Belief:
        """Return where the leader believes itself to be; asking may settle the graph."""
        if not self._is_within:
            self.recorder.note(Kind.BELIEF)
        return super().belief()

    def status(self) -> dict[str, int]:
        """Return every counter, the store's among them."""
        return {**super().status(), **self.recorder.journal.counters}

    def _make(self, start: ReckonedState) -> None:
        settings, slots = self._made_with
        journal = self.recorder.journal
        kept = to_state(journal.start(from_state(start)))
        super().__init__(journal.boot_epoch, kept, settings=settings, slots=slots, shelf=journal)

    @contextlib.contextmanager
    def _within(self) -> Iterator[None]:
        """Let the core ask itself without a record: a replay makes it ask itself again."""
        self._is_within = True
        try:
            yield
        finally:
            self._is_within = False

    def _checkpoint(self) -> None:
        journal = self.recorder.journal
        state = {name: value for name, value in self.__dict__.items() if name != _RECORDER}
        try:
            journal.checkpoint(written(state, self.recorder.marks()))
        except NotNowError:
            journal.counters["store_checkpoints_put_off"] += 1

    def _resume(self) -> None:
        body = self.recorder.journal.checkpointed()
        if body is not None:
            state, marks = read(body)
            self.__dict__.update(state)
            self.atlas.shelf = self.recorder.journal
            self.recorder.restore(marks)
        plain = CoreInputs(
            odometry=super().receive_odometry,
            ping=super().receive_ping,
            frame=super().receive_frame,
            tick=super().tick,
            poll=super().poll,
        )
        with self._within():
            self.recorder.replay(plain, self._replay)

    def _replay(self, kind: int, body: bytes) -> None:
        match kind:
            case Kind.BELIEF:
                super().belief()
            case Kind.JOBS:
                jobs = super().next_jobs()
                self._unfinished = [] if jobs is None else [jobs]
            case Kind.OUTCOMES:
                findings, now_s = to_findings(body)
                super().finish(self._unfinished.pop(), findings, now_s)
            case _:
                raise StoreUnusableError(f"a leader has no input of kind {kind}")


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
