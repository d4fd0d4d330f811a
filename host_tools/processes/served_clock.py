"""A vehicle's end of the channel: a clock that is served, and a modem with times of arrival."""

import socket
import time
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from host_tools.processes.control import Advance, Arrival, ControlLine, Done, End, Hello, Refused
from protocol.crc import crc32c
from protocol.errors import ConfigError, ModemUnavailable
from protocol.modems.base import Modem, ModemEvent, ModemStatus, Reception, Tap

HANDOVER_S = 0.5
"""Of real time: a frame that has not come over the line by then is asked for again."""
NAP_S = 0.0002
CLOCK_SCHEME = "unix://"


class ChannelLine(Protocol):
    """What the clock has to know of a vehicle's line: what came over it, and what went."""

    @property
    def line_bytes(self) -> int:
        """The bytes written since the start, where they are counted; 0 where frames are."""

    def collect(self, arrivals: tuple[Arrival, ...], now_s: float) -> tuple[int, ...]:
        """Take the announced frames from the line; return the CRCs of those that did not come."""

    def frames_written(self) -> tuple[int, ...]:
        """Return the CRCs of the frames written since the last call."""


class CountedLine:
    """A dialect's line: the channel waits for its bytes, in both directions, before time goes on.

    `tap` is to be the driver's; it hands on to another.
    """

    def __init__(self, tap: Tap | None = None) -> None:
        self.line_bytes, self._next = 0, tap

    def tap(self, direction: str, data: bytes, now_s: float) -> None:
        """Count what goes out."""
        self.line_bytes += len(data) if direction == "out" else 0
        if self._next is not None:
            self._next(direction, data, now_s)

    def collect(self, arrivals: tuple[Arrival, ...], now_s: float) -> tuple[int, ...]:  # noqa: ARG002
        """Take nothing: the channel has seen the bytes at the port, the driver will read them."""
        return ()

    def frames_written(self) -> tuple[int, ...]:
        """Name no frames: the dialect has them in its sentences."""
        return ()


class StampedModem:
    """A raw line beside the channel's word on when each frame's first bit arrived."""

    line_bytes = 0

    def __init__(self, line: Modem) -> None:
        self._line = line
        self._events: deque[ModemEvent] = deque()
        self._written: deque[int] = deque()
        self._told = 0
        self.counters: Counter[str] = Counter()

    @property
    def largest_frame_bytes(self) -> int:
        """The longest frame that the line carries whole."""
        return self._line.largest_frame_bytes

    @property
    def lead_s(self) -> float:
        """A line has none."""
        return self._line.lead_s

    @property
    def frames_per_packet(self) -> int:
        """A line carries one after the other."""
        return self._line.frames_per_packet

    def send(self, frame: bytes, now_s: float, start_s: float | None = None) -> None:
        """Write a frame to the line."""
        self._written.append(crc32c(frame))
        self._line.send(frame, now_s, start_s)

    def poll(self, now_s: float) -> None:
        """Move bytes."""
        self._line.poll(now_s)

    def next_event(self) -> ModemEvent | None:
        """Return the oldest event not yet fetched, or None."""
        return self._events.popleft() if self._events else None

    def status(self) -> ModemStatus:
        """Return the line's counters, and ours."""
        status = self._line.status()
        return replace(status, errors={**status.errors, **self.counters})

    def close(self) -> None:
        """Give the port back."""
        self._line.close()

    def collect(self, arrivals: tuple[Arrival, ...], now_s: float) -> tuple[int, ...]:
        """Take the announced frames from the line; return the CRCs of those that did not come.

        A frame that nobody announced is foreign traffic: the core gets it without an arrival.
        """
        waiting = list(arrivals)
        heard: dict[int, Reception] = {}
        give_up_s = time.monotonic() + HANDOVER_S
        while True:
            self._line.poll(now_s)
            while (event := self._line.next_event()) is not None:
                if not isinstance(event, Reception):
                    self._events.append(event)
                    continue
                arrival = _taken(waiting, crc32c(event.frame))
                if arrival is None:
                    self.counters["foreign_frames"] += 1
                    self._events.append(
                        Reception(frame=event.frame, toa_s=None, heard_s=event.heard_s)
                    )
                    continue
                heard[id(arrival)] = Reception(
                    frame=event.frame, toa_s=arrival.toa_s, heard_s=arrival.heard_s
                )
            if not waiting or not self._line.status().is_up or time.monotonic() > give_up_s:
                break
            time.sleep(NAP_S)
        self._events.extend(heard[id(a)] for a in arrivals if id(a) in heard)
        return tuple(arrival.crc for arrival in waiting)

    def frames_written(self) -> tuple[int, ...]:
        """Return the CRCs of the frames that have left the line's queue since the last call.

        Those that it dropped are among them: the channel counts them as lost on the line.
        """
        status = self._line.status()
        gone = status.sent + status.dropped_out
        count, self._told = gone - self._told, gone
        return tuple(self._written.popleft() for _ in range(min(count, len(self._written))))


def _taken(waiting: list[Arrival], crc: int) -> Arrival | None:
    for k, arrival in enumerate(waiting):
        if arrival.crc == crc:
            return waiting.pop(k)
    return None


class ServedClock:
    """Time as the channel serves it; it ends when the channel says so.

    Raises
    ------
    ModemUnavailable
        When there is no channel at the address, or it goes.
    ConfigError
        When the channel refuses this vehicle.
    """

    def __init__(self, url: str, vehicle: int, mission: str, modem: "ChannelLine") -> None:
        self._url, self._modem = url, modem
        self._now_s = 0.0
        self.in_real_time = False
        self._line = _connect(url)
        self._line.send(Hello(vehicle=vehicle, mission=mission))

    def now_s(self) -> float:
        """Return the served time; in virtual time work takes none, so deadlines always hold."""
        return time.monotonic() if self.in_real_time else self._now_s

    def ticks(self, period_s: float) -> Iterator[float]:
        """Yield the times that the channel serves, which have its own period."""
        del period_s
        while True:
            if not self._line.is_open:
                raise ModemUnavailable(f"the channel at {self._url} has gone; start all again")
            for message in self._line.receive():
                if isinstance(message, End):
                    return
                if isinstance(message, Refused):
                    raise ConfigError(message.reason)
                if isinstance(message, Advance):
                    self._now_s, self.in_real_time = message.now_s, message.in_real_time
                    missed = self._modem.collect(message.arrivals, self._now_s)
                    yield self._now_s
                    frames, count = self._modem.frames_written(), self._modem.line_bytes
                    done = Done(now_s=self._now_s, frames=frames, missed=missed, line_bytes=count)
                    self._line.send(done)

    def end(self) -> None:
        """Tell the channel that this vehicle's files are written."""
        self._line.send(End())

    def close(self) -> None:
        """Cut the line."""
        self._line.close()


def _connect(url: str) -> ControlLine:
    if not url.startswith(CLOCK_SCHEME):
        raise ConfigError(f"--clock is {url!r}; give wall, or the unix:// name that channel prints")
    path = Path(url.removeprefix(CLOCK_SCHEME))
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        connection.connect(str(path))
    except OSError as error:
        connection.close()
        raise ModemUnavailable(
            f"no channel at {url} ({error.strerror or error}); start fathomlink channel first"
        ) from error
    return ControlLine(connection)
