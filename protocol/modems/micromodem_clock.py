"""Setting and checking the Micro-Modem's clock, and mission time from its times of arrival.

The modem keeps UTC. Mission time zero is a configured UTC instant on a whole second, the same for
all vehicles; only then do times of arrival compare across them.
"""

import math
from datetime import UTC, datetime, timedelta

from protocol.errors import ConfigError
from protocol.modems.micromodem_reception import (
    integer,
    mission_time_s,
    pulse_is_good,
    second_of_day,
)
from protocol.modems.nmea import Sentence, encode

SKEW_ALLOWED_S = 1.0
"""What a clock may be off before it is called wrong; less is the delay of lines and loops."""

EARLIEST_IN_SECOND_S, LATEST_IN_SECOND_S = 0.05, 0.45
"""The set-clock line goes after a second's start and names the next one, when it takes effect."""

BIT_FIELD_SINCE = (2, 0, 26038)
"""Firmware of the Micro-Modem 2 from which the clock mode is a bit field."""

EVEN_BYTES_BEFORE = (2, 0, 35490)
"""Older Micro-Modem 2 firmware takes flexible packets of an even number of bytes only."""


def parse_utc(text: str) -> datetime:
    """Return an ISO 8601 time on a whole second as UTC.

    Raises
    ------
    ConfigError
        When it is not such a time.
    """
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise ConfigError(f"{text!r} is not a time like 2026-06-01T12:00:00Z") from error
    moment = moment.astimezone(UTC) if moment.tzinfo else moment.replace(tzinfo=UTC)
    if moment.microsecond:
        raise ConfigError(f"{text!r}: mission time starts on a whole second")
    return moment


def parse_version(text: str) -> tuple[int, ...] | None:
    """Return a firmware version like 2.0.27087 as numbers."""
    parts = text.split(".")
    numbers = [integer(part) for part in parts if part.isdecimal()]
    known = tuple(number for number in numbers if number is not None)
    return known if len(known) == len(parts) else None


class ModemClock:
    """What is known of the modem's clock: firmware, whether it is set, and the pulse's mode."""

    def __init__(self, utc_at_zero: str) -> None:
        self._zero = parse_utc(utc_at_zero)
        self._zero_second_of_day = float(
            self._zero.hour * 3600 + self._zero.minute * 60 + self._zero.second
        )
        self.firmware: tuple[int, ...] | None = None
        self.is_set = False
        self.mode: int | None = None
        self.speaks_new = True
        self.counters = {"clock_set": 0, "clock_wrong": 0, "unsynchronised_arrivals": 0}

    @property
    def generation(self) -> int:
        """Return 2 for a Micro-Modem 2, 1 for anything older or unknown."""
        return 2 if self.firmware is not None and self.firmware[0] == 2 else 1

    @property
    def bit_field(self) -> bool:
        """Return whether this firmware tells the clock mode as a bit field."""
        return self.generation == 2 and (self.firmware or ()) >= BIT_FIELD_SINCE

    @property
    def takes_odd_sizes(self) -> bool:
        """Return whether flexible packets may have an odd number of bytes."""
        return self.generation == 2 and (self.firmware or ()) >= EVEN_BYTES_BEFORE

    @property
    def pulse_is_good(self) -> bool:
        """Return whether arrivals may be used as one-way travel times."""
        return pulse_is_good(self.mode, bit_field=self.bit_field)

    def in_window(self, now_s: float) -> bool:
        """Return whether the set-clock line may go out now."""
        return EARLIEST_IN_SECOND_S <= now_s % 1.0 <= LATEST_IN_SECOND_S

    def next_window_s(self, now_s: float) -> float:
        """Return when the set-clock line may go out."""
        if self.in_window(now_s):
            return now_s
        whole = math.floor(now_s)
        early = now_s - whole < EARLIEST_IN_SECOND_S
        return whole + EARLIEST_IN_SECOND_S + (0.0 if early else 1.0) + 0.01

    def set_line(self, now_s: float) -> bytes:
        """Return the line that sets the clock to the next whole second."""
        self.counters["clock_set"] += 1
        moment = self._zero + timedelta(seconds=math.floor(now_s) + 1)
        if self.speaks_new:
            return encode("CCTMS", moment.strftime("%Y-%m-%dT%H:%M:%SZ"), 0)
        return encode("CCCLK", *moment.strftime("%Y,%m,%d,%H,%M,%S").split(","))

    def told_right(self, sentence: Sentence, asked_s: float) -> bool | None:
        """Return whether a CATMQ line names the second it was asked in; None when it names none.

        It is asked early in a second and answered about half a second later, within the same.
        """
        text = sentence.fields[0] if sentence.fields else ""
        told = second_of_day(text[11:19].replace(":", "")) if len(text) >= 19 else None
        if told is None:
            return None
        return mission_time_s(told, self._zero_second_of_day, asked_s) == math.floor(asked_s)

    def note_heartbeat(self, hhmmss: str, now_s: float) -> None:
        """Take the time in a CAREV line: two seconds off, and the clock must be set again."""
        told = second_of_day(hhmmss)
        if told is None or not self.is_set:
            return
        skew_s = mission_time_s(told, self._zero_second_of_day, now_s) - now_s
        if abs(skew_s) > 2.0 * SKEW_ALLOWED_S:
            self.counters["clock_wrong"] += 1
            self.is_set = False

    def arrival_s(self, told: float | None, now_s: float) -> float | None:
        """Return a time of arrival in mission time, or None where it cannot be vouched for.

        It needs a good pulse, a clock that was set and checked, and an arrival in the last
        minute: the packet itself takes seconds, never a minute.
        """
        if told is None:
            return None
        toa_s = mission_time_s(told, self._zero_second_of_day, now_s)
        wrong = not -60.0 <= toa_s - now_s <= SKEW_ALLOWED_S
        self.counters["clock_wrong"] += wrong
        if wrong:
            self.is_set = False
        if wrong or not self.pulse_is_good or not self.is_set:
            self.counters["unsynchronised_arrivals"] += 1
            return None
        return toa_s
