"""A Micro-Modem at work: packets out on whole seconds, packets in, pings and mini-packets.

A packet is planned for a second, and begun so early that its last frame is loaded just before
that second. Frames get the second stamped when the packet is begun; one asked for too late is kept
back, the modem gives the cycle up, and the frames go again with another second.
"""

import math
from collections import deque

from protocol.errors import LocalProtocolError
from protocol.modems.dialect_driver import (
    ALIVE_QUERY_S,
    FAILURES_TO_DEATH,
    LONGEST_PAUSE_S,
    REQUESTS_CAP,
)
from protocol.modems.events import (
    FrameAcknowledged,
    FrameSent,
    MiniHeard,
    PeerSilent,
    RangeMeasured,
)
from protocol.modems.micromodem_machine import NOTHING
from protocol.modems.micromodem_reception import (
    decimal,
    integer,
    parse_statistics,
    quality_of,
    second_of_day,
)
from protocol.modems.micromodem_settings import FLEXIBLE_BYTES, MicroModemSettings
from protocol.modems.micromodem_setup import Setup
from protocol.modems.micromodem_states import State
from protocol.modems.nmea import Sentence, encode
from protocol.modems.stamping import Stamp, stamp_frame

TURNAROUND_S = 0.3
"""The modem's own time to answer a cycle, and a margin before the pulse."""
LATE_S = 0.05
"""Loading a frame that ends later than this before the pulse would miss it."""
EARLIEST_S = 0.9
"""Loading that ends earlier than this before the planned pulse would catch the pulse before it."""
START_TOLERANCE_S = 0.6
"""A start told this far from the planned second happened on another one."""
LONGEST_EXTRA_LEAD_S = 1.0
CYCLE_LINE_BYTES, FRAME_LINE_BYTES = 60, 74
"""Characters on the line around a cycle and around each frame's two digits per byte."""


class Traffic(Setup):
    """The actions from idle to sent, and everything that is heard unasked."""

    def __init__(self, settings: MicroModemSettings, stamp: Stamp = stamp_frame) -> None:
        super().__init__(settings, stamp)
        self._requests: deque[tuple[str, int, int]] = deque(maxlen=REQUESTS_CAP)
        self._request: tuple[str, int, int] = ("", 0, 0)
        self._pause_until_s, self._pause_s = 0.0, settings.pause_s
        self._failures_in_row = 0
        self._flexible_refused = False
        self._plan: tuple[float, float, int] | None = None
        self._start_s, self._extra_lead_s = 0.0, 0.0
        self._stamped: dict[int, bytes] = {}

    def lost(self, now_s: float) -> None:
        """Begin again: what was on its way is queued again, all is asked anew at once."""
        super().lost(now_s)
        self._plan, self._pause_until_s, self._clock_retry_s = None, now_s, now_s

    # ---- what goes next

    def _choose(self, now_s: float) -> None:
        """Leave the idle state for whatever is due."""
        if now_s >= self._heard_s + ALIVE_QUERY_S:
            self._fire("alive?", NOTHING, now_s)
        elif now_s < self._pause_until_s:
            return
        elif self._requests:
            self._request = self._requests.popleft()
            self._fire(self._request[0], NOTHING, now_s)
        elif not self.clock.is_set and now_s >= self._clock_retry_s:
            self._fire("clock?", NOTHING, now_s)
        elif self._begin_s(now_s) <= now_s:
            flexible = self._goes_flexible()
            self._start_s = self._plan[0] if self._plan else math.ceil(now_s)
            self._plan = None
            self.outbox.lend(self._most_frames(), self.frame_bytes)
            trigger = "flexible" if flexible else "packet"
            self._fire(trigger, NOTHING, now_s)

    def _begin_s(self, now_s: float) -> float:
        """Return when to begin the next packet, planning its second where that is not done."""
        sizes = self.outbox.sizes(self._most_frames())
        first = self.outbox.first()
        if first is None:
            self._plan = None
            return math.inf
        lead_s = self._lead_of(sizes, flexible=self._goes_flexible())
        latest_s = LATE_S + self.settings.poll_period_s
        if self._plan is None or self._plan[2] != len(sizes) or now_s > self._plan[1] + latest_s:
            start_s = max(math.ceil(now_s + lead_s - LATE_S / 2), math.ceil(first.ready_s))
            self._plan = (float(start_s), start_s - lead_s, len(sizes))
        return self._plan[1]

    def _most_frames(self) -> int:
        return 1 if self._goes_flexible() else self.frames_per_packet

    def _lead_of(self, sizes: list[int], *, flexible: bool) -> float:
        """Return how early to begin: line time, and a poll's delay at the start and per request."""
        characters = CYCLE_LINE_BYTES + sum(FRAME_LINE_BYTES + 2 * size for size in sizes)
        delays = 1 if flexible else 1 + len(sizes)
        margin_s = TURNAROUND_S + self._extra_lead_s + delays * self.settings.poll_period_s
        return margin_s + characters * 10.0 / self.settings.baud

    def _goes_flexible(self) -> bool:
        first = self.outbox.first()
        return (
            first is not None
            and self.settings.flexible
            and not self._flexible_refused
            and self.clock.generation == 2
            and len(first.frame) <= FLEXIBLE_BYTES
            and (self.clock.takes_odd_sizes or len(first.frame) % 2 == 0)
        )

    # ---- actions of the data cycle

    def ask_cycle(self, sentence: Sentence, now_s: float) -> str | None:  # noqa: ARG002
        """Begin a data cycle for the lent frames."""
        if not self._stamp_lent():
            return "nothing"
        self._say(
            encode(
                "CCCYC",
                0,
                self.settings.address,
                self.settings.destination,
                self.settings.rate,
                int(self.settings.acknowledge),
                len(self.outbox.lent),
            ),
            now_s,
        )
        return None

    def load_frame(self, sentence: Sentence, now_s: float) -> str | None:
        """Answer a data request with its frame."""
        number = integer(sentence.fields[5]) if len(sentence.fields) >= 6 else None
        if number is None or number < 1 or integer(sentence.fields[1]) != self.settings.address:
            return None
        if number > len(self.outbox.lent):
            self.load_nothing(sentence, now_s)
            return None
        rest = [len(item.frame) for item in self.outbox.lent[number - 1 :]]
        load_s = sum(2 * size + FRAME_LINE_BYTES for size in rest) * 10.0 / self.settings.baud
        if now_s + load_s > self._start_s - LATE_S:
            return "late"
        due_s = self._start_s - EARLIEST_S - load_s
        if number == len(self.outbox.lent) and now_s < due_s:
            self._do_later(due_s, lambda then_s: self._fire("CADRQ", sentence, then_s))
            return None
        self._say(self._data_line(self._stamped[number]), now_s)
        return "done" if number == len(self.outbox.lent) else None

    def load_nothing(self, sentence: Sentence, now_s: float) -> None:  # noqa: ARG002
        """Answer a data request beyond our frames: there is no more."""
        self._say(self._data_line(b""), now_s)

    def send_flexible(self, sentence: Sentence, now_s: float) -> str | None:  # noqa: ARG002
        """Send the lent frame as one flexible packet."""
        if not self._stamp_lent():
            return "nothing"
        settings = self.settings
        destination, acknowledge = settings.destination, int(settings.acknowledge)
        digits = self._stamped[1].hex().upper()
        line = encode("CCTDP", destination, settings.flexible_rate, acknowledge, 0, digits)
        self._say(line, now_s)
        return None

    def check_flexible(self, sentence: Sentence, now_s: float) -> str | None:  # noqa: ARG002
        """Take the modem's word on a flexible packet: error 0 is none."""
        return "done" if sentence.fields[:1] == ("0",) else "refused"

    def refuse_flexible(self, sentence: Sentence, now_s: float) -> None:
        """Use data cycles from now on where the firmware does not know flexible packets."""
        self._flexible_refused = sentence.name == "CAERR"
        self.refuse_packet(sentence, now_s)

    def note_start(self, sentence: Sentence, now_s: float) -> None:  # noqa: ARG002
        """Check that the packet starts on its second; else its frames name a wrong one."""
        self.counters["late"] += abs(now_s - self._start_s) > START_TOLERANCE_S

    def note_sent(self, sentence: Sentence, now_s: float) -> None:  # noqa: ARG002
        """Report the frames of the packet as they went out."""
        self._failures_in_row, self._pause_s = 0, self.settings.pause_s
        self.outbox.confirm()
        for frame in self._stamped.values():
            self._events.append(FrameSent(frame=frame, start_s=self._start_s))

    def note_late(self, sentence: Sentence, now_s: float) -> None:  # noqa: ARG002
        """Take the frames back, and begin earlier from now on."""
        self.counters["late"] += 1
        self._extra_lead_s = min(self._extra_lead_s + 0.1, LONGEST_EXTRA_LEAD_S)
        self.outbox.give_back(blame=False)
        self._pause_until_s = now_s + self._pause_s

    def refuse_packet(self, sentence: Sentence, now_s: float) -> None:  # noqa: ARG002
        """Take back what the modem refused; each pause is twice the last, so no storm comes."""
        self.counters["failures"] += 1
        self.outbox.give_back(blame=True)
        self._pause_until_s = now_s + self._pause_s
        self._pause_s = min(2.0 * self._pause_s, LONGEST_PAUSE_S)

    def fail_packet(self, sentence: Sentence, now_s: float) -> str | None:
        """Take back what got no answer; five in a row and the modem counts as dead."""
        self._failures_in_row += 1
        if self._failures_in_row >= FAILURES_TO_DEATH:
            self._failures_in_row = 0
            self.outbox.give_back(blame=False)
            return "dead"
        self.refuse_packet(sentence, now_s)
        return None

    def _stamp_lent(self) -> bool:
        """Stamp the lent frames with the second of their start; return whether any may go."""
        self._stamped = dict(enumerate(self.outbox.stamped(self._stamp, self._start_s), 1))
        return bool(self._stamped)

    # ---- pings and mini-packets

    def send_ping(self, sentence: Sentence, now_s: float) -> None:  # noqa: ARG002
        """Ask the modem for a two-way range."""
        self._say(encode("CCMPC", self.settings.address, self._request[1]), now_s)

    def note_range(self, sentence: Sentence, now_s: float) -> None:
        """Report the range; a reply without its time counts as silence."""
        owtt_s = decimal(sentence.fields[2]) if len(sentence.fields) >= 3 else None
        if owtt_s is None or not 0.0 <= owtt_s < 60.0:
            self.note_no_range(sentence, now_s)
            return
        self._events.append(RangeMeasured(peer=self._request[1], owtt_s=owtt_s, at_s=now_s))

    def note_no_range(self, sentence: Sentence, now_s: float) -> None:  # noqa: ARG002
        """Report that the peer did not answer."""
        self._events.append(PeerSilent(peer=self._request[1], at_s=now_s))

    def send_mini(self, sentence: Sentence, now_s: float) -> None:  # noqa: ARG002
        """Have a mini-packet sent."""
        _, peer, value = self._request
        self._say(encode("CCMUC", self.settings.address, peer, f"{value:04X}"), now_s)

    def drop_mini(self, sentence: Sentence, now_s: float) -> None:  # noqa: ARG002
        """Give a mini-packet up: it is worth no second try."""
        self._complain(f"mini-packet to {self._request[1]} was not sent", now_s)

    # ---- heard unasked

    def _take(self, sentence: Sentence, now_s: float) -> None:
        fields = sentence.fields
        if sentence.name in {"CARXD", "CARDP", "CAMSG"}:
            self.packet.take(sentence, now_s)
        elif sentence.name == "CACST":
            self._take_statistics(sentence, now_s)
        elif sentence.name == "CARXP":  # a packet begins: the one before has no statistics
            self._events.extend(self.packet.finish(None, now_s))
        elif sentence.name == "CATOA" and len(fields) >= 2 and self.packet.waiting:
            self.clock.mode = integer(fields[1], self.clock.mode)
            toa_s = self.clock.arrival_s(second_of_day(fields[0]), now_s)
            self._events.extend(self.packet.finish(toa_s, now_s))
        elif sentence.name == "CAREV" and len(fields) >= 3:
            self._take_revision(fields, now_s)
        elif sentence.name == "CAMUA" and len(fields) >= 3:
            self._take_mini(fields)
        elif sentence.name == "CAACK" and len(fields) >= 3:
            self._take_acknowledgement(fields)
        elif sentence.name == "CAERR":
            self._take_error(sentence, now_s)
        elif sentence.name == "CAXST":
            self._take_transmit_statistics(sentence, now_s)
        elif sentence.name == "CACYC" and integer("".join(fields[1:2])) != self.settings.address:
            return  # a peer's packet begins; the echo of our own has our address
        else:
            self._fire(sentence.name, sentence, now_s)

    def _take_statistics(self, sentence: Sentence, now_s: float) -> None:
        statistics = parse_statistics(sentence)
        if statistics is None:
            self.packet.counters["undecodable"] += 1
            return
        if statistics.clock_mode is not None:
            self.clock.mode = statistics.clock_mode
        told = statistics.second_of_day if statistics.rate != 0 else None
        toa_s = self.clock.arrival_s(told, now_s) if self.packet.is_of(statistics) else None
        heard = self.packet.finish(toa_s, now_s)
        if heard or statistics.bad_frames:
            self._events.append(quality_of(statistics, len(heard)))
        self._events.extend(heard)

    def _take_mini(self, fields: tuple[str, ...]) -> None:
        source = integer(fields[0])
        try:
            value = int(fields[2], 16)
        except ValueError:
            value = -1
        if source is None or not 0 <= value <= 0x1FFF:
            self.packet.counters["undecodable"] += 1
            return
        self._events.append(MiniHeard(source=source, value=value))

    def _take_acknowledgement(self, fields: tuple[str, ...]) -> None:
        frame = self._stamped.get(integer(fields[2], 0) or 0)
        peers = [integer(text) for text in fields[:2]]
        peer = next((a for a in peers if a is not None and a != self.settings.address), None)
        if frame is not None and peer is not None:
            self._events.append(FrameAcknowledged(frame=frame, peer=peer))

    def _take_error(self, sentence: Sentence, now_s: float) -> None:
        """Fail at once what the modem refuses, instead of waiting for its answer."""
        self.counters["errors"] += 1
        if self.state is not State.DUMPING:  # one of the two ways to ask is always refused
            self._complain("modem says " + ",".join(sentence.fields[1:])[:80], now_s)
        told = ",".join(sentence.fields[1:]).upper()
        if "NMEA" in told or "TIMEOUT" in told or "BUSY" in told:
            self._fire("refused", sentence, now_s)

    def _take_transmit_statistics(self, sentence: Sentence, now_s: float) -> None:
        """Take a CAXST line: after date, time and clock mode, mode 0 says the packet went out."""
        fields = sentence.fields[1:] if sentence.fields[:1] == ("6",) else sentence.fields
        mode = integer(fields[3], 0) if len(fields) >= 4 else 0
        if mode:
            self._complain(f"packet not sent: transmit mode {mode}", now_s)
            self._fire("refused", sentence, now_s)

    def _data_line(self, frame: bytes) -> bytes:
        settings = self.settings
        acknowledge = int(settings.acknowledge)
        digits = frame.hex().upper()
        return encode("CCTXD", settings.address, settings.destination, acknowledge, digits)

    def _check_size(self, frame: bytes) -> None:
        if not 0 < len(frame) <= self.frame_bytes:
            raise LocalProtocolError(
                f"{len(frame)} bytes: Micro-Modem rate {self.settings.rate} carries frames of 1 to"
                f" {self.frame_bytes}; take rate 3, 4 or 5 for 256-byte frames, or profile lattice"
                " in its 62-byte size"
            )
