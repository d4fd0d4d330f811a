"""Writes a core's inputs to its journal, and knows which of them a restart asks for again.

After a restart the ports may repeat what the journal already holds: the sensors' last steps, frames
that were taken but not acknowledged, the instant that was cut short. A repeat is answered as the
first time, without the core. It lies just before the journal's end; what is farther back in time
comes by a clock that was set back, and is new.
"""

import logging
import math
from collections import deque
from collections.abc import Callable
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
from firmware.store_file import StoreUnusableError
from firmware.vehicle_core import VehicleCore

LOG = logging.getLogger(__name__)
_NEVER_S = -float("inf")
_REPEATED_S = 5.0  # before the journal's end; a commit a second leaves less to be repeated
_STRAY_S = 60.0  # a stamp this far from the sensor's last one and from the clock is wrong
_HEARD_AGAIN = 256  # frames that a modem may hand over a second time: its own cap of events


class Recorder:
    """Appends inputs; every method says what, if anything, the core is to be given."""

    def __init__(self, journal: Journal) -> None:
        self.journal = journal
        self.last_tick_s = self.last_odometry_s = _NEVER_S
        self._last_ping_s = self._committed_s = _NEVER_S
        self._fan: bytes | None = None
        self._heard: deque[Heard] = deque(maxlen=_HEARD_AGAIN)
        self._polled: tuple[float, list[bytes | None]] = (_NEVER_S, [])
        self._again: deque[bytes | None] = deque()  # of them, still to be given once more
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
        if self._is_known(odometry.time_s, self.last_odometry_s):
            return None
        self.last_odometry_s = self._end_s(odometry.time_s, self.last_odometry_s)
        self.journal.append(Kind.ODOMETRY, from_odometry(odometry))
        return odometry

    def ping(self, ping: Ping) -> Ping | None:
        """Record a ping and return it as a replay will see it; None for a known one."""
        if self._is_known(ping.time_s, self._last_ping_s):
            return None
        self._last_ping_s = self._end_s(ping.time_s, self._last_ping_s)
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
        if self._is_known(now_s, self.last_tick_s):
            return False
        if self._resumed_s is not None and now_s < self.last_tick_s:
            self._resumed_s = None
            self.journal.counters["store_clock_set_back"] += 1
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
        last_s, _ = self._polled
        if self._is_known(now_s, last_s) and (self._again or now_s < last_s):
            return False
        self._ask(now_s)
        self.journal.append(Kind.POLL, from_instant(now_s))
        return True

    def polled(self, now_s: float) -> bytes | None:
        """Return what the core answered at this instant before the restart: each answer once."""
        return self._again.popleft() if now_s == self._polled[0] else None

    def before_sending(self, frame: bytes | None) -> bytes | None:
        """Return the core's frame, with everything that led to it on disk."""
        self._polled[1].append(frame)
        if frame is not None:
            self.journal.commit()
        return frame

    def _ask(self, now_s: float) -> None:
        """Begin the answers of an instant, unless it goes on; a new one is beyond the journal."""
        if now_s != self._polled[0]:
            self._polled, self._resumed_s = (now_s, []), None

    def _is_known(self, time_s: float, end_s: float) -> bool:
        """Return whether the journal, which ends at a time, holds what comes after a restart."""
        return self._resumed_s is not None and end_s - _REPEATED_S <= time_s <= end_s

    def _end_s(self, time_s: float, end_s: float) -> float:
        """Return where a sensor's record ends now: a stamp that is wrong leaves its end."""
        if end_s == _NEVER_S:
            return time_s if math.isfinite(time_s) else end_s
        is_near = abs(time_s - end_s) <= _STRAY_S or abs(time_s - self.last_tick_s) <= _STRAY_S
        return time_s if is_near else end_s

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

    def replay(self, core: VehicleCore, other: Callable[[int, bytes], None]) -> None:
        """Give a core what the journal holds, and what only its sort is asked to the other.

        Raises StoreUnusableError for a record that is none. Whatever else an input raises, it
        raised when it came for the first time as well, and the mission went on.
        """
        for kind, body in self.journal.replay():
            try:
                self._replay(kind, body, core, other)
            except StoreUnusableError:
                raise
            except Exception:
                self.journal.counters["store_inputs_failed"] += 1
                LOG.exception("an input failed again in the replay")
        self._resumed_s, self._again = self.last_tick_s, deque(self._polled[1])
        self.journal.counters["store_resumed"] += 1

    def _replay(
        self, kind: int, body: bytes, core: VehicleCore, other: Callable[[int, bytes], None]
    ) -> None:
        match kind:
            case Kind.ODOMETRY:
                odometry = to_odometry(body)
                self.last_odometry_s = self._end_s(odometry.time_s, self.last_odometry_s)
                core.receive_odometry(odometry)
            case Kind.PING:
                ping = to_ping(body, self._fan or b"")
                self._last_ping_s = self._end_s(ping.time_s, self._last_ping_s)
                core.receive_ping(ping)
            case Kind.FAN:
                self._fan = body
            case Kind.FRAME:
                heard = to_heard(body)
                self._heard.append(heard)
                core.receive_frame(heard.frame, heard.toa_s, heard.now_s)
            case Kind.TICK:
                self.last_tick_s = self._committed_s = to_instant(body)
                core.tick(self.last_tick_s)
            case Kind.POLL:
                now_s = to_instant(body)
                self._ask(now_s)
                self._polled[1].append(core.poll(now_s))
            case _:
                other(kind, body)
