"""A whole dialect in one file, as CONTRIBUTING asks: a modem that takes frames as lines of hex.

`?` asks who is there, the modem says `!`; a line of hex goes on the air, `.` says that it has; a
line of hex from the modem was heard.
"""

from collections import deque
from dataclasses import dataclass

from protocol.errors import LocalProtocolError
from protocol.modems.base import Modem, ModemContext, ModemUrl
from protocol.modems.dialect_driver import open_dialect, settings_from_url
from protocol.modems.events import DialectEvent, FrameHeard, FrameSent
from protocol.modems.outbox import Outbox
from protocol.modems.stamping import Stamp
from protocol.settings import Settings, setting

ALIVE_S, LONGEST_LINE_BYTES, EVENTS_CAP = 5.0, 600, 256


@dataclass(frozen=True, slots=True, kw_only=True)
class HexLineSettings(Settings):
    """What the URL may say."""

    baud: int = setting(9600, "bit/s", "the modem's own", minimum=300, maximum=921_600)
    queue_frames: int = setting(32, "frames", "two minutes of a link", minimum=1)


class HexLine:
    """Bytes and time in; bytes for the modem and events out."""

    name, lead_s, frame_bytes, frames_per_packet = "hexline", 0.0, 256, 1

    def __init__(self, settings: HexLineSettings, stamp: Stamp) -> None:
        self.identified, self._stamp = False, stamp
        self.outbox = Outbox(settings.queue_frames)
        self._damaged_lines = 0
        self._line, self._events = bytearray(), deque[DialectEvent](maxlen=EVENTS_CAP)
        self._asked_s = -ALIVE_S

    @property
    def ready(self) -> bool:
        return self.identified

    def receive_data(self, data: bytes, now_s: float) -> None:
        self._line += data
        *lines, rest = self._line.split(b"\n")
        self._line = rest[-LONGEST_LINE_BYTES:]
        for line in lines:
            self._take(bytes(line).strip(), now_s)

    def poll(self, now_s: float) -> bytes:
        if not self.identified or now_s >= self._asked_s + ALIVE_S:
            if now_s < self._asked_s + 1.0:
                return b""
            self._asked_s = now_s
            return b"?\n"
        first = self.outbox.first()
        if self.outbox.lent or first is None or first.ready_s > now_s:
            return b""
        self.outbox.lend(1, self.frame_bytes)
        stamped = self.outbox.stamped(self._stamp, now_s)
        return b"".join(frame.hex().encode() + b"\n" for frame in stamped)

    def next_event(self) -> DialectEvent | None:
        return self._events.popleft() if self._events else None

    def next_wakeup_s(self, now_s: float) -> float:
        return now_s

    def lost(self, now_s: float) -> None:
        self.outbox.recall(now_s)
        self._line.clear()
        self._asked_s = now_s - ALIVE_S

    def send(self, frame: bytes, now_s: float, start_s: float | None = None) -> None:
        if not 0 < len(frame) <= self.frame_bytes:
            raise LocalProtocolError(f"{len(frame)} bytes; a line holds 1 to {self.frame_bytes}")
        self.outbox.put(frame, now_s if start_s is None else start_s)

    def ping(self, peer: int) -> None:
        """This modem has no ranges."""

    def status(self) -> dict[str, int]:
        return {"damaged_lines": self._damaged_lines, **self.outbox.counters}

    def _take(self, line: bytes, now_s: float) -> None:
        if line == b"!":
            self.identified = True
        elif line == b"." and self.outbox.lent:
            for item in self.outbox.confirm():
                self._events.append(FrameSent(frame=item.frame, start_s=now_s))
        else:
            try:
                frame = bytes.fromhex(line.decode("ascii"))
            except ValueError:
                self._damaged_lines += 1
                return
            if frame:
                self._events.append(FrameHeard(frame=frame, source=None, toa_s=None, heard_s=now_s))


def open_hexline(url: ModemUrl, context: ModemContext) -> Modem:
    settings = settings_from_url(url, HexLineSettings())
    return open_dialect(url, context, settings.baud, lambda: HexLine(settings, context.stamp))
