"""A follower that survives a kill: its inputs go to a journal before anything leaves."""

from firmware.checkpoints import NotNowError, read, written
from firmware.dead_reckoning import ReckonedState
from firmware.follower.core import FollowerCore
from firmware.follower.settings import FollowerSettings
from firmware.inputs import Heard, from_state, to_state
from firmware.journal import Journal
from firmware.recorder import CoreInputs, Recorder
from firmware.soundings import Odometry, Ping
from firmware.store_file import StoreUnusableError
from protocol.schedule import Slots

_RECORDER = "recorder"


class JournaledFollower(FollowerCore):
    """A follower's core behind its journal; resumed from it where there is something to resume.

    The start is that of a vehicle without a past. Once a minute, when no fit is at work, the core
    itself is written down: the journal stays as small as the minute since.
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
        self.recorder = Recorder(journal)
        self._made_with = (vehicle, settings, slots)
        self._checkpointed_s = start.time_s
        self._make(start)
        if journal.is_resumed:
            try:
                self._resume()
            except StoreUnusableError as error:
                journal.give_up(str(error))
                self.recorder = Recorder(journal)
                self._make(start)

    def receive_odometry(self, odometry: Odometry) -> None:
        """Record and advance."""
        fresh = self.recorder.odometry(odometry)
        if fresh is None:
            return
        epoch = self.boot_epoch
        super().receive_odometry(fresh)
        if self.boot_epoch != epoch:
            self.recorder.journal.count_epoch(self.boot_epoch)

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
        """Record and work."""
        if not self.recorder.tick(now_s):
            return
        super().tick(now_s)
        if abs(now_s - self._checkpointed_s) >= self.recorder.journal.settings.checkpoint_s:
            self._checkpoint(now_s)

    def poll(self, now_s: float) -> bytes | None:
        """Return the frame to transmit now, or None; what led to it is on disk."""
        if not self.recorder.poll(now_s):
            return self.recorder.polled(now_s)
        return self.recorder.before_sending(super().poll(now_s))

    def status(self) -> dict[str, int]:
        """Return every counter, the store's among them."""
        return {**super().status(), **self.recorder.journal.counters}

    def _make(self, start: ReckonedState) -> None:
        vehicle, settings, slots = self._made_with
        journal = self.recorder.journal
        kept = to_state(journal.start(from_state(start)))
        super().__init__(vehicle, journal.boot_epoch, kept, settings=settings, slots=slots)

    def _checkpoint(self, now_s: float) -> None:
        self._checkpointed_s = now_s
        state = {name: value for name, value in self.__dict__.items() if name != _RECORDER}
        try:
            self.recorder.journal.checkpoint(written(state, self.recorder.marks()))
        except NotNowError:
            self._checkpointed_s += 1.0 - self.recorder.journal.settings.checkpoint_s

    def _resume(self) -> None:
        body = self.recorder.journal.checkpointed()
        if body is not None:
            state, marks = read(body)
            self.__dict__.update(state)
            self.recorder.restore(marks)
        plain = CoreInputs(
            odometry=super().receive_odometry,
            ping=super().receive_ping,
            frame=super().receive_frame,
            tick=super().tick,
            poll=super().poll,
        )
        self.recorder.replay(plain, _refuse)
        if self.boot_epoch != self.recorder.journal.boot_epoch:
            self.recorder.journal.count_epoch(self.boot_epoch)


def _refuse(kind: int, body: bytes) -> None:
    del body
    raise StoreUnusableError(f"a follower has no input of kind {kind}")
