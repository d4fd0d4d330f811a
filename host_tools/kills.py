"""Vehicles whose computer dies at drawn instants and comes back from its store, in one process.

Death is a journal that raises: before an input is taken, before or after a commit, after a replay.
What was not committed is gone, as after a SIGKILL; the sensors and the water stand still meanwhile.
"""

import math
from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np

from firmware.belief import Belief
from firmware.dead_reckoning import ReckonedState
from firmware.journal import Journal, JournalSettings, Owner
from firmware.journaled import Journaled
from firmware.ports import SensorStep
from firmware.vehicle_core import VehicleCore
from host_tools.nodes import BeliefLog, FollowerNode, LeaderNode, Steps

_TAPE_STEPS = 256  # a minute of sensors: far more than a commit may lose


class KilledError(BaseException):
    """The computer is dead; not an Exception, because nothing aboard may catch it."""


class Fate:
    """Counts down the events of one vehicle's life to its next death.

    There are at most so many kills; events_between is the mean number of journal events from one to
    the next.
    """

    def __init__(self, rng: np.random.Generator, kills: int, events_between: float) -> None:
        self._rng, self._most, self._mean = rng, kills, events_between
        self.kills = 0
        self._countdown = self._draw()

    def strike(self) -> None:
        """Raise KilledError when the time has come."""
        self._countdown -= 1.0
        if self._countdown <= 0.0 and self.kills < self._most:
            self.kills += 1
            self._countdown = self._draw()
            raise KilledError

    def _draw(self) -> float:
        return math.ceil(float(self._rng.exponential(self._mean)))


class MortalJournal(Journal):
    """A journal during whose work the computer may die."""

    def __init__(self, folder: Path, owner: Owner, settings: JournalSettings, fate: Fate) -> None:
        self._fate = fate
        super().__init__(folder, owner, settings)

    def append(self, kind: int, body: bytes = b"") -> None:
        """Append, unless death comes first."""
        self._fate.strike()
        super().append(kind, body)

    def commit(self) -> None:
        """Commit; death may come before it, or just after."""
        self._fate.strike()
        super().commit()
        self._fate.strike()

    def abandon(self) -> None:
        """Leave the file as a dead process does: what waits is lost, the lock is free."""
        self._close()


class SensorTape:
    """The sensors' steps, with the newest kept so that they can be had again."""

    def __init__(self, steps: Steps) -> None:
        self._steps = steps
        self._kept: deque[SensorStep] = deque(maxlen=_TAPE_STEPS)
        self._again: deque[SensorStep] = deque()

    def __iter__(self) -> "SensorTape":
        return self

    def __next__(self) -> SensorStep:
        if self._again:
            return self._again.popleft()
        step = next(self._steps)
        self._kept.append(step)
        return step

    def rewind(self, to_s: float) -> None:
        """Give the steps from a time on once more."""
        self._again = deque(step for step in self._kept if step[0].time_s >= to_s - 1e-6)


class LastingLog(BeliefLog):
    """A log that keeps the first belief of each second: a repeated second must say the same."""

    def __init__(self) -> None:
        super().__init__()
        self._newest: Belief | None = None
        self.differing = 0

    def note(self, belief: Belief, reckoned: ReckonedState) -> None:
        """Keep a second that is new; count a repeated one that differs from the first."""
        newest = self._newest
        if newest is not None and belief.time_s <= newest.time_s:
            same = np.array_equal(belief.position_m, newest.position_m)
            self.differing += belief.time_s == newest.time_s and not same
            return
        self._newest = belief
        super().note(belief, reckoned)


Start = Callable[[SensorTape], FollowerNode | LeaderNode]


class MortalNode:
    """A node that is started again whenever its computer has died."""

    def __init__(self, start: Start, steps: Steps, tick_s: float) -> None:
        self._start, self._tick_s = start, tick_s
        self._tape, self._log = SensorTape(steps), LastingLog()
        self.log: BeliefLog = self._log
        self._done_s = -tick_s
        self.stray_frames = 0  # sent while catching up: there must be none
        self.node = self._started()

    @property
    def core(self) -> Journaled[VehicleCore]:
        """The core of the present life."""
        core = self.node.core
        assert isinstance(core, Journaled)
        return core

    @property
    def differing(self) -> int:
        """How many seconds were told again, after a kill, and not as the first time."""
        return self._log.differing

    def hear(self, frame: bytes, toa_s: float | None, now_s: float) -> None:
        """Take a frame, in as many lives as it needs."""
        self._survive(lambda: self.node.hear(frame, toa_s, now_s))

    def tick(self, now_s: float) -> bytes | None:
        """Live through one instant, in as many lives as it needs."""
        frame: bytes | None = self._survive(lambda: self.node.tick(now_s))
        self._done_s = now_s
        return frame

    def _survive(self, act: Callable[[], bytes | None]) -> bytes | None:
        while True:
            try:
                return act()
            except KilledError:
                self._restart()

    def _restart(self) -> None:
        while True:
            try:
                journal = self.core.recorder.journal
                assert isinstance(journal, MortalJournal)
                journal.abandon()
                self.node = self._started()
                self._catch_up()
            except KilledError:
                continue
            return

    def _started(self) -> FollowerNode | LeaderNode:
        node = self._start(self._tape)
        node.log = self.log
        return node

    def _catch_up(self) -> None:
        """Repeat the instants that were over but not committed; in none of them was a frame."""
        first_s = max(self.core.recorder.unfinished_from_s(self._tick_s), 0.0)
        first_s = min(first_s, self._done_s + self._tick_s)
        self._tape.rewind(first_s)
        for k in range(round((self._done_s - first_s) / self._tick_s) + 1):
            self.stray_frames += self.node.tick(first_s + k * self._tick_s) is not None
