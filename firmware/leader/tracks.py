"""The dead-reckoned track of each vehicle, as far as its states are known."""

import numpy as np

from firmware.geometry import Array
from firmware.submaps import Track

_LONGEST_S = 8 * 86_400  # one state a second; eight days are the clock's header twice over


class TrackBuffer:
    """States in the order of their times, whatever the order of their arrival; one per quarter."""

    def __init__(self) -> None:
        self._states: dict[int, tuple[float, float, float, float]] = {}
        self._fresh: list[int] = []
        self._columns: Array = np.empty((0, 4))
        self.jumps = 0
        self.overflowed = 0

    def __len__(self) -> int:
        return len(self._states)

    def add(self, time_s: float, north_m: float, east_m: float, yaw_rad: float) -> None:
        """Keep a state; a second one for the same quarter second changes nothing."""
        quarter = round(4.0 * time_s)
        if quarter in self._states:
            return
        if len(self._states) >= _LONGEST_S:
            self.overflowed += 1
            return
        self._states[quarter] = (time_s, north_m, east_m, yaw_rad)
        self._fresh.append(quarter)

    def track(self) -> Track:
        """Return all states as arrays; sorted again only when an old one arrived late."""
        if self._fresh:
            rows = np.array([self._states[quarter] for quarter in sorted(self._fresh)])
            self._fresh.clear()
            merged = np.concatenate([self._columns, rows])
            if self._columns.size and rows[0, 0] < self._columns[-1, 0]:
                merged = merged[np.argsort(merged[:, 0], kind="stable")]
            self._columns = merged
        time_s, north_m, east_m, yaw_rad = self._columns.T
        return Track(time_s=time_s, north_m=north_m, east_m=east_m, yaw_rad=yaw_rad)
