"""A vehicle's computer: its clock, its lives and its deaths, around whatever program runs on it."""

from collections.abc import Callable
from typing import Protocol

from host_tools.faults.catalogue import Fault, Plan
from host_tools.faults.disk import Fate, MemoryFiles
from host_tools.faults.modem import FaultyModem
from host_tools.kills import KilledError

MOST_STEP_S = 115.0
"""How far a clock is wrong at most."""


class Program(Protocol):
    """What runs on the computer, from one death to the next."""

    def step(self, now_s: float) -> None:
        """Do what is due; now_s is the computer's own time."""

    def abandon(self) -> None:
        """Be dead: give back locks, keep nothing."""


class LocalClock:
    """A clock that is right but for its faults."""

    def __init__(self, vehicle: int, plan: Plan) -> None:
        self._vehicle, self._plan = vehicle, plan
        self._is_ever_wrong = bool(plan.kinds(vehicle) & {Fault.CLOCK_AHEAD, Fault.CLOCK_BEHIND})

    def __call__(self, true_s: float) -> float:
        """Return what the clock shows, off by whole seconds."""
        if not self._is_ever_wrong:
            return true_s
        off_s = 0.0
        for fault, sign in ((Fault.CLOCK_AHEAD, 1.0), (Fault.CLOCK_BEHIND, -1.0)):
            strike = self._plan.active(fault, self._vehicle, true_s)
            if strike is not None:
                self._plan.fired[fault] += 1
                off_s += sign * (5.0 + round(strike.share * (MOST_STEP_S - 5.0)))
        return true_s + off_s


class Computer:
    """Runs a program, starts it again after each death, and tells true from local time."""

    def __init__(
        self,
        fate: Fate,
        files: MemoryFiles,
        modem: FaultyModem,
        clock: LocalClock,
        start: Callable[[float], Program],
    ) -> None:
        self.fate, self.files, self.modem, self.clock = fate, files, modem, clock
        self.deaths = 0
        self.program: Program | None = None
        self._start, self._down_until_s = start, 0.0

    def step(self, true_s: float) -> None:
        """Let one period pass."""
        self.fate.now_s = self.modem.true_s = true_s
        if true_s < self._down_until_s:
            self.modem.lose_all()
            return
        now_s = self.clock(true_s)
        try:
            if self.program is None:
                self.program = self._start(now_s)
            self.program.step(now_s)
        except KilledError:
            self._die(true_s)

    def _die(self, true_s: float) -> None:
        self.deaths += 1
        if self.program is not None:
            self.program.abandon()
        self.program = None
        self.files.after_death()
        self._down_until_s = true_s + self.fate.down_s()
