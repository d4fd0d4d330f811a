"""A serial port that never blocks and may vanish and come back; the bytes are not its business."""

import os
import termios
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import TypeVar

import serial

from protocol.errors import ModemUnavailable
from protocol.modems.base import Tap

REOPEN_S = 0.5
"""Between attempts to reopen: fast for a plug put back, no load while it stays out."""
READ_BYTES = 4096
WRITE_CAP_BYTES = 65_536
"""Cap of bytes that the port has not taken; a packet of rate 5 is 4,700."""

T = TypeVar("T")


class SerialPort:
    """Reads and writes what the operating system takes at once; a failing port is reopened.

    While it is away reads are empty and writes are refused, which the caller sees in `is_open`. rts
    is what that line is held at: boxes of the Micro-Modem 2 take it for power control.
    """

    def __init__(self, path: str, baud: int, tap: Tap | None = None, *, rts: bool = False) -> None:
        self.path, self.baud, self._tap, self._rts = path, baud, tap, rts
        self._unsent = bytearray()
        self._tried_s = float("-inf")
        self._is_given_back = False
        self.reopened = 0
        self.last_error = ""
        self._serial: serial.Serial | None = self._open()

    @property
    def is_open(self) -> bool:
        """Whether the port is there."""
        return self._serial is not None

    def try_reopen(self, now_s: float) -> bool:
        """Try to open a lost port again when it is time; return whether it came back just now."""
        if self._serial is not None or self._is_given_back:
            return False
        if 0.0 <= now_s - self._tried_s < REOPEN_S:  # not where the clock was set back
            return False
        self._tried_s = now_s
        try:
            self._serial = self._open()
        except ModemUnavailable:
            return False
        self.reopened += 1
        return True

    def read(self, now_s: float) -> bytes:
        """Return what has come, possibly nothing."""
        data = self._guarded(_waiting, now_s) or b""
        if data and self._tap is not None:
            self._tap("in", data, now_s)
        return data

    def write(self, data: bytes, now_s: float) -> None:
        """Write data behind what is still waiting, as much as the port takes now."""
        if self._serial is None:
            return
        if len(self._unsent) + len(data) <= WRITE_CAP_BYTES:
            self._unsent += data
        if self._unsent:
            del self._unsent[: self.push(bytes(self._unsent), now_s)]

    def push(self, data: bytes, now_s: float) -> int:
        """Write as much of data as the port takes now; return how many bytes those are."""
        count = self._guarded(partial(_taken, data), now_s) or 0
        if count and self._tap is not None:
            self._tap("out", data[:count], now_s)
        return count

    def discard_output(self, now_s: float) -> None:
        """Forget what the port has taken and not passed on."""
        self._guarded(serial.Serial.reset_output_buffer, now_s)

    def close(self) -> None:
        """Give the port back for good."""
        self._let_go()
        self._is_given_back = True

    def _open(self) -> serial.Serial:
        port = serial.Serial(timeout=0, exclusive=True, baudrate=self.baud)
        port.port = self.path
        port.rts = self._rts  # before opening: some boxes take RTS for power control
        try:
            port.open()
        except (serial.SerialException, OSError, termios.error) as error:
            # pyserial lets termios.error, no OSError, out where an adapter goes while it is opened
            raise ModemUnavailable(_advice(self.path, error)) from error
        return port

    def _guarded(self, move: Callable[[serial.Serial], T], now_s: float) -> T | None:
        """Move bytes; a port that fails is closed and tried again later."""
        if self._serial is None:
            return None
        try:
            return move(self._serial)
        except (serial.SerialException, OSError, TypeError, termios.error) as error:
            # pyserial raises TypeError when its descriptor vanished under it
            self.last_error = str(error)
            self._let_go()
            self._tried_s = now_s
            self._unsent.clear()
            return None

    def _let_go(self) -> None:
        """Close the port; one that has gone may refuse even that."""
        port, self._serial = self._serial, None
        if port is not None:
            with suppress(OSError):
                port.close()


def _waiting(port: serial.Serial) -> bytes:
    if not port.in_waiting:  # raises where the port has gone; a read would return b""
        return b""
    return bytes(port.read(READ_BYTES))


def _taken(data: bytes, port: serial.Serial) -> int:
    try:
        return os.write(port.fileno(), data)
    except BlockingIOError:
        return 0


def _advice(path: str, error: Exception) -> str:
    """Return one line that says what is wrong with a port and what to do."""
    if not os.path.exists(path):
        return f"{path} is not there; plug the modem in, or name another port"
    if not os.access(path, os.R_OK | os.W_OK):
        return f"{path} may not be opened by this user; join the group that owns it (dialout)"
    return f"{path} cannot be opened as a serial port: {error}; is another program using it?"
