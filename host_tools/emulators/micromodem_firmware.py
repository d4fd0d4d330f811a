"""What an emulated Micro-Modem knows of itself: firmware, settings, clock, packet durations."""

import math
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from protocol.modems.micromodem_settings import FRAMES_AND_BYTES

PACKET_S: dict[int, float] = {0: 4.2, 1: 3.0, 2: 3.0, 3: 3.0, 4: 3.0, 5: 3.4, 6: 2.95}
"""Full packets: rate 6 is documented, rate 0 is 32 bytes at 80 bit/s and its cycle packet, and all
PSK packets last about 3 s."""
OVERHEAD_S = 0.4
"""Of every packet: detection sweep and header; the rest is shared by the frames."""
CONTROL_S = 0.9
"""Pings, their replies, mini-packets and acknowledgements: one short FSK packet."""
BURST_BPS: dict[int, float] = {1: 500.0, 2: 500.0, 3: 1400.0, 4: 1400.0, 5: 5400.0}
MM1, MM2 = "0.94.0", "2.0.36870"

NMEA_KEYS: dict[str, str] = {
    "AGC": "0", "AGN": "250", "ASD": "0", "BND": "1", "BR1": "3", "BR2": "3", "CPR": "1",
    "CRL": "50", "CST": "0", "CTO": "10", "DBG": "0", "DGM": "0", "DOP": "1", "DQF": "1",
    "DTH": "108", "DTO": "2", "DTP": "90", "ECD": "50", "EFB": "10", "EFF": "20", "FMD": "1",
    "FML": "200", "GPS": "0", "HFC": "0", "IRE": "0", "MCM": "1", "MFD": "1", "MOD": "0",
    "MPR": "1", "MSE": "0", "NDT": "150", "NPT": "50", "NRL": "25", "NRV": "150", "PAD": "2",
    "PCM": "0", "POW": "-100", "PRL": "25", "PTH": "50", "PTO": "14", "REV": "1", "RXA": "0",
    "RXD": "1", "RXP": "0", "SCG": "0", "SGP": "0", "SHF": "0", "SNR": "0", "SNV": "0",
    "SRC": "0", "TAT": "50", "TOA": "0", "TXD": "600", "TXF": "1", "TXP": "1", "XST": "0",
}  # fmt: skip
"""Factory settings that CCCFG takes; names from the public guide, values plausible."""


def packet_s(rate: int, frames: int) -> float:
    """Return how long a packet of so many frames sounds."""
    most, _ = FRAMES_AND_BYTES[rate]
    return OVERHEAD_S + (PACKET_S[rate] - OVERHEAD_S) * max(frames, 1) / most


def flexible_s(rate: int, size_bytes: int) -> float:
    """Return how long a flexible packet sounds."""
    return OVERHEAD_S + 8.0 * size_bytes / BURST_BPS.get(rate, 500.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class MicroModemQuirks:
    """What differs from one modem, firmware, adapter or day to another."""

    firmware: str = MM2
    baud: int = 19_200
    terminator: bytes = b"\r\n"
    statistics_version: int = 0
    runs_noise_into_carrier: bool = False
    heartbeat_in_dump: bool = True
    heartbeat_s: float = 20.0
    forgets_settings: bool = False
    keeps_time: bool = False
    boot_s: float = 1.0
    silent_boot: bool = False
    omits_range: bool = False
    echoes_own: bool = False
    refuses_all: bool = False
    sends_noise: bytes = b""

    @property
    def is_second_generation(self) -> bool:
        """Whether this is a Micro-Modem 2."""
        return self.firmware.startswith("2.")

    @property
    def has_bit_field(self) -> bool:
        """Whether the clock mode is told as a bit field."""
        parts = [int(part) for part in self.firmware.split(".")]
        return self.is_second_generation and parts >= [2, 0, 26038]

    @property
    def needs_even_bytes(self) -> bool:
        """Whether flexible packets of an odd size are refused."""
        parts = [int(part) for part in self.firmware.split(".")]
        return self.is_second_generation and parts < [2, 0, 35490]


class RealTimeClock:
    """UTC as the modem believes it; exact on the pulse once it is set, lost without a battery."""

    def __init__(self, pulse_present: bool = True) -> None:
        self.pulse_present = pulse_present
        self.is_set = False
        self._origin = datetime(2000, 1, 1, tzinfo=UTC)
        self._origin_s = 0.0

    def set(self, moment: datetime, now_s: float) -> None:
        """Take a time that holds from the next pulse on (without pulse: from now on)."""
        self._origin, self.is_set = moment, True
        self._origin_s = math.floor(now_s) + 1.0 if self.pulse_present else now_s + 0.0137

    def lose(self, now_s: float) -> None:
        """Forget the time: after power-up the clock counts from a date long past."""
        self._origin, self.is_set = datetime(2000, 1, 1, tzinfo=UTC), False
        self._origin_s = math.floor(now_s) if self.pulse_present else now_s

    def read(self, now_s: float) -> datetime:
        """Return the modem's time."""
        return self._origin + timedelta(seconds=now_s - self._origin_s)

    def hhmmss(self, now_s: float) -> str:
        """Return the time of day on whole seconds."""
        return self.read(now_s + 1e-7).strftime("%H%M%S")

    def arrival(self, toa_s: float, *, with_date: bool) -> str:
        """Return a time of arrival to 0.1 ms, as statistics tell it."""
        ticks = round((toa_s - self._origin_s) * 1e4)
        moment = self._origin + timedelta(seconds=ticks // 10_000)
        return moment.strftime("%Y%m%d%H%M%S" if with_date else "%H%M%S") + f".{ticks % 10_000:04d}"

    def mode(self, *, bit_field: bool) -> int:
        """Return the clock mode: old 0 to 3, or clock source and pulse source in bits."""
        if bit_field:
            return (2 if self.is_set else 1) | (3 if self.pulse_present else 1) << 2
        return 2 * self.pulse_present + self.is_set
