"""The engine under the Micro-Modem's table: triggers, waits, tries, and one line at a time."""

import math
from collections import deque
from collections.abc import Callable
from functools import partial

from protocol.modems.dialect_driver import EVENTS_CAP
from protocol.modems.events import DialectEvent, ModemComplaint
from protocol.modems.micromodem_clock import ModemClock
from protocol.modems.micromodem_reception import PacketInProgress
from protocol.modems.micromodem_settings import FRAMES_AND_BYTES, MicroModemSettings
from protocol.modems.micromodem_states import TABLE, WAITS, State
from protocol.modems.nmea import Sentence, SentenceReader
from protocol.modems.outbox import Outbox
from protocol.modems.stamping import Stamp, stamp_frame

NOTHING = Sentence(name="", fields=())


class Machine:
    """Runs the table; the actions are the methods named there, in the subclasses.

    An action gets the sentence that triggered it and may return a further trigger.
    """

    name = "micromodem"

    def __init__(self, settings: MicroModemSettings, stamp: Stamp = stamp_frame) -> None:
        self.settings = settings
        self.frames_per_packet, self.frame_bytes = FRAMES_AND_BYTES[settings.rate]
        self.state = State.CLOSED
        self.identified = False
        self.clock = ModemClock(settings.utc_at_zero)
        self.outbox = Outbox(settings.queue_frames)
        self.reader = SentenceReader()
        self.packet = PacketInProgress(settings.address)
        self.counters = {
            "errors": 0,
            "failures": 0,
            "restarts": 0,
            "deaths": 0,
            "late": 0,
            "settings_refused": 0,
        }
        self._stamp = stamp
        self._events: deque[DialectEvent] = deque(maxlen=EVENTS_CAP)
        self._output = bytearray()
        self._later: tuple[float, Callable[[float], None]] | None = None
        self._last_line = b""
        self._again: Callable[[float], None] = partial(self._say, b"")
        self._deadline_s, self._tries = math.inf, 0
        self._heard_s = 0.0

    def receive_data(self, data: bytes, now_s: float) -> None:
        """Take what the modem said, in any chunking; nothing in it can raise."""
        self.reader.receive_data(data)
        while (sentence := self.reader.next_sentence()) is not None:
            self._heard_s, self.identified = now_s, True
            if self.state is State.LISTENING:
                self._fire("heard", sentence, now_s)
            self._take(sentence, now_s)

    def next_event(self) -> DialectEvent | None:
        """Return the oldest event not yet fetched."""
        if self.outbox.dropped:
            return self.outbox.dropped.popleft()
        return self._events.popleft() if self._events else None

    def lost(self, now_s: float) -> None:
        """Begin again: what was on its way is queued again, all is asked anew at once."""
        self.reader.clear()
        self._output.clear()
        self._events.extend(self.packet.finish(None, now_s))
        self.outbox.recall(now_s)
        self._heard_s = now_s
        self._fire("lost", NOTHING, now_s)

    def status(self) -> dict[str, int]:
        """Return every counter of this side of the line."""
        reading = {
            "lines": self.reader.sound_count,
            "damaged_lines": self.reader.damaged_count,
            "unread_lines": self.reader.unread_count,
        }
        parts = (self.counters, self.outbox.counters, self.packet.counters, self.clock.counters)
        return reading | {key: value for part in parts for key, value in part.items()}

    def _take(self, sentence: Sentence, now_s: float) -> None:
        self._fire(sentence.name, sentence, now_s)

    def _fire(self, trigger: str, sentence: Sentence, now_s: float) -> None:
        """Do what the table says for a trigger in this state; unlisted pairs change nothing."""
        row = TABLE.get((self.state, trigger))
        if row is None:
            return
        action, following = row
        if following is not self.state:
            self._enter(following, now_s)
        follow_up = getattr(self, action)(sentence, now_s)
        if follow_up is not None:
            self._fire(follow_up, sentence, now_s)

    def _enter(self, state: State, now_s: float) -> None:
        self.state, self._tries, self._later = state, 0, None
        self._deadline_s = now_s + WAITS[state].seconds if state in WAITS else math.inf

    def _run_waits(self, now_s: float) -> None:
        """Say what was put off, ask again what was not answered, give up after all tries."""
        if self._later is not None and now_s >= self._later[0]:
            (_, act), self._later = self._later, None
            act(now_s)
        if now_s < self._deadline_s:
            return
        wait = WAITS[self.state]
        self._tries += 1
        if self._tries < wait.tries:
            self._again(now_s)
        else:
            self._deadline_s = math.inf
            self._fire(wait.then, NOTHING, now_s)

    def _say(self, line: bytes, now_s: float) -> None:
        """Say a line now, and wait for its answer as long as the state allows."""
        self._later, self._last_line, self._again = None, line, partial(self._say, line)
        self._output += line
        if self.state in WAITS:
            self._deadline_s = now_s + WAITS[self.state].seconds

    def _say_in_window(self, line_at: Callable[[float], bytes], now_s: float) -> None:
        """Say a line about the clock early in a second; the wait starts then.

        Asked again it is made anew: it is about the second in which it is said.
        """
        anew = partial(self._say_in_window, line_at)
        due_s = self.clock.next_window_s(now_s)
        if now_s >= due_s:
            self._say(line_at(now_s), now_s)
            self._again = anew
        else:
            self._do_later(due_s, anew)

    def _do_later(self, due_s: float, act: Callable[[float], None]) -> None:
        """Put an action off; nothing is waited for until then."""
        self._later, self._deadline_s = (due_s, act), math.inf

    def _complain(self, text: str, now_s: float) -> None:
        self._events.append(ModemComplaint(text=text, at_s=now_s))

    def rest(self, sentence: Sentence, now_s: float) -> str | None:  # noqa: ARG002
        """Do nothing: the new state is all."""
        return None
