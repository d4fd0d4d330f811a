"""The dead-reckoned track of each vehicle, as far as its states are known."""

import math

import numpy as np

from firmware.geometry import Array
from firmware.submaps import Track

_QUANTISED_M = 3.0  # `lattice` tells positions to within a metre or so
_NEIGHBOURS_S = 10
_LONGEST_S = 8 * 86_400  # one state a second; eight days are the clock's header twice over


class TrackBuffer:
    """States in the order of their times, whatever the order of their arrival; one per quarter."""

    def __init__(self) -> None:
        self._states: dict[int, tuple[float, float, float, float]] = {}
        self._fresh: list[int] = []
        self._columns: Array = np.empty((4, 0))
        self._newest: int | None = None
        self.overflowed = 0

    def __len__(self) -> int:
        return int(self._columns.shape[1]) + len(self._fresh)

    def add(self, time_s: float, north_m: float, east_m: float, yaw_rad: float) -> None:
        """Keep a state; a second one for the same quarter second changes nothing."""
        quarter = round(4.0 * time_s)
        if quarter in self._states:
            return
        if len(self) >= _LONGEST_S:
            self.overflowed += 1
            return
        self._states[quarter] = (time_s, north_m, east_m, yaw_rad)
        self._fresh.append(quarter)
        self._newest = quarter if self._newest is None else max(quarter, self._newest)

    def is_plausible(
        self, time_s: float, north_m: float, east_m: float, fastest_mps: float
    ) -> bool:
        """Return whether a vehicle so fast can have been there, by its states around that time."""
        here = round(4.0 * time_s)
        near = range(1, 4 * _NEIGHBOURS_S + 1)
        before = next((here - k for k in near if here - k in self._states), self._newest)
        after = next((here + k for k in near if here + k in self._states), None)
        for quarter in (before, after):
            if quarter is None:
                continue
            at_s, at_north_m, at_east_m, _ = self._states[quarter]
            moved_m = math.hypot(north_m - at_north_m, east_m - at_east_m)
            if moved_m > fastest_mps * abs(time_s - at_s) + _QUANTISED_M:
                return False
        return True

    def forget_from(self, time_s: float) -> None:
        """Forget the states from a time on: the clock was set back to it."""
        self.track()
        self._columns = np.ascontiguousarray(self._columns[:, self._columns[0] < time_s])
        self._states = {
            quarter: state for quarter, state in self._states.items() if state[0] < time_s
        }
        self._newest = max(self._states, default=None)

    def track(self) -> Track:
        """Return all states as arrays; sorted again only when an old one arrived late."""
        if self._fresh:
            rows = np.array([self._states[quarter] for quarter in sorted(self._fresh)]).T
            self._fresh.clear()
            merged = np.concatenate([self._columns, rows], axis=1)
            if self._columns.size and rows[0, 0] < self._columns[0, -1]:
                merged = merged[:, np.argsort(merged[0], kind="stable")]
            self._columns = np.ascontiguousarray(merged)  # or each look-up copies a day
        time_s, north_m, east_m, yaw_rad = self._columns
        return Track(time_s=time_s, north_m=north_m, east_m=east_m, yaw_rad=yaw_rad)

    def settle(self, before_s: float) -> None:
        """Forget which states before a time are known: none of them will come again.

        The newest is kept, however old: after a long silence the next one is checked against it.
        """
        self.track()
        self._states = {
            quarter: state
            for quarter, state in self._states.items()
            if quarter >= 4.0 * before_s or quarter == self._newest
        }
