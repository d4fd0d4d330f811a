"""What every core is given and asked, whatever the role, with a journal or without."""

from typing import Protocol

from firmware.belief import Belief
from firmware.dead_reckoning import ReckonedState
from firmware.soundings import Odometry, Ping


class Navigator(Protocol):
    """The part of a core that takes what the sensors say."""

    def receive_odometry(self, odometry: Odometry) -> None:
        """Take navigation."""

    def receive_ping(self, ping: Ping) -> None:
        """Take a ping."""


class VehicleCore(Navigator, Protocol):
    """A vehicle, as a function of what it is given and when."""

    def receive_frame(self, frame: bytes, toa_s: float | None, now_s: float) -> None:
        """Take a frame and, where the modem vouches for it, the arrival of its first bit."""

    def tick(self, now_s: float) -> None:
        """Do a period's work."""

    def poll(self, now_s: float) -> bytes | None:
        """Return the frame to transmit now, or None."""

    def belief(self) -> Belief:
        """Return where the vehicle believes itself to be."""

    @property
    def reckoned(self) -> ReckonedState:
        """The newest state of raw dead reckoning."""

    def status(self) -> dict[str, int]:
        """Return every counter."""
