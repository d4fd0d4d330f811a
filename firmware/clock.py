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

    Ticks are whole periods. One that passes while the loop is still busy is left out and counted:
    a late step must not be followed by a burst of later ones.
    """

    def __init__(self, start_utc_s: float, end_s: float = math.inf) -> None:
        self._start_utc_s, self._end_s = start_utc_s, end_s
        self.skipped = 0

    def now_s(self) -> float:
        """Return the time; negative before the start."""
        return time.clock_gettime(time.CLOCK_REALTIME) - self._start_utc_s

    def ticks(self, period_s: float) -> Iterator[float]:
        """Yield whole periods as they come, the first one not before the start."""
        step = max(0, math.ceil(self.now_s() / period_s))
        while step * period_s <= self._end_s + 1e-9:
            wait_s = step * period_s - self.now_s()
            if wait_s > 0.0:
                time.sleep(wait_s)
            yield step * period_s
            following = max(step + 1, math.ceil(self.now_s() / period_s))
            self.skipped += following - step - 1
            step = following
