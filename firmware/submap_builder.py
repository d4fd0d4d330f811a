"""Collects a vehicle's states and soundings into sub-maps of fixed duration, in bounded memory."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from firmware.compression.binning import SoundingBins
from firmware.compression.settings import BinningSettings
from firmware.dead_reckoning import ReckonedState
from firmware.soundings import Ping, SonarSettings, soundings_from_ping
from firmware.submaps import Submap, Track
from protocol.settings import Settings, setting

_SUBMAP_NUMBERS = 1 << 16  # the header has 16 bits for the number
_OLDEST_STATE_S = 2.0  # navigation comes once a second or oftener


@dataclass(frozen=True, slots=True, kw_only=True)
class SubmapSettings(Settings):
    """How long a sub-map lasts, and what makes one worth keeping."""

    duration_s: float = setting(
        40.0, "s", "ten frames at 0.25 Hz carry it (paper, 4.1)", minimum=4.0, maximum=40.0
    )
    state_interval_s: float = setting(1.0, "s", "trajectory states once a second", minimum=0.25)
    minimum_cells: int = setting(
        50, "cells", "fewer say nothing about the relief", minimum=4, maximum=100_000
    )


class SubmapBuilder:
    """Turns states and pings into sub-maps; `take` gives one when its time is over."""

    def __init__(
        self,
        vehicle: int,
        boot_epoch: int,
        *,
        settings: SubmapSettings,
        sonar: SonarSettings,
        binning: BinningSettings,
    ) -> None:
        self._vehicle, self.boot_epoch = vehicle, boot_epoch
        self._settings, self._sonar, self._binning = settings, sonar, binning
        self._index = 0
        self._bins = SoundingBins(binning)
        self._states: list[ReckonedState] = []
        self._window: int | None = None
        self._finished: Submap | None = None
        self.bad_beams = 0
        self.bad_pings = 0
        self.submaps_overwritten = 0

    def receive_state(self, state: ReckonedState) -> None:
        """Keep the state if its second is new; close the sub-map when its window is over."""
        window = self._window_of(state)
        is_back = bool(self._states) and state.time_s < self._states[-1].time_s  # clock set back
        if self._window is not None and (window != self._window or is_back):
            self._close(state)
        self._window = window
        interval_s = self._settings.state_interval_s
        if not self._states or state.time_s - self._states[-1].time_s >= interval_s - 1e-6:
            self._states.append(state)

    def receive_ping(self, ping: Ping, state: ReckonedState) -> None:
        """Add a ping measured about a dead-reckoned state; bad beams and pings are counted.

        The vehicle went on by the state's velocity between the two. A ping without a state of its
        time and of this sub-map has no place.
        """
        if not self._states or not abs(ping.time_s - state.time_s) <= _OLDEST_STATE_S:
            self.bad_pings += 1
            return
        north_m, east_m = state.position_at(ping.time_s)
        soundings_ned_m, bad = soundings_from_ping(ping, north_m, east_m, self._sonar)
        self.bad_beams += bad
        if soundings_ned_m.size == 0:
            self.bad_pings += 1
            return
        self._bins.add(soundings_ned_m, ping.time_s)

    def tear(self, state: ReckonedState) -> None:
        """End the sub-map: nobody knows how it lies to what follows the next state received."""
        if self._states:
            self._close(state)
        self._window = self._window_of(state)

    def take(self) -> Submap | None:
        """Return the sub-map that has been finished since the last call, or None."""
        finished, self._finished = self._finished, None
        return finished

    def _close(self, next_state: ReckonedState) -> None:
        if self._finished is not None:
            self.submaps_overwritten += 1
        self._finished = Submap(
            vehicle=self._vehicle,
            boot_epoch=self.boot_epoch,
            index=self._index,
            track=track_of(self._states or [next_state]),
            bins=self._bins.result(),
        )
        self._index = (self._index + 1) % _SUBMAP_NUMBERS
        self._begin()

    def _begin(self) -> None:
        self._bins = SoundingBins(self._binning)
        self._states = []

    def _window_of(self, state: ReckonedState) -> int:
        return int(np.floor(state.time_s / self._settings.duration_s + 1e-9))


def track_of(states: list[ReckonedState]) -> Track:
    """Return the states as a track of arrays."""

    def column(
        value: Callable[[ReckonedState], float],
    ) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        return np.array([value(state) for state in states], dtype=np.float64)

    return Track(
        time_s=column(lambda s: s.time_s),
        north_m=column(lambda s: s.north_m),
        east_m=column(lambda s: s.east_m),
        yaw_rad=column(lambda s: s.yaw_rad),
    )
