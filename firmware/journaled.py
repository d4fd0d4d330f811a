"""A core that survives a kill: its inputs go to a journal before anything leaves.

From time to time the core itself is written down, and only what comes later is replayed.
"""

from collections.abc import Callable
from typing import Generic, TypeVar

from firmware.belief import Belief
from firmware.checkpoints import read, written
from firmware.dead_reckoning import ReckonedState
from firmware.inputs import Heard, from_state, to_state
from firmware.journal import Journal
from firmware.recorder import Recorder
from firmware.soundings import Odometry, Ping
from firmware.store_file import StoreUnusableError
from firmware.vehicle_core import VehicleCore

Core_co = TypeVar("Core_co", bound=VehicleCore, covariant=True)


class Journaled(Generic[Core_co]):
    """A core behind its journal; resumed from it where there is something to resume.

    The core may be read past the journal, but is given and asked nothing there that changes it.
    make returns one without a past, of a boot epoch and a start.
    """

    def __init__(
        self, journal: Journal, start: ReckonedState, make: Callable[[int, ReckonedState], Core_co]
    ) -> None:
        self._make = make
        self._begin(journal, start)
        if journal.is_resumed:
            try:
                self._resume()
            except StoreUnusableError as error:
                journal.give_up(str(error))
                self._begin(journal, start)

    def receive_odometry(self, odometry: Odometry) -> None:
        """Record and advance."""
        fresh = self.recorder.odometry(odometry)
        if fresh is not None:
            self.core.receive_odometry(fresh)

    def receive_ping(self, ping: Ping) -> None:
        """Record and add a ping."""
        fresh = self.recorder.ping(ping)
        if fresh is not None:
            self.core.receive_ping(fresh)

    def receive_frame(self, frame: bytes, toa_s: float | None, now_s: float) -> None:
        """Take a frame and the arrival of its first bit; both are on disk when this returns."""
        if self.recorder.frame(Heard(frame=frame, toa_s=toa_s, now_s=now_s)):
            self.core.receive_frame(frame, toa_s, now_s)

    def tick(self, now_s: float) -> None:
        """Record and work."""
        if self.recorder.tick(now_s):
            self.core.tick(now_s)

    def poll(self, now_s: float) -> bytes | None:
        """Return the frame to transmit now, or None; what led to it is on disk."""
        if not self.recorder.poll(now_s):
            return self.recorder.polled(now_s)
        return self.recorder.before_sending(self.core.poll(now_s))

    def belief(self) -> Belief:
        """Return where the vehicle believes itself to be."""
        return self.core.belief()

    @property
    def reckoned(self) -> ReckonedState:
        """The newest state of raw dead reckoning."""
        return self.core.reckoned

    def status(self) -> dict[str, int]:
        """Return every counter, the store's among them."""
        return {**self.core.status(), **self.recorder.journal.counters}

    def _begin(self, journal: Journal, start: ReckonedState) -> None:
        """Begin without a past."""
        self.recorder = Recorder(journal)
        self.core = self._make(journal.boot_epoch, to_state(journal.start(from_state(start))))
        self._take_up()

    def _resume(self) -> None:
        body = self.recorder.journal.checkpointed()
        if body is not None:
            self.core, marks = read(body, type(self.core))
            self.recorder.restore(marks)
            self._take_up()
        self.recorder.replay(self.core, self._replay)

    def _take_up(self) -> None:
        """Join to the core, made or read, what is not written down with it."""

    def _replay(self, kind: int, body: bytes) -> None:
        """Give the core again what only its sort is given."""
        del body
        raise StoreUnusableError(f"this vehicle has no input of kind {kind}")

    def _checkpoint(self) -> None:
        """Write the core down."""
        self.recorder.journal.checkpoint(written(self.core, self.recorder.marks()))


def bare(core: Core_co | Journaled[Core_co]) -> Core_co:
    """Return a core itself, to be read, be it behind a journal or not."""
    return core.core if isinstance(core, Journaled) else core
