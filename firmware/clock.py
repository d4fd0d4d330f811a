"""The clock that a vehicle's loop follows: handed in, so that a desk can serve its own time."""

import math
import time
from collections.abc import Iterator
from typing import Protocol


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
    the clock is set back, ticks go on from what it then shows.
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
                due = self._due_step(period_s)
                if abs(due - step) > 1:  # it was; one that is only slewed is waited for
                    self.set_back += due < step
                    self.skipped += max(0, due - step)
                    step = due
                continue
            yield step * period_s
            following = max(step + 1, self._due_step(period_s))
            self.skipped += following - step - 1
            step = following

    def status(self) -> dict[str, int]:
        """Return the counters: ticks left out, and how often the clock was set back."""
        return {"clock_ticks_skipped": self.skipped, "clock_set_back": self.set_back}

    def _due_step(self, period_s: float) -> int:
        """Return which whole period ends now or next, none before the start."""
        return max(0, math.ceil(self.now_s() / period_s))
