"""The clock that a vehicle's loop follows: handed in, so that a desk can serve its own time."""

import math
import time
from collections.abc import Iterator
from typing import Protocol

LEAP_S = 10.0
"""A clock that goes on by more at once was set: no step of a loop takes so long."""
DOUBTED_S = 600.0
"""A leap past the mission's end is believed after this time: until then it may be set right."""


class Clock(Protocol):
    """Mission time, in seconds since the start that all vehicles share."""

    def now_s(self) -> float:
        """Return the time."""

    def ticks(self, period_s: float) -> Iterator[float]:
        """Yield the times at which the loop is to run, waiting for each, until the mission ends."""


class WallClock:
    """Mission time by the computer's UTC clock, which GNSS or a chip-scale clock disciplines.

    Ticks are whole periods. One that passes while the loop is still busy, or that the clock leaps
    over, is left out and counted: a late step must not be followed by a burst of later ones. Where
    the clock is set back, ticks go on from what it then shows. One that leaps past the mission's
    end ends it only if it stays there.
    """

    def __init__(self, start_utc_s: float, end_s: float = math.inf) -> None:
        self._start_utc_s, self._end_s = start_utc_s, end_s
        self.skipped = self.set_back = 0

    def now_s(self) -> float:
        """Return the time; negative before the start."""
        return time.clock_gettime(time.CLOCK_REALTIME) - self._start_utc_s

    def ticks(self, period_s: float) -> Iterator[float]:
        """Yield whole periods as they come, the first one not before the start."""
        step = self._due_step(period_s)
        while step * period_s <= self._end_s + 1e-9:
            wait_s = step * period_s - self.now_s()
            if wait_s > 0.0:
                time.sleep(min(wait_s, period_s))  # no longer: the clock may be set meanwhile
                due = self._doubted_step(step, period_s)
                if abs(due - step) > 1:  # it was; one that is only slewed is waited for
                    self.set_back += due < step
                    self.skipped += max(0, due - step)
                    step = due
                continue
            yield step * period_s
            following = max(step + 1, self._doubted_step(step, period_s))
            self.skipped += following - step - 1
            step = following

    def status(self) -> dict[str, int]:
        """Return the counters: ticks left out, and how often the clock was set back."""
        return {"clock_ticks_skipped": self.skipped, "clock_set_back": self.set_back}

    def _doubted_step(self, step: int, period_s: float) -> int:
        """Return the period that is due after a step; wait while only a leap has ended them all."""
        latest = max(self._end_s / period_s, step + LEAP_S / period_s)
        for _ in range(math.ceil(DOUBTED_S / period_s)):
            if self._due_step(period_s) <= latest:
                break
            time.sleep(period_s)
        return self._due_step(period_s)

    def _due_step(self, period_s: float) -> int:
        """Return which whole period ends now or next, none before the start."""
        return max(0, math.ceil(self.now_s() / period_s))
