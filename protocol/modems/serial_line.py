"""A raw serial line: COBS frames over pyserial, on ports that may vanish and come back."""

import os
from collections import deque
from collections.abc import Callable

import serial

from protocol.errors import ConfigError, ModemUnavailable
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

DEFAULT_BAUD = 19_200
SLOWEST_BAUD, FASTEST_BAUD = 300, 4_000_000
REOPEN_S = 1.0
"""Between attempts to reopen: fast enough for a plug pulled and put back, no load when it stays."""
READ_BYTES = 4096


class SerialLineModem:
    """Moves frames over one port; while the port is away, frames wait in the bounded queue.

    A frame leaves the queue when its last byte was taken by the operating system; one that was cut
    by a vanishing port is sent again from its start.
    """

    lead_s = 0.0
    frames_per_packet = 1

    def __init__(self, path: str, baud: int, tap: Tap | None = None) -> None:
        self._path, self._baud, self._tap = path, baud, tap
        self.bytes_read = 0
        self._reader = LineReader()
        self._queue: deque[bytes] = deque()
        self._written = 0
        self._events: deque[ModemEvent] = deque()
        self._sent = self._received = self._dropped_out = self._dropped_in = self._reopened = 0
        self._retry_at_s = 0.0
        self._port: serial.Serial | None = self._open()

    @property
    def largest_frame_bytes(self) -> int:
        """The longest frame that the line carries whole: the guard less COBS's overhead."""
        return GUARD_BYTES - 4

    def send(self, frame: bytes, now_s: float, start_s: float | None = None) -> None:  # noqa: ARG002
        """Queue a frame; when the queue is full the oldest one not yet begun is dropped."""
        if len(self._queue) == QUEUED_FRAMES:
            del self._queue[1 if self._written else 0]
            self._dropped_out += 1
        self._queue.append(wrap(frame))
        self._guarded(self._write, now_s)

    def poll(self, now_s: float) -> None:
        """Reopen a lost port, write what the port takes, read what it has."""
        if self._port is None and now_s >= self._retry_at_s:
            self._reopen(now_s)
        self._guarded(self._write, now_s)
        self._guarded(self._read, now_s)

    def next_event(self) -> ModemEvent | None:
        """Return the oldest event not yet fetched, or None."""
        return self._events.popleft() if self._events else None

    def status(self) -> ModemStatus:
        """Return the counters."""
        return ModemStatus(
            is_up=self._port is not None,
            queued=len(self._queue),
            sent=self._sent,
            received=self._received,
            dropped_out=self._dropped_out,
            dropped_in=self._dropped_in + self._reader.overflowed,
            discarded=self._reader.bad_frames + self._reader.overlong,
            reopened=self._reopened,
        )

    def close(self) -> None:
        """Give the port back."""
        if self._port is not None:
            self._port.close()
            self._port = None
        self._retry_at_s = float("inf")

    def _open(self) -> serial.Serial:
        try:
            return serial.Serial(self._path, self._baud, timeout=0, exclusive=True)
        except (serial.SerialException, OSError) as error:
            raise ModemUnavailable(_advice(self._path, error)) from error

    def _reopen(self, now_s: float) -> None:
        self._retry_at_s = now_s + REOPEN_S
        try:
            self._port = self._open()
        except ModemUnavailable:
            return
        self._reopened += 1
        self._notice(f"{self._path} is back", now_s)

    def _guarded(self, move: Callable[[serial.Serial, float], None], now_s: float) -> None:
        """Move bytes; a port that fails is closed and tried again later."""
        if self._port is None:
            return
        try:
            move(self._port, now_s)
        except (serial.SerialException, OSError, TypeError) as error:
            # pyserial raises TypeError when its descriptor vanished under it
            self._lose(error, now_s)

    def _lose(self, error: Exception, now_s: float) -> None:
        if self._port is not None:
            self._port.close()
        self._port = None
        self._retry_at_s = now_s + REOPEN_S
        self._written = 0
        self._reader.reset()
        self._notice(f"{self._path} has gone ({error}); waiting for it", now_s)

    def _write(self, port: serial.Serial, now_s: float) -> None:
        while self._queue:
            try:
                count = os.write(port.fileno(), self._queue[0][self._written :])
            except BlockingIOError:
                return
            self._report("out", self._queue[0][self._written : self._written + count], now_s)
            self._written += count
            if self._written < len(self._queue[0]):
                return
            self._queue.popleft()
            self._written = 0
            self._sent += 1

    def _read(self, port: serial.Serial, now_s: float) -> None:
        if not port.in_waiting:  # raises on a port that has gone, where a read would return b""
            return
        data = port.read(READ_BYTES)
        self.bytes_read += len(data)
        self._report("in", data, now_s)
        self._reader.receive_data(data, now_s)
        while (heard := self._reader.next_frame()) is not None:
            self._received += 1
            self._push(Reception(frame=heard.frame, toa_s=None, heard_s=heard.first_byte_s))

    def _report(self, direction: str, data: bytes, now_s: float) -> None:
        if self._tap is not None:
            self._tap(direction, data, now_s)

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


def _advice(path: str, error: Exception) -> str:
    """Return one line that says what is wrong with a port and what to do."""
    if not os.path.exists(path):
        return f"{path} is not there; plug the modem in, or name another port"
    if not os.access(path, os.R_OK | os.W_OK):
        return f"{path} may not be opened by this user; join the group that owns it (dialout)"
    return f"{path} cannot be opened as a serial port: {error}; is another program using it?"
