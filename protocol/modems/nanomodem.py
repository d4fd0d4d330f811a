"""Newcastle Nanomodem v3: the sans-IO core that the generic driver runs over a serial port.

Frames of up to 62 bytes travel behind two bytes of our own, sender and sequence: the modem's
unicast does not tell who spoke, and a repeat after a lost acknowledgement must not count twice.
The modem has no shared clock, so no arrival time is vouched for; ranges come from its two-way
pings and acknowledged messages.
"""

import math
from collections import deque

from protocol.errors import LocalProtocolError
from protocol.modems.base import Modem, ModemContext, ModemUrl
from protocol.modems.dialect_driver import (
    ALIVE_QUERY_S,
    EVENTS_CAP,
    FAILURES_TO_DEATH,
    LONGEST_PAUSE_S,
    REQUESTS_CAP,
    open_dialect,
    settings_from_url,
)
from protocol.modems.events import (
    DialectEvent,
    FrameAcknowledged,
    FrameHeard,
    FrameSent,
    LinkQuality,
    ModemComplaint,
    ModemRestarted,
    PeerSilent,
    RangeMeasured,
    SupplyVoltage,
)
from protocol.modems.nanomodem_lines import (
    COUNT_S,
    LONGEST_PAYLOAD,
    VOLTS_PER_COUNT,
    Reply,
    ReplyReader,
    airtime_s,
)
from protocol.modems.nanomodem_states import BROADCAST, TABLE, WAITS_S, NanomodemSettings, State
from protocol.modems.outbox import Outbox
from protocol.modems.stamping import Stamp, stamp_frame

ENVELOPE_BYTES = 2
FRAME_BYTES = LONGEST_PAYLOAD - ENVELOPE_BYTES
PROBE = b"$?"
"""What a Nanomodem answers by its address and supply voltage."""

AIR_MARGIN_S = 0.1
"""After the air time a Nanomodem is given this long to listen to its line again."""


class Nanomodem:
    """Bytes and time in; bytes for the modem and events out."""

    name = "nanomodem"
    frames_per_packet, frame_bytes = 1, FRAME_BYTES
    lead_s = 0.1
    """The line takes 75 ms for a full packet, and transmission follows at once."""

    def __init__(self, settings: NanomodemSettings, stamp: Stamp = stamp_frame) -> None:
        self.settings = settings
        self.state = State.CLOSED
        self.identified = False
        self.outbox = Outbox(settings.queue_frames)
        self.reader = ReplyReader()
        self.counters = dict.fromkeys(
            ("errors", "failures", "restarts", "deaths", "undecodable", "repeats", "own_echoes"), 0
        )
        self._stamp = stamp
        self._events: deque[DialectEvent] = deque(maxlen=EVENTS_CAP)
        self._requests: deque[tuple[str, int]] = deque(maxlen=REQUESTS_CAP)
        self._peer = 0
        self._awaits_answer = self._is_frame = self._quality_due = False
        self._payload = b""
        self._sequence: int | None = None
        self._last_sequence: dict[int, int] = {}
        self._output = bytearray()
        self._deadline_s, self._heard_s, self._started_s = math.inf, 0.0, 0.0
        self._pause_until_s, self._pause_s, self._failures_in_row = 0.0, settings.pause_s, 0

    # ---- bytes in, bytes and events out

    def receive_data(self, data: bytes, now_s: float) -> None:
        """Take what the modem said, in any chunking; nothing in it can raise."""
        self.reader.receive_data(data, now_s)
        self._take_replies(now_s)

    def poll(self, now_s: float) -> bytes:
        """Return what must be said to the modem now."""
        self.reader.settle(now_s)
        self._take_replies(now_s)
        if self.state is State.CLOSED:
            self._fire("start", now_s)
        if now_s >= self._deadline_s:
            self._deadline_s = math.inf
            if self.state is State.ON_AIR:
                self._fire("answer due" if self._awaits_answer else "aired", now_s)
            else:
                self._fire("gone", now_s)
        if self.state is State.IDLE:
            self._choose(now_s)
        output, self._output = bytes(self._output), bytearray()
        return output

    def next_event(self) -> DialectEvent | None:
        """Return the oldest event not yet fetched."""
        if self.outbox.dropped:
            return self.outbox.dropped.popleft()
        return self._events.popleft() if self._events else None

    def next_wakeup_s(self, now_s: float) -> float:
        """Return when `poll` will next have something to do, if nothing is heard before."""
        if self.state is State.CLOSED:
            return now_s
        due_s = min(self._deadline_s, self.reader.stale_at_s)
        if self.state is State.IDLE:
            due_s = min(due_s, self._heard_s + ALIVE_QUERY_S)
            if self._requests or self._quality_due:
                due_s = min(due_s, self._pause_until_s)
            due_s = min(due_s, max(self._pause_until_s, self._ready_s()))
        return max(now_s, due_s)

    def lost(self, now_s: float) -> None:
        """Begin again: what was on its way is queued again, all is asked anew at once."""
        self.reader.clear()
        self._output.clear()
        self.outbox.recall(now_s)
        self._heard_s = self._pause_until_s = now_s
        self._enter(State.CLOSED, now_s)

    def send(self, frame: bytes, now_s: float, start_s: float | None = None) -> None:
        """Queue a frame, to be sent at once or not before start_s.

        Raises
        ------
        LocalProtocolError
            When it is larger than the modem's payload leaves room for.
        """
        if not 0 < len(frame) <= FRAME_BYTES:
            raise LocalProtocolError(
                f"{len(frame)} bytes: a Nanomodem carries frames of 1 to {FRAME_BYTES}, so no"
                " profile of 256-byte frames, as paper is, fits; take lattice in its 62-byte size"
                " (follower.compression.small_frames=true), or a Micro-Modem at rate 3, 4 or 5"
            )
        self.outbox.put(frame, now_s if start_s is None else start_s)

    def ping(self, peer: int) -> None:
        """Ask for a two-way range; RangeMeasured or PeerSilent follows."""
        self._requests.append(("P", peer))

    def ask_voltage(self, peer: int) -> None:
        """Ask a peer for its supply voltage; SupplyVoltage follows if it hears."""
        self._requests.append(("V", peer))

    @property
    def ready(self) -> bool:
        """Whether the modem is configured and answers."""
        return self.state not in {State.CLOSED, State.LISTENING, State.ADDRESSING}

    def status(self) -> dict[str, int]:
        """Return every counter of this side of the line."""
        reading = {"lines": self.reader.sound_count, "skipped_bytes": self.reader.skipped_bytes}
        return reading | self.counters | self.outbox.counters

    # ---- the machine

    def _fire(self, trigger: str, now_s: float, reply: Reply | None = None) -> None:
        row = TABLE.get((self.state, trigger))
        if row is None:
            return
        action, following = row
        self._enter(following, now_s)
        follow_up = getattr(self, "_" + action)(reply or Reply(kind=""), now_s)
        if follow_up is not None:
            self._fire(follow_up, now_s, reply)

    def _enter(self, state: State, now_s: float) -> None:
        self.state = state
        self._deadline_s = now_s + WAITS_S[state] if state in WAITS_S else math.inf

    def _choose(self, now_s: float) -> None:
        """Leave the idle state for whatever is due."""
        if now_s >= self._heard_s + ALIVE_QUERY_S:
            self._fire("alive?", now_s)
        elif now_s < self._pause_until_s:
            return
        elif self._quality_due:
            self._fire("quality?", now_s)
        elif self._requests:
            self._fire("request", now_s)
        elif self._ready_s() <= now_s:
            self._fire("frame", now_s)

    def _ready_s(self) -> float:
        first = self.outbox.first()
        return math.inf if first is None else first.ready_s

    def _take_replies(self, now_s: float) -> None:
        while (reply := self.reader.next_reply()) is not None:
            if reply.kind != "E":
                self.identified = True
            self._heard_s = now_s
            self._take(reply, now_s)

    def _take(self, reply: Reply, now_s: float) -> None:
        if reply.kind == "#A" and reply.number is not None and reply.address is not None:
            volts = reply.number * VOLTS_PER_COUNT
            self._events.append(SupplyVoltage(address=reply.address, volts=volts))
        if reply.kind in {"#B", "#U"}:
            self._take_payload(reply, now_s)
        elif reply.kind in {"$B", "$U", "$M", "$P", "$V"}:
            self._fire("echo", now_s, reply)
        else:
            self.counters["errors"] += reply.kind == "E"
            self._fire(reply.kind, now_s, reply)

    def _take_payload(self, reply: Reply, now_s: float) -> None:
        payload = reply.payload
        if reply.kind == "#B" and payload[:1] == b"V" and payload[1:].isdigit():
            if len(payload) == 6 and reply.address is not None:
                volts = int(payload[1:]) * VOLTS_PER_COUNT
                self._events.append(SupplyVoltage(address=reply.address, volts=volts))
                self._fire("volts", now_s, reply)
                return
        if len(payload) <= ENVELOPE_BYTES or (reply.address or payload[0]) != payload[0]:
            self.counters["undecodable"] += 1
            return
        source, sequence = payload[0], payload[1]
        if source == self.settings.address:
            self.counters["own_echoes"] += 1
            return
        self._quality_due = self.settings.quality
        if self._last_sequence.get(source) == sequence and reply.kind == "#U":
            self.counters["repeats"] += 1
            return
        self._last_sequence[source] = sequence
        frame = payload[ENVELOPE_BYTES:]
        self._events.append(FrameHeard(frame=frame, source=source, toa_s=None, heard_s=now_s))

    # ---- actions

    def _ask_alive(self, reply: Reply, now_s: float) -> None:  # noqa: ARG002
        self._output += PROBE

    def _set_address(self, reply: Reply, now_s: float) -> None:  # noqa: ARG002
        self._output += b"$A%03d" % self.settings.address

    def _check_address(self, reply: Reply, now_s: float) -> str | None:
        self._failures_in_row = 0
        if reply.address == self.settings.address:
            return None
        self.counters["restarts"] += 1
        self._events.append(ModemRestarted(at_s=now_s))
        return "foreign"

    def _ask_quality(self, reply: Reply, now_s: float) -> None:  # noqa: ARG002
        self._quality_due = False
        self._output += b"$Q"

    def _note_quality(self, reply: Reply, now_s: float) -> None:  # noqa: ARG002
        corrected = reply.number
        share = None if corrected is None else max(0.0, 1.0 - corrected / 8.0)
        good = int(corrected is not None)
        self._events.append(
            LinkQuality(
                source=None,
                frames=1,
                good_frames=good,
                quality_share=share or 0.0,
                corrected_bytes=corrected,
            )
        )

    def _send_request(self, reply: Reply, now_s: float) -> None:  # noqa: ARG002
        command, self._peer = self._requests.popleft()
        self._is_frame, self._awaits_answer, self._payload = False, True, b""
        self._started_s = now_s
        self._output += b"$%s%03d" % (command.encode("ascii"), self._peer)

    def _send_frame(self, reply: Reply, now_s: float) -> str | None:  # noqa: ARG002
        (item,) = self.outbox.lend(1, FRAME_BYTES)
        stamped = self.outbox.stamped(self._stamp, now_s)
        if not stamped:
            return "nothing"
        settings, self._is_frame, self._started_s = self.settings, True, now_s
        if self._sequence is None:  # a peer may have heard an earlier life's
            self._sequence = int(now_s) % 256
        elif item.attempts == 0:
            self._sequence = (self._sequence + 1) % 256
        self._payload = bytes([settings.address, self._sequence]) + stamped[0]
        self._peer = settings.destination
        self._awaits_answer = settings.acknowledge and settings.destination != BROADCAST
        size = len(self._payload)
        if settings.destination == BROADCAST:
            self._output += b"$B%02d" % size + self._payload
        else:
            kind = b"M" if self._awaits_answer else b"U"
            self._output += b"$%s%03d%02d" % (kind, settings.destination, size) + self._payload
        return None

    def _note_echo(self, reply: Reply, now_s: float) -> None:  # noqa: ARG002
        self._deadline_s = now_s + airtime_s(len(self._payload)) + AIR_MARGIN_S

    def _note_aired(self, reply: Reply, now_s: float) -> None:  # noqa: ARG002
        self._failures_in_row, self._pause_s = 0, self.settings.pause_s
        self.outbox.confirm()
        frame = self._payload[ENVELOPE_BYTES:]
        self._events.append(FrameSent(frame=frame, start_s=self._started_s))

    def _note_range(self, reply: Reply, now_s: float) -> None:
        owtt_s = (reply.number or 0) * COUNT_S
        self._events.append(RangeMeasured(peer=self._peer, owtt_s=owtt_s, at_s=now_s))
        if self._is_frame:
            self._note_aired(reply, now_s)
            frame = self._payload[ENVELOPE_BYTES:]
            self._events.append(FrameAcknowledged(frame=frame, peer=self._peer))

    def _note_silence(self, reply: Reply, now_s: float) -> None:  # noqa: ARG002
        self._events.append(PeerSilent(peer=self._peer, at_s=now_s))
        if self._is_frame:
            self._back_off(now_s, blame=True)

    def _refuse(self, reply: Reply, now_s: float) -> None:  # noqa: ARG002
        self.counters["failures"] += 1
        self._events.append(ModemComplaint(text="modem refuses a command (E)", at_s=now_s))
        self._back_off(now_s, blame=True)

    def _fail(self, reply: Reply, now_s: float) -> str | None:  # noqa: ARG002
        self.counters["failures"] += 1
        self._failures_in_row += 1
        self._back_off(now_s, blame=False)
        if self._failures_in_row < FAILURES_TO_DEATH:
            return None
        self._failures_in_row = 0
        self.counters["deaths"] += 1
        self._events.append(ModemComplaint(text="modem does not answer any more", at_s=now_s))
        return "dead"

    def _back_off(self, now_s: float, *, blame: bool) -> None:
        """Take the frame back; each pause is twice the last, so no storm comes."""
        self.outbox.give_back(blame=blame)
        self._pause_until_s = now_s + self._pause_s
        self._pause_s = min(2.0 * self._pause_s, LONGEST_PAUSE_S)

    def _rest(self, reply: Reply, now_s: float) -> None:
        pass


def open_nanomodem(url: ModemUrl, context: ModemContext) -> Modem:
    """Return the modem of nanomodem:///dev/ttyUSB0?address=2.

    Raises
    ------
    ConfigError
        For an unknown option or a value out of bounds.
    ModemUnavailable
        When the port is not there.
    """
    settings = settings_from_url(url, NanomodemSettings())
    return open_dialect(url, context, settings.baud, lambda: Nanomodem(settings, context.stamp))
