"""Runs any dialect core over a serial port, behind the interface of all modems.

To write a dialect: a core class with the members of `Core`, a tree of settings, and an opener that
hands both to `open_dialect`. The driver only moves bytes; the core does the talking. What is in
the core's outbox survives a port that goes and comes back, and a modem that is power-cycled.
"""

import dataclasses
from collections import deque
from collections.abc import Callable, Mapping
from typing import Protocol, TypeVar

from protocol.errors import ConfigError, ModemError, ModemTimeout
from protocol.modems.base import (
    QUEUED_EVENTS,
    LinkNotice,
    ModemContext,
    ModemEvent,
    ModemStatus,
    ModemUrl,
    Reception,
    Tap,
)
from protocol.modems.events import (
    DialectEvent,
    FrameDropped,
    FrameHeard,
    LinkQuality,
    ModemComplaint,
    ModemRestarted,
)
from protocol.modems.identify import IDENTIFY_S, Identification
from protocol.modems.outbox import Outbox
from protocol.modems.port import SerialPort
from protocol.settings import Settings, replace

QUALITY_PACKETS = 8.0
"""The quality is averaged over about this many packets: half a minute of a full link."""
REPEAT_NOTICE_S = 10.0
"""A notice that says the same as the last one within this time is left out: no storm."""
ALIVE_QUERY_S = 10.0
"""Silence after which a core asks its modem whether it is there, and still has our address."""
FAILURES_TO_DEATH = 5
"""Packets in a row without an answer before a core takes its modem for gone."""
LONGEST_PAUSE_S = 16.0
"""Cap of a core's pause after refusals, which doubles with each."""
REQUESTS_CAP = 16
"""Cap of ranges and the like that are asked of a core and not yet of its modem."""
EVENTS_CAP = 512
"""Cap of a core's events that nobody fetches: a minute of rate 5 is about 200; older ones go."""

SET_BACK_S = 1.0
"""A clock that is set back by less only makes what waits for a time wait longer by as much."""

S = TypeVar("S", bound=Settings)


class Core(Protocol):
    """A dialect without I/O: bytes and time in, bytes and events out; nothing received raises."""

    name: str
    identified: bool
    outbox: Outbox
    frame_bytes: int
    frames_per_packet: int

    @property
    def ready(self) -> bool:
        """Whether the modem is configured and answers."""

    @property
    def lead_s(self) -> float:
        """How long before its second of transmission a full packet must be handed over."""

    def receive_data(self, data: bytes, now_s: float) -> None:
        """Take what the modem said."""

    def poll(self, now_s: float) -> bytes:
        """Return what must be said to the modem now."""

    def next_event(self) -> DialectEvent | None:
        """Return the oldest event not yet fetched."""

    def next_wakeup_s(self, now_s: float) -> float:
        """Return when `poll` will next have something to do."""

    def send(self, frame: bytes, now_s: float, start_s: float | None = None) -> None:
        """Queue a frame, to start at start_s or as soon as can be."""

    def ping(self, peer: int) -> None:
        """Ask for a two-way range."""

    def lost(self, now_s: float) -> None:
        """Note that the port is gone or the clock was set back: nothing waits for a time now."""

    def status(self) -> dict[str, int]:
        """Return every counter."""


class DialectDriver:
    """A `Modem` made of a core and a port; `core` is there for what only a dialect has."""

    def __init__(self, core: Core, port: SerialPort, tap: Tap | None = None) -> None:
        self.core, self._port, self._tap = core, port, tap
        self._identification = Identification(core.name, port.path, port.baud)
        self._was_open, self._polled_s = True, float("-inf")
        self._events: deque[ModemEvent] = deque()
        self._reports: deque[DialectEvent] = deque(maxlen=QUEUED_EVENTS)
        self._received = self._dropped_in = 0
        self._quality: float | None = None
        self._last_notice = LinkNotice(text="", at_s=0.0)

    @property
    def largest_frame_bytes(self) -> int:
        """The longest frame that the modem carries whole."""
        return self.core.frame_bytes

    @property
    def lead_s(self) -> float:
        """How long before its second of transmission a full packet must be handed over."""
        return self.core.lead_s

    @property
    def frames_per_packet(self) -> int:
        """How many frames one packet takes, when they are handed over together."""
        return self.core.frames_per_packet

    @property
    def verdict(self) -> str | None:
        """One line on why no modem of this dialect answers; None when one does, or in the dark."""
        return self._identification.verdict

    def send(self, frame: bytes, now_s: float, start_s: float | None = None) -> None:
        """Queue a frame; the oldest goes when the queue is full.

        A loop with slots hands a frame over `lead_s` before its slot and names the slot's second;
        without start_s the frame starts as soon as can be. Either way it is stamped with the second
        on which it really starts.

        Raises
        ------
        LocalProtocolError
            For a frame larger than `largest_frame_bytes`.
        """
        self._report("send", frame, now_s if start_s is None else start_s)
        self.core.send(frame, now_s, start_s)

    def poll(self, now_s: float) -> None:
        """Move bytes both ways; never blocks, never raises.

        A clock that was set back leaves the modem's own wrong, and whatever waits for a time: the
        conversation begins again.
        """
        if now_s < self._polled_s - SET_BACK_S:
            self._lose(now_s)
        self._polled_s = now_s
        if self._port.try_reopen(now_s):
            self._notice(f"{self._port.path} is back", now_s)
        data = self._port.read(now_s)
        if data:
            if not self.core.identified:
                self._identification.receive_data(data)
            self.core.receive_data(data, now_s)
        if self._port.is_open:
            due = self.core.next_wakeup_s(now_s) <= now_s
            output = self.core.poll(now_s)
            if due or output or self.core.outbox:  # what waits is planned by when polls come
                self._report("poll", b"", now_s)
            output += self._identification.poll(now_s, identified=self.core.identified)
            self._port.write(output, now_s)
        if self._was_open and not self._port.is_open:
            self._lose(now_s)
            why = self._port.last_error
            self._notice(f"{self._port.path} has gone ({why}); waiting for it", now_s)
        self._was_open = self._port.is_open
        while (event := self.core.next_event()) is not None:
            self._sort(event, now_s)

    def next_event(self) -> ModemEvent | None:
        """Return the oldest frame or notice not yet fetched, or None."""
        return self._events.popleft() if self._events else None

    def next_report(self) -> DialectEvent | None:
        """Return the oldest of all other events: frames sent, ranges, quality, mini-packets."""
        return self._reports.popleft() if self._reports else None

    def status(self) -> ModemStatus:
        """Return the counters."""
        counters = self.core.status()
        return ModemStatus(
            is_up=self._port.is_open and self.core.ready,
            queued=len(self.core.outbox),
            sent=counters.get("confirmed", 0),
            received=self._received,
            dropped_out=counters.get("dropped", 0),
            dropped_in=self._dropped_in,
            discarded=counters.get("damaged_lines", 0) + counters.get("skipped_bytes", 0),
            reopened=self._port.reopened,
            quality=self._quality,
            errors=counters,
        )

    def close(self) -> None:
        """Give the port back."""
        self._port.close()
        self._was_open = False

    def _lose(self, now_s: float) -> None:
        self._report("lost", b"", now_s)
        self.core.lost(now_s)

    def _sort(self, event: DialectEvent, now_s: float) -> None:
        match event:
            case FrameHeard():
                self._received += 1
                self._push(
                    Reception(
                        frame=event.frame,
                        toa_s=event.toa_s,
                        heard_s=event.heard_s,
                        source=event.source,
                    )
                )
            case ModemRestarted():
                self._notice("modem restarted; what was on its way is queued again", now_s)
            case ModemComplaint(text=text):
                self._notice(text, now_s)
            case FrameDropped(reason=reason):
                self._notice(f"frame dropped: {reason}", now_s)
                self._reports.append(event)
            case LinkQuality(quality_share=share) if share is not None:
                last = share if self._quality is None else self._quality
                self._quality = last + (share - last) / QUALITY_PACKETS
                self._reports.append(event)
            case _:
                self._reports.append(event)

    def _notice(self, text: str, now_s: float) -> None:
        same = text == self._last_notice.text
        if same and abs(now_s - self._last_notice.at_s) < REPEAT_NOTICE_S:
            return
        self._last_notice = LinkNotice(text=text, at_s=now_s)
        self._push(self._last_notice)

    def _push(self, event: ModemEvent) -> None:
        if len(self._events) == QUEUED_EVENTS:
            self._events.popleft()
            self._dropped_in += 1
        self._events.append(event)

    def _report(self, direction: str, data: bytes, now_s: float) -> None:
        if self._tap is not None:
            self._tap(direction, data, now_s)


def settings_from_url(url: ModemUrl, defaults: S) -> S:
    """Return a dialect's settings with the URL's options in them.

    Raises
    ------
    ConfigError
        For an unknown key, an unreadable value or one out of bounds, and a missing port.
    """
    if not url.path:
        raise ConfigError(f"{url.text} names no port; write e.g. {url.scheme}:///dev/ttyUSB0")
    known = [field.name for field in dataclasses.fields(defaults)]
    for name in url.query:
        if name not in known:
            raise ConfigError(f"{url.text}: unknown option {name!r}; known are {', '.join(known)}")
    try:
        return replace(defaults, dict(url.query))
    except ConfigError as error:
        raise ConfigError(f"{url.text}: {error}") from error


def open_dialect(
    url: ModemUrl, context: ModemContext, baud: int, make_core: Callable[[], Core]
) -> DialectDriver:
    """Return the driver of a dialect on the URL's port.

    Raises
    ------
    ModemUnavailable
        When the port is not there, not ours to open, or in use.
    """
    return DialectDriver(make_core(), SerialPort(url.path, baud, context.tap), context.tap)


def await_identified(
    driver: DialectDriver, clock: Callable[[], float], pause: Callable[[float], None]
) -> Mapping[str, int]:
    """Poll until a modem of the dialect has answered; return its counters.

    Raises
    ------
    ModemError
        With one line that says what to do: wrong speed, another dialect.
    ModemTimeout
        The same, when nothing at all was heard.
    """
    end_s = clock() + IDENTIFY_S + 1.0
    while not driver.core.identified and clock() < end_s:
        driver.poll(clock())
        if driver.verdict is not None:
            silent = "no answer" in driver.verdict
            raise ModemTimeout(driver.verdict) if silent else ModemError(driver.verdict)
        pause(0.01)
    return driver.core.status()


def check_frame_size(modem_bytes: int, frame_bytes: int, name: str) -> None:
    """Raise ConfigError, in one line, when a profile's frames do not fit a modem's."""
    if frame_bytes > modem_bytes:
        raise ConfigError(
            f"profile {name} has frames of {frame_bytes} bytes, this modem carries {modem_bytes};"
            " take profile lattice in its 62-byte size"
            " (follower.compression.small_frames=true), or a Micro-Modem at rate 3, 4 or 5"
        )
