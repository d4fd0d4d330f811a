"""Writes a core's inputs to its journal, and knows which of them a restart asks for again.

After a restart the ports may repeat what the journal already holds: the sensors' last steps, frames
that were taken but not acknowledged, the instant that was cut short. A repeat is answered as the
first time, without the core.
"""

from collections import deque
from typing import Any

from firmware.inputs import (
    Heard,
    Kind,
    fan_of,
    from_heard,
    from_instant,
    from_odometry,
    from_ping,
    to_heard,
    to_instant,
    to_odometry,
    to_ping,
)
from firmware.journal import Journal
from firmware.soundings import Odometry, Ping

_NEVER_S = -float("inf")
_HEARD_AGAIN = 256  # frames that a modem may hand over a second time: its own cap of events


class Recorder:
    """Appends inputs; every method says what, if anything, the core is to be given."""

    def __init__(self, journal: Journal) -> None:
        self.journal = journal
        self.last_tick_s = self.last_odometry_s = _NEVER_S
        self._last_ping_s = self._committed_s = _NEVER_S
        self._fan: bytes | None = None
        self._heard: deque[Heard] = deque(maxlen=_HEARD_AGAIN)
        self._polled: tuple[float, bytes | None] = (_NEVER_S, None)
        self._resumed_s: float | None = None  # the last instant of the journal, until passed

    def unfinished_from_s(self, tick_s: float) -> float:
        """Return the first instant that the journal does not hold to its end: its poll.

        A modem that was away was not polled; then only the last instant is in question. One with a
        lead was polled for a later instant than that.
        """
        was_polled = self._polled[0] >= self.last_tick_s
        return self.last_tick_s + tick_s if was_polled else self.last_tick_s

    def odometry(self, odometry: Odometry) -> Odometry | None:
        """Record navigation; None for what the journal already holds."""
        if self._resumed_s is not None and odometry.time_s <= self.last_odometry_s:
            return None
        self.last_odometry_s = odometry.time_s
        self.journal.append(Kind.ODOMETRY, from_odometry(odometry))
        return odometry

    def ping(self, ping: Ping) -> Ping | None:
        """Record a ping and return it as a replay will see it; None for a known one."""
        if self._resumed_s is not None and ping.time_s <= self._last_ping_s:
            return None
        self._last_ping_s = ping.time_s
        fan, body = fan_of(ping), from_ping(ping)
        if fan != self._fan:
            self._fan = fan
            self.journal.append(Kind.FAN, fan)
        self.journal.append(Kind.PING, body)
        return to_ping(body, fan)

    def frame(self, heard: Heard) -> bool:
        """Put a frame on disk: the caller may acknowledge it; False for a known one."""
        if self._resumed_s is not None and heard in self._heard:
            self.journal.counters["store_frames_repeated"] += 1
            return False
        self._heard.append(heard)
        self.journal.append(Kind.FRAME, from_heard(heard))
        self.journal.commit()
        return True

    def tick(self, now_s: float) -> bool:
        """Record an instant, and commit when it is time; False for a known one."""
        if self._resumed_s is not None and now_s <= self.last_tick_s:
            return False
        self.last_tick_s = now_s
        self.journal.append(Kind.TICK, from_instant(now_s))
        if abs(now_s - self._committed_s) >= self.journal.settings.commit_s:
            self._committed_s = now_s
            self.journal.commit()
        return True

    def note(self, kind: Kind, body: bytes = b"") -> None:
        """Record what only one sort of core is asked."""
        self.journal.append(kind, body)

    def poll(self, now_s: float) -> bool:
        """Record that the core is asked for a frame; False when the answer is known."""
        if self._resumed_s is not None:
            if now_s <= self._polled[0]:
                return False
            self._resumed_s = None
        self.journal.append(Kind.POLL, from_instant(now_s))
        self._polled = (now_s, None)
        return True

    def polled(self, now_s: float) -> bytes | None:
        """Return what the core answered when it was asked at this instant before the restart."""
        return self._polled[1] if now_s == self._polled[0] else None

    def before_sending(self, frame: bytes | None) -> bytes | None:
        """Return the core's frame, with everything that led to it on disk."""
        if frame is not None:
            self._polled = (self._polled[0], frame)
            self.journal.commit()
        return frame

    # checkpoints

    def marks(self) -> tuple[object, ...]:
        """Return what a checkpoint must hold of the recorder; the fan is written anew after it."""
        self._fan = None
        ends_s = (self.last_tick_s, self.last_odometry_s, self._last_ping_s)
        return (*ends_s, self._polled, list(self._heard))

    def restore(self, marks: tuple[Any, ...]) -> None:
        """Go back to the marks of a checkpoint."""
        self.last_tick_s, self.last_odometry_s, self._last_ping_s, self._polled, heard = marks
        self._committed_s = self.last_tick_s
        self._heard.extend(heard)

    # replay

    def replayed_odometry(self, body: bytes) -> Odometry:
        """Return navigation of the journal."""
        odometry = to_odometry(body)
        self.last_odometry_s = odometry.time_s
        return odometry

    def replayed_fan(self, body: bytes) -> None:
        """Take the beams' angles of the pings that follow."""
        self._fan = body

    def replayed_ping(self, body: bytes) -> Ping:
        """Return a ping of the journal."""
        ping = to_ping(body, self._fan or b"")
        self._last_ping_s = ping.time_s
        return ping

    def replayed_frame(self, body: bytes) -> Heard:
        """Return a frame of the journal."""
        heard = to_heard(body)
        self._heard.append(heard)
        return heard

    def replayed_tick(self, body: bytes) -> float:
        """Return an instant of the journal."""
        self.last_tick_s = self._committed_s = to_instant(body)
        return self.last_tick_s

    def replayed_poll(self, now_s: float, frame: bytes | None) -> None:
        """Keep what the core answers at an instant of the journal."""
        self._polled = (now_s, frame)

    def resume(self) -> None:
        """Go on from the journal's end."""
        self._resumed_s = self.last_tick_s
        self.journal.counters["store_resumed"] += 1
