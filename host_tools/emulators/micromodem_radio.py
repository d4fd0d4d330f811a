"""The acoustic half of an emulated Micro-Modem: its line, its agenda, what it sounds and hears."""

import heapq
import math
from collections.abc import Callable
from dataclasses import dataclass, field

from host_tools.emulators.bench import AirPacket, Heard, Line
from host_tools.emulators.micromodem_firmware import (
    CONTROL_S,
    NMEA_KEYS,
    MicroModemQuirks,
    RealTimeClock,
)
from protocol.modems.nmea import Sentence, SentenceReader, encode

DIALECT = "micromodem"
THINKING_S = 0.03
"""Between a sentence and its answer."""
TURNAROUND_S = 0.5
"""Between a ping's end and the reply; the asking modem subtracts it."""
EXTERNAL_WAIT_S = 2.0
"""Without a pulse a packet that should start on it is given up after this."""


@dataclass(slots=True)
class Cycle:
    """A data cycle of our own that is being loaded."""

    destination: int
    rate: int
    acknowledge: bool
    count: int
    frames: list[bytes] = field(default_factory=list)
    deadline_s: float = math.inf


class MicroModemRadio:
    """The modem below its commands: line, clock, agenda, packets out and in."""

    def __init__(
        self, address: int, quirks: MicroModemQuirks | None = None, *, pulse_present: bool = True
    ) -> None:
        self.quirks = quirks or MicroModemQuirks()
        self.clock = RealTimeClock(pulse_present)
        self.settings = NMEA_KEYS | {"SRC": str(address)}
        self.errors = 0
        self._line = Line(self.quirks.baud)
        self._reader = SentenceReader(need_checksum=False)
        self._input_free_s = 0.0
        self._agenda: list[tuple[float, int, Callable[[float], None]]] = []
        self._order = 0
        self._starting: list[AirPacket] = []
        self._cycle: Cycle | None = None
        self._preloaded: list[bytes] = []
        self._busy_until_s = 0.0
        self._pinged: tuple[int, float] | None = None
        self._acked: AirPacket | None = None
        self._up_s = 0.0
        self._uid = 0
        self._at(0.0, self._boot)

    @property
    def address(self) -> int:
        """The modem's own address."""
        text = self.settings["SRC"]
        return int(text) if text.isdecimal() else 0

    def receive_data(self, data: bytes, now_s: float) -> None:
        """Take bytes from the host; a sentence acts when its last byte has come over the line."""
        if now_s < self._up_s:
            return
        begin_s = max(now_s, self._input_free_s)
        self._input_free_s = begin_s + len(data) * 10.0 / self.quirks.baud
        self._reader.receive_data(data)
        damaged = self._reader.damaged_count
        self._reader.damaged_count = 0
        for _ in range(damaged):
            self._at(self._input_free_s, lambda t: self._error(t, "NMEA", 3, "Bad checksum"))
        while (sentence := self._reader.next_sentence()) is not None:
            self._at(self._input_free_s + THINKING_S, self._later(sentence))

    def poll(self, now_s: float) -> bytes:
        """Return the bytes that have reached the host by now."""
        return self._line.take(now_s)

    def next_wakeup_s(self, now_s: float) -> float:
        """Return when the modem will next do something by itself."""
        line_s = self._line.next_s()
        times = [line_s if line_s > now_s else math.inf]
        times.append(self._agenda[0][0] if self._agenda else math.inf)
        times.append(self._cycle.deadline_s if self._cycle is not None else math.inf)
        return min(times)

    def run(self, now_s: float) -> list[AirPacket]:
        """Do what is due; return the packets that start to sound now."""
        while self._agenda and self._agenda[0][0] <= now_s:
            due_s, _, act = heapq.heappop(self._agenda)
            act(due_s)
        if self._cycle is not None and now_s >= self._cycle.deadline_s:
            number = len(self._cycle.frames) + 1
            self._cycle = None
            self._error(now_s, "DATA", 5, f"DATA_TIMEOUT,{number}")
        starting, self._starting = self._starting, []
        return starting

    def power_cycle(self, now_s: float) -> None:
        """Lose everything in memory; stored settings stay unless this modem forgets them."""
        address = self.settings["SRC"]
        self._agenda.clear()
        self._line.clear()
        self._reader.clear()
        self._starting, self._cycle, self._preloaded = [], None, []
        self._pinged, self._acked = None, None
        if not self.quirks.keeps_time:
            self.clock.lose(now_s)
        if self.quirks.forgets_settings:
            self.settings = NMEA_KEYS | {"SRC": "0" if address != "0" else address}
        self._up_s = now_s + self.quirks.boot_s
        self._busy_until_s = self._input_free_s = self._up_s
        self._at(self._up_s, self._boot)

    # ---- plumbing

    def _at(self, due_s: float, act: Callable[[float], None]) -> None:
        self._order += 1
        heapq.heappush(self._agenda, (due_s, self._order, act))

    def _later(self, sentence: Sentence) -> Callable[[float], None]:
        return lambda now_s: self._obey(sentence, now_s)

    def _say(self, now_s: float, name: str, *fields: str | int) -> None:
        line = encode(name, *fields)[:-2] + self.quirks.terminator
        self._line.put(self.quirks.sends_noise + line, now_s)

    def _error(self, now_s: float, module: str, number: int, text: str) -> None:
        self.errors += 1
        self._say(now_s, "CAERR", self.clock.hhmmss(now_s), module, number, text)

    def _boot(self, now_s: float) -> None:
        if not self.quirks.silent_boot:
            self._say(now_s, "CAREV", self.clock.hhmmss(now_s), "INIT", self.quirks.firmware)
        self._at(now_s + 0.2, self._heartbeat)

    def _heartbeat(self, now_s: float) -> None:
        self._say(now_s, "CAREV", self.clock.hhmmss(now_s), "AUV", self.quirks.firmware)
        if self.quirks.is_second_generation:
            self._say(now_s, "CAREV", self.clock.hhmmss(now_s), "COPROC", "0.30.0.56")
        self._at(now_s + self.quirks.heartbeat_s, self._heartbeat)

    def _flag(self, key: str) -> bool:
        return self.settings.get(key) == "1"

    def _obey(self, sentence: Sentence, now_s: float) -> None:
        """Do a command; the subclass knows them."""

    # ---- sounding

    def _control(self, kind: str, destination: int, payload: bytes = b"") -> AirPacket:
        return AirPacket(
            dialect=DIALECT,
            kind=kind,
            source=self.address,
            destination=destination,
            airtime_s=CONTROL_S,
            frames=(payload,) if payload else (),
        )

    def _launch(self, packet: AirPacket, now_s: float) -> None:
        """Start a packet: on the next pulse when so set, at once otherwise."""
        on_pulse = self._flag("SNV") and packet.kind in {"data", "flexible"}
        if on_pulse and not self.clock.pulse_present:
            self._busy_until_s = now_s + EXTERNAL_WAIT_S
            self._at(self._busy_until_s, lambda t: self._transmit_statistics(t, packet, 2))
            return
        start_s = math.floor(now_s) + 1.0 if on_pulse else max(now_s, self._busy_until_s)
        self._busy_until_s = start_s + packet.airtime_s
        self._at(start_s, lambda t: self._start(packet, t))
        self._at(self._busy_until_s + 1e-6, lambda t: self._finish(packet, t))

    def _start(self, packet: AirPacket, now_s: float) -> None:
        self._starting.append(packet)
        if packet.kind == "ping":
            self._pinged = (packet.destination, now_s + packet.airtime_s)
        if packet.kind in {"data", "flexible"}:
            self._acked = packet
            self._say(now_s, "CATXP", len(packet.on_air))

    def _finish(self, packet: AirPacket, now_s: float) -> None:
        if packet.kind not in {"data", "flexible"}:
            return
        self._say(now_s, "CATXF", len(packet.on_air))
        self._transmit_statistics(now_s, packet, 0)
        if self.quirks.echoes_own:
            for number, frame in enumerate(packet.frames, 1):
                self._print_frame(packet, number, frame, now_s)

    def _transmit_statistics(self, now_s: float, packet: AirPacket, mode: int) -> None:
        if not self._flag("XST"):
            return
        moment = self.clock.read(now_s)
        count = len(packet.frames)
        fields: list[str | int] = [moment.strftime("%Y%m%d"), moment.strftime("%H%M%S.0000")]
        fields += [self.clock.mode(bit_field=self.quirks.has_bit_field), mode, 200, 5000, 25000]
        fields += [packet.rate, packet.source, packet.destination, int(packet.acknowledge)]
        fields += [count, count if mode == 0 else 0, 3, len(packet.on_air)]
        version: list[str | int] = [6] if self.quirks.statistics_version == 6 else []
        for _ in range(2 if packet.rate == 0 and packet.kind == "data" else 1):
            self._say(now_s, "CAXST", *version, *fields)

    # ---- hearing

    def detect(self, packet: AirPacket, now_s: float) -> None:
        """Print that a packet begins."""
        if packet.dialect == DIALECT and self._flag("RXP") and now_s >= self._up_s:
            fsk = packet.kind in {"ping", "reply", "mini", "ack"} or packet.rate == 0
            self._say(now_s, "CARXP", 0 if fsk else 1)

    def hear(self, heard: Heard, now_s: float) -> None:
        """Print, and answer what wants an answer."""
        packet = heard.packet
        if packet.dialect != DIALECT or now_s < self._up_s:
            return
        if packet.kind in {"data", "flexible"}:
            self._hear_frames(heard, now_s)
        elif heard.whole and packet.destination == self.address:
            self._hear_control(heard, now_s)

    def _hear_frames(self, heard: Heard, now_s: float) -> None:
        packet = heard.packet
        if not heard.whole:
            self._say(now_s, "CAMSG", "PACKET_TIMEOUT", 1 if packet.rate == 0 else 2)
            self._statistics(heard, 2, now_s)
            return
        if packet.kind == "data":
            ack = int(packet.acknowledge)
            header = (0, packet.source, packet.destination, packet.rate, ack, len(packet.frames))
            self._say(now_s, "CACYC", *header)
        if packet.rate == 0:
            self._statistics(heard, 0, now_s)
        for number, frame in enumerate(packet.frames, 1):
            if not heard.wrong_bytes[number - 1] or packet.kind == "flexible":
                self._print_frame(packet, number, frame, now_s, heard.wrong_bytes[number - 1])
            else:
                self._say(now_s, "CAMSG", "BAD_CRC", number)
        self._statistics(heard, 1 if any(heard.wrong_bytes) else 0, now_s)
        if packet.acknowledge and packet.destination == self.address:
            good = bytes(n + 1 for n, wrong in enumerate(heard.wrong_bytes) if not wrong)
            if good:
                self._launch(self._control("ack", packet.source, good), now_s + 0.1)

    def _print_frame(
        self, packet: AirPacket, number: int, frame: bytes, now_s: float, wrong: int = 0
    ) -> None:
        ack, digits = int(packet.acknowledge), frame.hex().upper()
        if packet.kind == "data":
            self._say(now_s, "CARXD", packet.source, packet.destination, ack, number, digits)
            return
        listed = f"{int(not wrong)};{len(frame)};{digits if not wrong else ''}"
        fields = (packet.source, packet.destination, packet.rate, ack, 0, "", listed)
        self._say(now_s, "CARDP", *fields)

    def _hear_control(self, heard: Heard, now_s: float) -> None:
        packet = heard.packet
        match packet.kind:
            case "ping":
                self._say(now_s, "CAMPA", packet.source, self.address)
                reply = self._control("reply", packet.source)
                self._at(now_s + TURNAROUND_S, lambda t: self._launch(reply, t))
            case "reply" if self._pinged is not None and self._pinged[0] == packet.source:
                ended_s, self._pinged = self._pinged[1], None
                owtt_s = ((heard.t_rx_s or now_s) - ended_s - TURNAROUND_S) / 2.0
                told = [] if self.quirks.omits_range else [f"{max(owtt_s, 0.0):.4f}"]
                self._say(now_s, "CAMPR", packet.source, self.address, *told)
            case "mini" if packet.frames:
                value = int.from_bytes(packet.frames[0], "big") & 0x1FFF
                self._say(now_s, "CAMUA", packet.source, self.address, f"{value:04X}")
                self._launch(self._control("mini reply", packet.source), now_s + 0.1)
            case "mini reply":
                self._say(now_s, "CAMUR", packet.source, self.address)
            case "ack" if self._acked is not None and packet.frames:
                for number in packet.frames[0]:
                    self._say(now_s, "CAACK", packet.source, self.address, number, 1)

    def _statistics(self, heard: Heard, mode: int, now_s: float) -> None:
        """Print the 29 fields of CACST, or the few that a packet time-out leaves."""
        if not self._flag("CST"):
            return
        packet = heard.packet
        toa_s = heard.t_rx_s if heard.t_rx_s is not None else now_s
        told = self.clock.arrival(toa_s, with_date=self.quirks.statistics_version == 6)
        head: list[str | int] = [6] if self.quirks.statistics_version == 6 else []
        head += [mode, told, self.clock.mode(bit_field=self.quirks.has_bit_field)]
        if mode == 2:
            self._say(now_s, "CACST", *head, 4105, 30)
            return
        bad = sum(map(bool, heard.wrong_bytes))
        types = {"data": 1 if packet.rate == 0 else 3, "flexible": 5}
        fields: list[str | int] = [4105, 30, "0318", "0193", 10, "00", "00", "01", "01"]
        fields += [packet.rate, f"{packet.source:03d}", f"{packet.destination:03d}"]
        fields += [3 if bad else 0, types[packet.kind], len(packet.frames), bad]
        fields += [154, "09", "08", 10, -6, f"{max(0, 200 - 40 * bad):03d}", "0.0"]
        tail: list[str | int] = [41, 25000, 5000]
        if self.quirks.runs_noise_into_carrier:
            tail = ["4125000", 5000]
        self._say(now_s, "CACST", *head, *fields, *tail)
