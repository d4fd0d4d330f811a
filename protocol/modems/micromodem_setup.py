"""Getting a Micro-Modem to work: is it there, what is set, what must be, and what time is it.

A dump of all settings has no end marker and may have a heartbeat in its middle; two seconds of
silence end it. A setting holds when the echo has its key and its value.
"""

from collections import deque
from functools import partial

from protocol.modems.events import ModemRestarted
from protocol.modems.micromodem_clock import parse_version
from protocol.modems.micromodem_machine import Machine
from protocol.modems.micromodem_settings import MicroModemSettings
from protocol.modems.micromodem_states import WAITS, State
from protocol.modems.nmea import Sentence, encode
from protocol.modems.stamping import Stamp, stamp_frame

REMEMBERED_SETTINGS = 512
"""Cap of what a dump may tell; a Micro-Modem 2 has under 200 settings."""

CLOCK_TRIES = 3
CLOCK_RETRY_S = 60.0
"""A clock that does not take the time is tried again after a minute; frames go out meanwhile."""


def wanted_settings(settings: MicroModemSettings) -> dict[str, str]:
    """Return what the modem must be set to, in the order in which it is asked."""
    return {
        "SRC": str(settings.address),
        "CST": "1",  # statistics of each packet heard: quality and time of arrival
        "RXP": "1",  # a line at the start of each packet
        "XST": "1",  # statistics of each packet sent
        "REV": "1",  # heartbeats, which betray a power cycle
        "SNV": "1",  # transmit on the pulse per second
    }


class Setup(Machine):
    """The actions from the first question to the idle state."""

    def __init__(self, settings: MicroModemSettings, stamp: Stamp = stamp_frame) -> None:
        super().__init__(settings, stamp)
        self.told: dict[str, str] = {}  # by the last dump
        self._unset: deque[tuple[str, str]] = deque()
        self._asked_s = 0.0
        self._clock_tries, self._clock_retry_s = 0, 0.0

    def ask_alive(self, sentence: Sentence, now_s: float) -> None:  # noqa: ARG002
        """Ask for our address, which every firmware answers."""
        self._say(encode("CCCFQ", "SRC"), now_s)

    def check_address(self, sentence: Sentence, now_s: float) -> str | None:  # noqa: ARG002
        """Compare the modem's address with ours: a swapped or reset modem has another."""
        if sentence.fields[:1] != ("SRC",):
            return None
        return "done" if self._same(sentence.fields[1:], str(self.settings.address)) else "wrong"

    def ask_dump(self, sentence: Sentence, now_s: float) -> None:  # noqa: ARG002
        """Ask for all settings."""
        self.told.clear()
        self._say(encode("CCCFQ", "ALL"), now_s)

    def ask_other_dump(self, sentence: Sentence, now_s: float) -> None:  # noqa: ARG002
        """Ask for all settings the way a Micro-Modem 2 knows, once."""
        if not self._last_line.startswith(b"$CCCFQ,TOP"):
            self._say(encode("CCCFQ", "TOP"), now_s)

    def note_setting(self, sentence: Sentence, now_s: float) -> None:
        """Remember one line of the dump; each line renews the wait for silence."""
        if len(sentence.fields) >= 2 and len(self.told) < REMEMBERED_SETTINGS:
            self.told[sentence.fields[0].upper()] = sentence.fields[1]
        self._deadline_s = now_s + WAITS[State.DUMPING].seconds

    def ask_next_setting(self, sentence: Sentence, now_s: float) -> str | None:
        """Begin setting what differs from what is wanted."""
        self._unset = deque(
            (key, value)
            for key, value in wanted_settings(self.settings).items()
            if not self._same((self.told.get(key, ""),), value)
        )
        return self._set_next(sentence, now_s)

    def check_setting(self, sentence: Sentence, now_s: float) -> str | None:
        """Go on when the echo has the key and the value that were asked for."""
        if not self._unset or sentence.fields[:1] != (self._unset[0][0],):
            return None
        if not self._same(sentence.fields[1:], self._unset[0][1]):
            return "refused"
        self._unset.popleft()
        return self._set_next(sentence, now_s)

    def skip_setting(self, sentence: Sentence, now_s: float) -> str | None:
        """Do without a setting that this firmware does not have."""
        if self._unset:
            key, value = self._unset.popleft()
            self.counters["settings_refused"] += 1
            self._complain(f"modem does not take the setting {key}={value}", now_s)
        return self._set_next(sentence, now_s)

    def plan_clock(self, sentence: Sentence, now_s: float) -> None:  # noqa: ARG002
        """Set the clock early in a second, to the next one, by the newer line at first."""
        self._set_clock(now_s, speaks_new=True)

    def plan_other_clock(self, sentence: Sentence, now_s: float) -> str | None:  # noqa: ARG002
        """Try the other generation's line for setting the clock, once."""
        if not self.clock.speaks_new:
            self._complain("modem takes no clock; ranges cannot be measured one way", now_s)
            self._clock_retry_s = now_s + CLOCK_RETRY_S
            return "done"
        self._set_clock(now_s, speaks_new=False)
        return None

    def ask_clock(self, sentence: Sentence, now_s: float) -> str | None:  # noqa: ARG002
        """Ask for the time once the set line has taken effect; old firmware is believed."""
        if not self.clock.speaks_new:
            self.clock.is_set = True
            return "done"
        self._do_later(now_s + 1.0, partial(self._say_in_window, self._clock_query))
        return None

    def check_clock(self, sentence: Sentence, now_s: float) -> str | None:
        """Accept the clock when it names the second it was asked in; else set it again."""
        right = self.clock.told_right(sentence, self._asked_s)
        if right is None:
            return None
        self._clock_retry_s = now_s + CLOCK_RETRY_S
        self.clock.is_set = right
        if right:
            return "done"
        self.clock.counters["clock_wrong"] += 1
        self._clock_tries += 1
        if self._clock_tries < CLOCK_TRIES:
            return "wrong"
        self._complain("modem's clock does not take the time that it is set to", now_s)
        return "done"

    def restart(self, sentence: Sentence, now_s: float) -> None:  # noqa: ARG002
        """Take back what was on its way: the modem was power-cycled or reset."""
        self.counters["restarts"] += 1
        self.clock.is_set = False
        self.outbox.give_back(blame=False)
        self._events.append(ModemRestarted(at_s=now_s))

    def declare_dead(self, sentence: Sentence, now_s: float) -> None:
        """Begin again with the first question, asked once a second until something answers."""
        self.counters["deaths"] += 1
        self.clock.is_set = False
        self.outbox.give_back(blame=False)
        self._complain("modem does not answer any more", now_s)
        self.ask_alive(sentence, now_s)

    def _take_revision(self, fields: tuple[str, ...], now_s: float) -> None:
        """Take a CAREV line: a boot, a heartbeat with the firmware's version, or a coprocessor."""
        if fields[1] == "INIT":
            self._fire("restarted", Sentence(name="CAREV", fields=fields), now_s)
        elif fields[1] == "AUV":
            self.clock.firmware = parse_version(fields[2]) or self.clock.firmware
            self.clock.note_heartbeat(fields[0], now_s)
            self._fire("booted", Sentence(name="CAREV", fields=fields), now_s)

    def _set_clock(self, now_s: float, *, speaks_new: bool) -> None:
        self.clock.is_set, self.clock.speaks_new = False, speaks_new
        self._say_in_window(self.clock.set_line, now_s)

    def _clock_query(self, now_s: float) -> bytes:
        self._asked_s = now_s
        return encode("CCTMQ", 0)

    def _set_next(self, sentence: Sentence, now_s: float) -> str | None:  # noqa: ARG002
        self._tries = 0
        if not self._unset:
            self._clock_tries = 0
            return "done"
        self._say(encode("CCCFG", *self._unset[0]), now_s)
        return None

    @staticmethod
    def _same(told: tuple[str, ...], wanted: str) -> bool:
        return bool(told) and (told[0] == wanted or told[0].lstrip("0") == wanted)
