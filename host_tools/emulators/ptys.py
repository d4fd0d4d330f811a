"""Pseudo-terminals that stand for a modem's serial port, without socat.

A link in the file system keeps one name while the terminal behind it goes and comes back, as a
port that is pulled and put back does. The speed that the host sets is read from the terminal: at
a wrong one every byte is garbled, as on a real line.
"""

import contextlib
import errno
import fcntl
import os
import sys
import termios
import tty
from pathlib import Path

from protocol.errors import ConfigError

READ_BYTES = 65_536
BACKLOG_BYTES = 65_536
"""What a modem has said to a host that does not read; older bytes are lost, as on a real line."""

_SPEEDS = {
    getattr(termios, f"B{baud}"): baud
    for baud in (300, 1200, 2400, 4800, 9600, 19_200, 38_400, 57_600, 115_200)
}


class PseudoPort:
    """One end of a line whose other end any serial program opens by name."""

    def __init__(self, baud: int, link: Path | None = None) -> None:
        self.baud, self._link = baud, link
        self._master: int | None = None
        self._slave: int | None = None
        self._backlog = bytearray()
        self.lost_bytes = self.written_bytes = 0
        self.plug()

    @property
    def name(self) -> str:
        """What the host opens."""
        if self._link is not None:
            return str(self._link)
        return "" if self._slave is None else os.ttyname(self._slave)

    @property
    def fileno(self) -> int | None:
        """The descriptor to wait on, None while the port is pulled."""
        return self._master

    def plug(self) -> None:
        """Make the terminal, and let the link point to it.

        Raises ConfigError where a file or another port has the link's name.
        """
        if self._master is not None:
            return
        if self._link is not None and self._link.exists():  # a dead port's link leads nowhere
            raise ConfigError(f"{self._link} is there already; remove it or give another folder")
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        speed = next(code for code, baud in _SPEEDS.items() if baud == self.baud)
        state = termios.tcgetattr(self._slave)
        state[4] = state[5] = speed
        termios.tcsetattr(self._slave, termios.TCSANOW, state)
        if self._link is not None:
            self._link.unlink(missing_ok=True)
            self._link.symlink_to(os.ttyname(self._slave))

    def unplug(self) -> None:
        """Take the terminal away, as a pulled cable does; whoever has it open gets errors."""
        if self._link is not None and self._slave is not None:
            if self._link.is_symlink() and str(self._link.readlink()) == os.ttyname(self._slave):
                self._link.unlink()
        for descriptor in (self._master, self._slave):
            if descriptor is not None:
                os.close(descriptor)
        self._master = self._slave = None
        self._backlog.clear()

    def read(self) -> bytes:
        """Return what the host has written, as heard at our speed."""
        if self._master is None:
            return b""
        try:
            return self._heard(os.read(self._master, READ_BYTES))
        except BlockingIOError:
            return b""
        except OSError as error:
            if error.errno == errno.EIO:  # the host closed its end; ours stays open
                return b""
            raise

    def write(self, data: bytes) -> None:
        """Say bytes to the host; what it does not read is kept up to a cap."""
        if self._master is None:
            self.lost_bytes += len(data)
            return
        self._backlog += self._heard(data)
        excess = max(0, len(self._backlog) - BACKLOG_BYTES)
        self.lost_bytes += excess
        del self._backlog[:excess]
        with contextlib.suppress(BlockingIOError):
            while self._backlog:
                count = os.write(self._master, self._backlog)
                self.written_bytes += count
                del self._backlog[:count]

    def waiting_bytes(self) -> tuple[int, int]:
        """Return how many bytes the host can read now, and how many we can.

        The kernel hands bytes across a pseudo-terminal a little later; a test in virtual time has
        to wait until they are there, or the delay would count as seconds.
        """
        if self._slave is None or self._master is None:
            return 0, 0
        return _readable(self._slave), _readable(self._master)

    def close(self) -> None:
        """Take the terminal and its link away for good."""
        self.unplug()

    def _heard(self, data: bytes) -> bytes:
        """Return data as a line of two speeds garbles it; as it is where they agree."""
        if self._slave is None or not data:
            return data
        host_baud = _SPEEDS.get(termios.tcgetattr(self._slave)[5], self.baud)
        if host_baud == self.baud:
            return data
        stride = 2 if host_baud < self.baud else 1
        return bytes((byte * 37 ^ 0xB5) & 0xFF | 0x80 for byte in data[::stride])


def _readable(descriptor: int) -> int:
    count = fcntl.ioctl(descriptor, termios.FIONREAD, bytes(4))
    return int.from_bytes(count, sys.byteorder)
