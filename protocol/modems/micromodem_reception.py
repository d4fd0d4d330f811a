"""What a WHOI Micro-Modem says about packets it hears: statistics, clock, frames put together.

Source: the field lists of two open drivers and of the public software interface guide; lines of
real firmware are shorter, longer and run together, so every field is read leniently.
"""

import math
from collections import deque
from dataclasses import dataclass

from protocol.modems.events import FrameHeard, LinkQuality
from protocol.modems.nmea import Sentence

DAY_S = 86_400.0
TIMED_OUT = 2
"""The mode of statistics that belong to no frame."""
PSK_FRAMES_CAP = 8
"""Most frames of one packet (rate 5); what exceeds it before the statistics is dropped."""

STATISTICS_WAIT_S = 4.0
"""Frames are handed on without arrival time when no statistics follow: a packet lasts 3 s."""


def integer(text: str, default: int | None = None) -> int | None:
    """Return the text as an integer, or the default when it is none (or absurdly long)."""
    try:
        return int(text) if len(text) <= 12 else default
    except ValueError:
        return default


def decimal(text: str) -> float | None:
    """Return the text as a finite number, or None."""
    try:
        value = float(text) if len(text) <= 24 else float("nan")
    except ValueError:
        return None
    return value if abs(value) < 1e12 else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Statistics:
    """One CACST line: mode 0 good, 1 bad CRC, 2 packet time-out (then little else is told).

    second_of_day is the time of arrival on the modem's clock, to 0.1 ms.
    """

    mode: int
    second_of_day: float | None
    clock_mode: int | None
    rate: int | None = None
    source: int | None = None
    frames: int | None = None
    bad_frames: int | None = None
    snr_in_db: float | None = None
    snr_out_db: float | None = None
    quality: int | None = None
    doppler_mps: float | None = None


def second_of_day(text: str) -> float | None:
    """Return seconds since midnight of hhmmss.ffff, or of the same after a date yyyymmdd."""
    whole, _, fraction = text.partition(".")
    digits = whole[-6:]
    if len(whole) not in {6, 14} or not (whole + fraction).isdecimal():
        return None
    hours, minutes, seconds = int(digits[:2]), int(digits[2:4]), int(digits[4:6])
    part = decimal("0." + fraction) if fraction else 0.0
    if hours > 23 or minutes > 59 or seconds > 60 or part is None:
        return None
    return hours * 3600 + minutes * 60 + seconds + part


def parse_statistics(sentence: Sentence) -> Statistics | None:
    """Return what a CACST line tells, or None when not even its mode can be read.

    Version 6 lines carry a leading `6` and shift everything by one. Noise, carrier and bandwidth,
    which come last and in some firmware run together, are left alone.
    """
    fields = list(sentence.fields)
    if fields and fields[0] == "6":
        fields = fields[1:]
    mode = integer(fields[0]) if fields else None
    if mode is None:
        return None
    fields += [""] * (26 - len(fields))
    return Statistics(
        mode=mode,
        second_of_day=second_of_day(fields[1]),
        clock_mode=integer(fields[2]),
        rate=integer(fields[12]),
        source=integer(fields[13]),
        frames=integer(fields[17]),
        bad_frames=integer(fields[18]),
        snr_in_db=decimal(fields[20]),
        snr_out_db=decimal(fields[21]),
        quality=integer(fields[24]),
        doppler_mps=decimal(fields[25]),
    )


def pulse_is_good(clock_mode: int | None, *, bit_field: bool) -> bool:
    """Return whether this clock mode means that a true pulse per second drives the modem.

    Old firmware: 2 and 3 (pulse good). Micromodem-2 from 2.0.26038: a bit field whose bits 2 to 4
    name the pulse's source, 3 being the external pin.
    """
    if clock_mode is None or clock_mode < 0:
        return False
    return (clock_mode >> 2) & 7 == 3 if bit_field else clock_mode in {2, 3}


def mission_time_s(second_of_day: float, zero_second_of_day: float, near_s: float) -> float:
    """Return the mission time of a second of the day: of all days the one nearest to near_s."""
    time_s = (second_of_day - zero_second_of_day) % DAY_S
    return time_s + DAY_S * round((near_s - time_s) / DAY_S)


class PacketInProgress:
    """The frames of the packet that is being heard, until the statistics tell when it came."""

    def __init__(self, own_address: int) -> None:
        self._own_address = own_address
        self._frames: deque[tuple[int | None, bytes]] = deque(maxlen=PSK_FRAMES_CAP)
        self._since_s = 0.0
        self.counters = {"own_echoes": 0, "undecodable": 0, "bad_frames": 0, "packet_timeouts": 0}

    def take(self, sentence: Sentence, now_s: float) -> None:
        """Take CARXD, CARDP and CAMSG; whatever cannot be read is counted."""
        if sentence.name == "CARXD" and len(sentence.fields) >= 5:
            self._keep(sentence.fields[0], sentence.fields[4], now_s)
        elif sentence.name == "CARDP" and len(sentence.fields) >= 6:
            for listed in sentence.fields[5:7]:
                self._keep_listed(sentence.fields[0], listed, now_s)
        elif sentence.name == "CAMSG" and sentence.fields:
            text = sentence.fields[0].upper().replace(" ", "_")
            self.counters["bad_frames"] += text == "BAD_CRC"
            self.counters["packet_timeouts"] += text == "PACKET_TIMEOUT"
        else:
            self.counters["undecodable"] += 1

    def finish(self, toa_s: float | None, now_s: float) -> list[FrameHeard]:
        """Return the packet's frames with its time of arrival, and start afresh."""
        heard = [
            FrameHeard(frame=frame, source=source, toa_s=toa_s, heard_s=now_s)
            for source, frame in self._frames
        ]
        self._frames.clear()
        return heard

    def overdue(self, now_s: float) -> bool:
        """Return whether frames have waited longer for statistics than a packet lasts."""
        return bool(self._frames) and now_s - self._since_s > STATISTICS_WAIT_S

    def is_of(self, statistics: Statistics) -> bool:
        """Return whether statistics are, as far as they tell, those of the frames that wait."""
        same = all(statistics.source in {None, sender} for sender, _ in self._frames)
        return self.waiting and same and statistics.mode != TIMED_OUT

    @property
    def waiting(self) -> bool:
        """Whether frames wait for their statistics."""
        return bool(self._frames)

    @property
    def deadline_s(self) -> float:
        """When the waiting frames will be handed on without arrival time."""
        return self._since_s + STATISTICS_WAIT_S if self._frames else math.inf

    def _keep_listed(self, source: str, listed: str, now_s: float) -> None:
        parts = listed.split(";")
        for good, _, digits in zip(parts[0::3], parts[1::3], parts[2::3], strict=False):
            if good == "1":
                self._keep(source, digits, now_s)
            else:
                self.counters["bad_frames"] += 1

    def _keep(self, source: str, digits: str, now_s: float) -> None:
        sender = integer(source)
        if sender == self._own_address:
            self.counters["own_echoes"] += 1
            return
        try:
            frame = bytes.fromhex(digits)
        except ValueError:
            self.counters["undecodable"] += 1
            return
        if frame:
            self._since_s = now_s
            self._frames.append((sender, frame))


def quality_of(statistics: Statistics, heard_frames: int) -> LinkQuality:
    """Return the link quality that a packet's statistics tell."""
    frames = max(statistics.frames or 0, heard_frames)
    bad = min(max(statistics.bad_frames or 0, 0), frames)
    good = heard_frames if statistics.bad_frames is None else frames - bad
    share = None if statistics.quality is None else min(max(statistics.quality / 255.0, 0.0), 1.0)
    return LinkQuality(
        source=statistics.source,
        frames=frames,
        good_frames=good,
        quality_share=share,
        snr_in_db=statistics.snr_in_db,
        snr_out_db=statistics.snr_out_db,
        doppler_mps=statistics.doppler_mps,
    )
