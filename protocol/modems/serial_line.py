"""A raw serial line: COBS frames over pyserial, on ports that may vanish and come back."""

from collections import deque

from protocol.errors import ConfigError
from protocol.framing import GUARD_BYTES, LineReader, wrap
from protocol.modems.base import (
    QUEUED_EVENTS,
    QUEUED_FRAMES,
    LinkNotice,
    Modem,
    ModemContext,
    ModemEvent,
    ModemStatus,
    ModemUrl,
    Reception,
    Tap,
)
from protocol.modems.port import SerialPort

DEFAULT_BAUD = 19_200
SLOWEST_BAUD, FASTEST_BAUD = 300, 4_000_000
LATE_S = 0.5
"""A frame that the line has not taken so long after its second would give a wrong range."""


class SerialLineModem:
    """Moves frames over one port; while it is away or full, frames wait in the bounded queue.

    A frame leaves the queue when its last byte was taken by the operating system; one that was cut
    by a vanishing port is sent again from its start. One that is stamped with a second does not
    wait for longer than LATE_S.
    """

    lead_s = 0.0
    frames_per_packet = 1

    def __init__(self, path: str, baud: int, tap: Tap | None = None) -> None:
        self._port, self._was_open = SerialPort(path, baud, tap, rts=True), True
        self.bytes_read = 0
        self._reader = LineReader()
        self._queue: deque[tuple[bytes, float | None]] = deque()  # and the second of its stamp
        self._written = 0
        self._events: deque[ModemEvent] = deque()
        self._sent = self._received = self._dropped_out = self._dropped_in = 0

    @property
    def largest_frame_bytes(self) -> int:
        """The longest frame that the line carries whole: the guard less COBS's overhead."""
        return GUARD_BYTES - 4

    def send(self, frame: bytes, now_s: float, start_s: float | None = None) -> None:
        """Queue a frame; when the queue is full the oldest one not yet begun is dropped."""
        if len(self._queue) == QUEUED_FRAMES:
            del self._queue[1 if self._written else 0]
            self._dropped_out += 1
        self._queue.append((wrap(frame), start_s))
        self._flush(now_s)

    def poll(self, now_s: float) -> None:
        """Reopen a lost port, write what the port takes, read what it has."""
        if self._port.try_reopen(now_s):
            self._was_open = True
            self._notice(f"{self._port.path} is back", now_s)
        self._flush(now_s)
        self._take(now_s)

    def next_event(self) -> ModemEvent | None:
        """Return the oldest event not yet fetched, or None."""
        return self._events.popleft() if self._events else None

    def status(self) -> ModemStatus:
        """Return the counters."""
        return ModemStatus(
            is_up=self._port.is_open,
            queued=len(self._queue),
            sent=self._sent,
            received=self._received,
            dropped_out=self._dropped_out,
            dropped_in=self._dropped_in + self._reader.overflowed,
            discarded=self._reader.bad_frames + self._reader.overlong,
            reopened=self._port.reopened,
        )

    def close(self) -> None:
        """Give the port back."""
        self._port.close()
        self._was_open = False

    def _flush(self, now_s: float) -> None:
        self._drop_late(now_s)
        while self._queue:
            frame, _ = self._queue[0]
            self._written += self._port.push(frame[self._written :], now_s)
            if self._written < len(frame):
                break
            self._queue.popleft()
            self._written = 0
            self._sent += 1
        self._note_loss(now_s)

    def _drop_late(self, now_s: float) -> None:
        """Drop frames whose second has passed, and what waits before them in the system."""
        timely = [(f, s) for f, s in self._queue if s is None or abs(now_s - s) <= LATE_S]
        late = len(self._queue) - len(timely)
        if late:
            self._dropped_out += late
            self._queue, self._written = deque(timely), 0
            self._port.discard_output(now_s)

    def _take(self, now_s: float) -> None:
        data = self._port.read(now_s)
        self.bytes_read += len(data)
        self._reader.receive_data(data, now_s)
        while (heard := self._reader.next_frame()) is not None:
            self._received += 1
            self._push(Reception(frame=heard.frame, toa_s=None, heard_s=heard.first_byte_s))
        self._note_loss(now_s)

    def _note_loss(self, now_s: float) -> None:
        if self._was_open and not self._port.is_open:
            self._written = 0
            self._reader.reset()
            why = self._port.last_error
            self._notice(f"{self._port.path} has gone ({why}); waiting for it", now_s)
        self._was_open = self._port.is_open

    def _notice(self, text: str, now_s: float) -> None:
        self._push(LinkNotice(text=text, at_s=now_s))

    def _push(self, event: ModemEvent) -> None:
        if len(self._events) == QUEUED_EVENTS:
            self._events.popleft()
            self._dropped_in += 1
        self._events.append(event)


def open_serial(url: ModemUrl, context: ModemContext) -> Modem:
    """Return the modem of serial:///dev/ttyUSB0?baud=19200.

    Raises
    ------
    ConfigError
        For a URL without a port, an unknown option, or a baud that is none.
    ModemUnavailable
        When the port is not there, not ours to open, or in use.
    """
    options = url.options({"baud": DEFAULT_BAUD})
    if not url.path:
        raise ConfigError(f"{url.text} names no port; write e.g. serial:///dev/ttyUSB0?baud=19200")
    if not SLOWEST_BAUD <= options["baud"] <= FASTEST_BAUD:
        raise ConfigError(
            f"{url.text}: baud is {options['baud']}; give {SLOWEST_BAUD} to {FASTEST_BAUD}"
        )
    return SerialLineModem(url.path, options["baud"], context.tap)
