"""What a Newcastle Nanomodem v3 says, told apart by length: its payloads may hold any byte.

Commands have no terminator; replies start with `$` (at once) or `#` (a result) and end in CR LF.
Source: the modem's user guide, v3.2.
"""

import math
import re
from collections import deque
from dataclasses import dataclass

COUNT_S = 3.125e-5
"""One count of a range reply: one-way time, since range = counts * sound speed * 3.125e-5."""
VOLTS_PER_COUNT = 15.0 / 65536.0
LONGEST_PAYLOAD, SHORTEST_PAYLOAD = 64, 2
HEADER_S, BYTE_S, PARITY_BYTES = 0.105, 0.0125, 16
QUEUED_REPLIES = 64
BUFFER_CAP = 4096
"""More than this without a sound reply is noise; a reply has at most 73 bytes."""
STALE_S = 0.5
"""Silence inside a reply after which its rest is not coming; at 9600 baud it takes 75 ms."""

FIXED_BYTES: dict[bytes, int] = {
    b"$A": 5,
    b"$P": 5,
    b"$V": 5,
    b"$T": 5,
    b"$B": 4,
    b"$U": 7,
    b"$M": 7,
    b"$E": 7,
    b"$C": 3,
    b"#A": 5,
    b"#R": 11,
    b"#T": 3,
    b"#B": 7,
    b"#U": 4,
}
"""Kind of a reply to its bytes before any payload and without the terminator."""

SHAPES = tuple(
    re.compile(shape, re.DOTALL)
    for shape in (
        rb"(?P<kind>E)",
        rb"(?P<kind>\$[APVT])(?P<address>\d{3})",
        rb"(?P<kind>\$B)(?P<number>\d\d)",
        rb"(?P<kind>\$[UME])(?P<address>\d{3})(?P<number>\d\d)",
        rb"(?P<kind>\$C)(?:(?P<number>\d)|-)",
        rb"(?P<kind>#A)(?P<address>\d{3})(?:V(?P<number>\d{5}))?",
        rb"(?P<kind>#R)(?P<address>\d{3})T(?P<number>\d{5})",
        rb"(?P<kind>#TO)",
        rb"(?P<kind>#B)(?P<address>\d{3})\d\d(?P<payload>.*)",
        rb"(?P<kind>#U)\d\d(?P<payload>.*)",
    )
)


def airtime_s(payload_bytes: int) -> float:
    """Return how long a data packet sounds; 0 bytes are a ping, a reply, or a command packet."""
    return HEADER_S + (payload_bytes + PARITY_BYTES) * BYTE_S if payload_bytes else HEADER_S


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """One reply: its two leading characters, then address, number and payload as it has them.

    kind is `E` for an error. number is the count of a range or voltage, or the byte count that an
    echo repeats; None in `$C-`.
    """

    kind: str
    address: int | None = None
    number: int | None = None
    payload: bytes = b""


class ReplyReader:
    """Bytes in, replies out; what fits no reply is skipped byte by byte and counted."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._replies: deque[Reply] = deque(maxlen=QUEUED_REPLIES)
        self._last_s = 0.0
        self.sound_count = 0
        self.skipped_bytes = 0

    def receive_data(self, data: bytes, now_s: float) -> None:
        """Take bytes in any chunking; that they are read late says nothing of when they came."""
        self._last_s = now_s
        for start in range(0, len(data), BUFFER_CAP):
            self._buffer += data[start : start + BUFFER_CAP]
            self._parse()

    def settle(self, now_s: float) -> None:
        """Give up an unfinished reply after a silence, and look for another in its bytes."""
        if now_s < self.stale_at_s:
            return
        while self._buffer:
            self._skip(1)
            self._parse()

    @property
    def stale_at_s(self) -> float:
        """When the rest of an unfinished reply is not coming any more."""
        return self._last_s + STALE_S if self._buffer else math.inf

    def next_reply(self) -> Reply | None:
        """Return the oldest reply not yet fetched."""
        return self._replies.popleft() if self._replies else None

    def clear(self) -> None:
        """Forget an unfinished reply, after the port was gone."""
        self._buffer.clear()

    def _skip(self, count: int) -> None:
        self.skipped_bytes += sum(byte not in b"\r\n" for byte in self._buffer[:count])
        del self._buffer[:count]

    def _parse(self) -> None:
        """Take whole replies off the front until what is left is unfinished or nothing."""
        while self._buffer:
            size = self._size()
            if size is None:
                return
            if size == 0:
                self._skip(1)
                continue
            reply = parse_reply(bytes(self._buffer[:size]))
            if reply is None:
                self._skip(1)
                continue
            del self._buffer[: size + 1]
            self.sound_count += 1
            self._replies.append(reply)

    def _size(self) -> int | None:
        """Return the bytes of the leading reply, 0 when none begins here, None when unfinished.

        A reply counts only with a terminator behind it: bytes lost on the line would otherwise
        pull the next reply into a payload.
        """
        head = bytes(self._buffer[:2])
        if head[:1] == b"E":
            size = 1
        elif head[:1] not in {b"$", b"#"}:
            return 0
        elif len(head) < 2:
            return None
        elif head not in FIXED_BYTES:
            return 0
        else:
            size = FIXED_BYTES[head]
            if len(self._buffer) <= size:
                return None
            size += self._more(head, size)
        if len(self._buffer) <= size:
            return None
        return size if self._buffer[size] in b"\r\n" else 0

    def _more(self, head: bytes, size: int) -> int:
        """Return how many bytes follow the fixed part: a payload, or a voltage."""
        if head == b"#A":
            return 6 if self._buffer[size] == ord("V") else 0
        if head in {b"#B", b"#U"}:
            digits = self._buffer[size - 2 : size]
            return int(digits) if digits.isdigit() else 0
        return 0


def parse_reply(text: bytes) -> Reply | None:
    """Return the reply in exactly these bytes, or None."""
    for shape in SHAPES:
        found = shape.fullmatch(text)
        if found is not None:
            parts = found.groupdict()
            address, number = parts.get("address"), parts.get("number")
            return Reply(
                kind=parts["kind"].decode("ascii"),
                address=None if address is None else int(address),
                number=None if number is None else int(number),
                payload=parts.get("payload", b""),
            )
    return None
