"""An emulated Newcastle Nanomodem v3, without I/O: the user guide's commands and airtimes.

Choices where the guide is silent: a command while the modem transmits or waits for an answer is
refused with `E`; a ping or message is answered 10 ms after its end; after a power cycle the
address is kept and nothing is printed; a range that five digits cannot hold is not reported; a
unicast to oneself is an error, a broadcast is heard by all others; parity repairs up to eight
wrong bytes, and what is beyond repair sets the quality to `-` and prints nothing; a half
command is given up after `gap_s` of silence (2 ms in the modem, far more here, because a
pseudo-terminal promises no timing).
"""

import math
from dataclasses import dataclass

from host_tools.emulators.bench import AirPacket, Heard, Line
from protocol.modems.nanomodem_lines import (
    COUNT_S,
    LONGEST_PAYLOAD,
    SHORTEST_PAYLOAD,
    VOLTS_PER_COUNT,
    airtime_s,
)

DIALECT = "nanomodem"
TURNAROUND_S = 0.01
ANSWER_WAIT_S = 4.0
REPAIRED_BYTES = 8
TEST_TEXT = b"This is the fixed test message of an emulated modem, 64 bytes.  "
BUFFER_CAP = 256
DIGITS: dict[bytes, tuple[int, int]] = {
    b"$?": (0, 0),
    b"$Q": (0, 0),
    b"$A": (3, 0),
    b"$P": (3, 0),
    b"$V": (3, 0),
    b"$T": (3, 0),
    b"$B": (0, 2),
    b"$U": (3, 2),
    b"$M": (3, 2),
    b"$E": (3, 2),
}
"""Digits of address and of length that follow each command letter."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NanomodemQuirks:
    """What differs from one modem, adapter or day to another."""

    baud: int = 9600
    gap_s: float = 0.5
    volts: float = 5.0
    terminator: bytes = b"\r\n"
    leading_noise: bytes = b""
    echoes_own: bool = False
    refuses_all: bool = False


class NanomodemUnit:
    """One modem: host bytes in, replies and packets out."""

    def __init__(self, address: int, quirks: NanomodemQuirks | None = None) -> None:
        self.address = address
        self.quirks = quirks or NanomodemQuirks()
        self.errors = 0
        self._line = Line(self.quirks.baud)
        self._buffer = bytearray()
        self._last_byte_s = 0.0
        self._start: tuple[float, AirPacket] | None = None
        self._busy_until_s = -math.inf
        self._asked: tuple[int, float, float] | None = None
        self._quality = "-"

    def receive_data(self, data: bytes, now_s: float) -> None:
        """Take bytes from the host; a command acts when its last byte is there."""
        self._give_up_half(now_s)
        self._last_byte_s = now_s + len(data) * 10.0 / self.quirks.baud
        self._buffer += data
        while self._buffer and self._command(now_s):
            pass
        del self._buffer[BUFFER_CAP:]

    def poll(self, now_s: float) -> bytes:
        """Return the bytes that have reached the host by now."""
        return self._line.take(now_s)

    def next_wakeup_s(self, now_s: float) -> float:
        """Return when the modem will next do something by itself."""
        times = [self._line.next_s() if self._line.next_s() > now_s else math.inf]
        if self._buffer:
            times.append(self._last_byte_s + self.quirks.gap_s)
        if self._start is not None:
            times.append(self._start[0])
        if self._asked is not None:
            times.append(self._asked[2])
        return min(times)

    def run(self, now_s: float) -> list[AirPacket]:
        """Give up half commands and missing answers; start what is due."""
        self._give_up_half(now_s)
        if self._asked is not None and now_s >= self._asked[2]:
            self._asked = None
            self._say(b"#TO", now_s)
        if self._start is None or now_s < self._start[0]:
            return []
        packet, self._start = self._start[1], None
        self._busy_until_s = now_s + packet.airtime_s
        if self.quirks.echoes_own and packet.kind == "broadcast":
            self._print_payload(packet, now_s)
        return [packet]

    def detect(self, packet: AirPacket, now_s: float) -> None:
        """Nothing is printed at detection; the RxS pin is not on the line."""

    def hear(self, heard: Heard, now_s: float) -> None:
        """Repair, print, answer."""
        packet = heard.packet
        if packet.dialect != DIALECT or not heard.whole:
            return
        mine = packet.destination == self.address
        if packet.kind in {"broadcast", "unicast", "message"}:
            if packet.kind != "broadcast" and not mine:
                return
            wrong = sum(heard.wrong_bytes)
            if wrong > REPAIRED_BYTES:
                self._quality = "-"
                return
            self._quality = str(wrong)
            self._print_payload(packet, now_s)
            if packet.kind == "message":
                self._answer("reply", packet.source, b"", now_s)
        elif mine:
            self._hear_control(heard, now_s)

    def power_cycle(self, now_s: float) -> None:
        """Lose commands, packets and the quality; the address is stored."""
        self._buffer.clear()
        self._line.clear()
        self._start, self._asked, self._quality = None, None, "-"
        self._busy_until_s = now_s + 0.2

    def _hear_control(self, heard: Heard, now_s: float) -> None:
        packet = heard.packet
        match packet.kind:
            case "ping":
                self._answer("reply", packet.source, b"", now_s)
            case "volts?":
                count = round(self.quirks.volts / VOLTS_PER_COUNT)
                self._answer("broadcast", -1, b"V%05d" % min(count, 99999), now_s)
            case "test?":
                self._answer("broadcast", -1, TEST_TEXT, now_s)
            case "echo?":
                self._answer("broadcast", -1, packet.frames[0], now_s)
            case "reply" if self._asked is not None and self._asked[0] == packet.source:
                self._print_range(heard, now_s)

    def _print_range(self, heard: Heard, now_s: float) -> None:
        assert self._asked is not None
        if heard.t_rx_s is None:
            return
        peer, ended_s, _ = self._asked
        self._asked = None
        round_trip_s = heard.t_rx_s - ended_s - TURNAROUND_S
        count = round(max(round_trip_s, 0.0) / 2.0 / COUNT_S)
        if count <= 99_999:
            self._say(b"#R%03dT%05d" % (peer, count), now_s)

    def _print_payload(self, packet: AirPacket, now_s: float) -> None:
        payload = packet.frames[0]
        if packet.kind == "broadcast":
            self._say(b"#B%03d%02d" % (packet.source, len(payload)) + payload, now_s)
        else:
            self._say(b"#U%02d" % len(payload) + payload, now_s)

    def _say(self, text: bytes, now_s: float) -> None:
        self.errors += text == b"E"
        self._line.put(self.quirks.leading_noise + text + self.quirks.terminator, now_s)

    def _give_up_half(self, now_s: float) -> None:
        if self._buffer and now_s - self._last_byte_s >= self.quirks.gap_s - 1e-9:
            self._buffer.clear()
            self._say(b"E", now_s)

    def _command(self, now_s: float) -> bool:
        """Act on a whole command at the buffer's front; return whether there may be another."""
        size = command_size(bytes(self._buffer))
        if size is None:
            return False
        text = bytes(self._buffer[: max(size, 1)])
        del self._buffer[: max(size, 1)]
        done_s = now_s + len(text) * 10.0 / self.quirks.baud
        if size == 0 or self.quirks.refuses_all:
            if text not in {b"\r", b"\n"}:
                self._buffer.clear()
                self._say(b"E", done_s)
        elif text[1:2] in b"?AQ":
            self._local(text, done_s)
        else:
            self._acoustic(text, done_s)
        return True

    def _local(self, text: bytes, now_s: float) -> None:
        if text[1:2] == b"Q":
            self._say(b"$C" + self._quality.encode("ascii"), now_s)
        elif text[1:2] == b"?":
            count = round(self.quirks.volts / VOLTS_PER_COUNT)
            self._say(b"#A%03dV%05d" % (self.address, min(count, 99_999)), now_s)
        else:
            self.address = int(text[2:5])
            self._say(b"$A%03d" % self.address, now_s)
            self._say(b"#A%03d" % self.address, now_s)

    def _acoustic(self, text: bytes, now_s: float) -> None:
        kind = text[1:2]
        peer = -1 if kind == b"B" else int(text[2:5])
        if peer == self.address or self._busy(now_s):
            self._say(b"E", now_s)
            return
        head = {b"B": 4, b"U": 7, b"M": 7, b"E": 7}.get(kind, 5)
        self._say(text[:head], now_s)
        payload = text[head:]
        names = {
            b"P": "ping",
            b"V": "volts?",
            b"T": "test?",
            b"B": "broadcast",
            b"U": "unicast",
            b"M": "message",
            b"E": "echo?",
        }
        packet = self._packet(names[kind], peer, payload)
        self._start = (now_s, packet)
        if kind in b"PM":
            ended_s = now_s + packet.airtime_s
            self._asked = (peer, ended_s, ended_s + ANSWER_WAIT_S)

    def _busy(self, now_s: float) -> bool:
        return self._start is not None or self._asked is not None or now_s < self._busy_until_s

    def _answer(self, kind: str, peer: int, payload: bytes, now_s: float) -> None:
        """Answer a peer, unless this modem is about to transmit anyway."""
        if self._start is None:
            self._start = (now_s + TURNAROUND_S, self._packet(kind, peer, payload))

    def _packet(self, kind: str, peer: int, payload: bytes) -> AirPacket:
        return AirPacket(
            dialect=DIALECT,
            kind=kind,
            source=self.address,
            destination=peer,
            airtime_s=airtime_s(len(payload)),
            frames=(payload,) if payload else (),
        )


def command_size(buffer: bytes) -> int | None:
    """Return the bytes of the command at the front, None when unfinished, 0 when it is none."""
    if len(buffer) < 2:
        return None if buffer == b"$" else 0
    address_digits, length_digits = DIGITS.get(buffer[:2], (0, -1))
    head = 2 + address_digits + max(length_digits, 0)
    digits = buffer[2:head]
    if length_digits < 0 or (digits and not digits.isdigit()):
        return 0
    if len(buffer) < head:
        return None
    size = int(buffer[head - 2 : head]) if length_digits else SHORTEST_PAYLOAD
    beyond = bool(address_digits) and int(buffer[2:5]) > 255
    if beyond or not SHORTEST_PAYLOAD <= size <= LONGEST_PAYLOAD:
        return 0
    size = size if length_digits else 0
    return head + size if len(buffer) >= head + size else None
