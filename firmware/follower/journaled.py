"""A follower behind its journal: it writes itself down once a minute."""

import math

from firmware.dead_reckoning import ReckonedState
from firmware.follower.core import FollowerCore
from firmware.follower.settings import FollowerSettings
from firmware.journal import Journal
from firmware.journaled import Journaled
from protocol.schedule import Slots


class JournaledFollower(Journaled[FollowerCore]):
    """A follower's core behind its journal; the journal stays as small as the minute since.

    The start is that of a vehicle without a past.
    """

    def __init__(
        self,
        journal: Journal,
        vehicle: int,
        start: ReckonedState,
        *,
        settings: FollowerSettings,
        slots: Slots,
    ) -> None:
        self.vehicle = vehicle
        super().__init__(
            journal,
            start,
            lambda epoch, kept: FollowerCore(vehicle, epoch, kept, settings=settings, slots=slots),
        )
        self._checkpointed_s = -math.inf if journal.is_resumed else start.time_s

    def tick(self, now_s: float) -> None:
        """Record and work; write the core down when it is time."""
        super().tick(now_s)
        if abs(now_s - self._checkpointed_s) >= self.recorder.journal.settings.checkpoint_s:
            self._checkpointed_s = now_s
            self._checkpoint()

    def poll(self, now_s: float) -> bytes | None:
        """Return the frame to transmit now, or None; what led to it, its epoch too, is on disk."""
        frame = super().poll(now_s)
        self.recorder.journal.count_epoch(self.core.boot_epoch)
        return frame
