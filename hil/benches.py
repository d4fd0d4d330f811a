"""Two modems and the water between them, whatever they are: what every numbered test runs on."""

import math
import os
import tempfile
import time
import tty
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from host_tools.emulators.lock_step import STEP_S, LockStep
from host_tools.emulators.run import Emulation, EmulationSettings
from protocol.acoustics import Position, Water, WaterSettings
from protocol.modems.base import LinkNotice, Modem, Reception
from protocol.modems.dialect_driver import DialectDriver
from protocol.modems.events import DialectEvent
from protocol.modems.loopback import LoopbackMedium
from protocol.modems.registry import open_modem

RANGE_M = 750.0
"""Between the modems of all benches without hardware."""
SECOND_S = 1.0


class Bench(Protocol):
    """Two modems, a clock, and what is known of the truth."""

    modems: list[Modem]

    @property
    def facts(self) -> "Facts":
        """What is known of the bench."""

    @property
    def now_s(self) -> float:
        """The bench's time."""

    def step(self) -> None:
        """Let a little time pass, in which both drivers are polled."""

    def close(self) -> None:
        """Give everything back."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Facts:
    """What kind of bench this is; range_m is None where nobody measured it."""

    kind: str
    is_real: bool = False
    loss: float = 0.0
    range_m: float | None = None
    peer_address: int = 0


class Ends:
    """Keeps what both modems of a bench report, and runs its clock."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.heard: defaultdict[int, list[Reception]] = defaultdict(list)
        self.notices: defaultdict[int, list[str]] = defaultdict(list)
        self.reports: defaultdict[int, list[DialectEvent]] = defaultdict(list)

    def run(self, seconds: float) -> None:
        """Let time pass."""
        end_s = self.bench.now_s + seconds
        while self.bench.now_s < end_s:
            self._step()

    def run_to_second(self) -> None:
        """Let time pass to the next whole second, where transmissions start."""
        self.run(math.ceil(self.bench.now_s / SECOND_S) * SECOND_S - self.bench.now_s)

    def wait_heard(self, end: int, count: int, seconds: float) -> bool:
        """Let time pass until one end has heard so many frames; return whether it did in time."""
        end_s = self.bench.now_s + seconds
        while len(self.heard[end]) < count and self.bench.now_s < end_s:
            self._step()
        return len(self.heard[end]) >= count

    def send(self, end: int, frame: bytes) -> None:
        """Have one end send a frame now."""
        self.bench.modems[end].send(frame, self.bench.now_s)

    def _step(self) -> None:
        self.bench.step()
        for end, modem in enumerate(self.bench.modems):
            while (event := modem.next_event()) is not None:
                match event:
                    case Reception():
                        self.heard[end].append(event)
                    case LinkNotice(text=text):
                        self.notices[end].append(text)
            if isinstance(modem, DialectDriver):
                while (report := modem.next_report()) is not None:
                    self.reports[end].append(report)


def water_settings(loss: float) -> WaterSettings:
    """Return a water whose ranges are exact, so that they can be held against geometry."""
    return WaterSettings(loss=loss, range_noise_m=0.0, outlier_share=0.0)


def place(node: int, _: float) -> Position:
    """Return where node 1 and node 2 (0 and 1 in loopback) lie."""
    return (RANGE_M * node, 0.0, 20.0)


class LoopbackBench:
    """Two loopback modems in one water."""

    def __init__(self, loss: float) -> None:
        self.facts = Facts(kind="loopback", loss=loss, range_m=RANGE_M)
        self.now_s = 0.0
        water = Water(water_settings(loss), np.random.default_rng(7), place)
        medium = LoopbackMedium(water)
        self.modems: list[Modem] = [medium.modem(0), medium.modem(1)]

    def step(self) -> None:
        """Let one step pass."""
        self.now_s = round((self.now_s + STEP_S) / STEP_S) * STEP_S
        for modem in self.modems:
            modem.poll(self.now_s)

    def close(self) -> None:
        """Nothing is held."""


class SerialBench:
    """Two raw serial lines over a pair of pseudo-terminals; bytes pass at once and are not lost."""

    facts = Facts(kind="serial")

    def __init__(self) -> None:
        self.now_s = 0.0
        self._ends = [os.openpty(), os.openpty()]
        self.modems: list[Modem] = []
        for master, slave in self._ends:
            tty.setraw(slave)
            os.set_blocking(master, False)
            self.modems.append(open_modem(f"serial://{os.ttyname(slave)}"))

    def step(self) -> None:
        """Let one step pass; it also takes a little real time, which the kernel needs."""
        self.now_s += STEP_S
        for modem in self.modems:
            modem.poll(self.now_s)
        for (reader, _), (writer, _) in (self._ends, self._ends[::-1]):
            try:
                os.write(writer, os.read(reader, 4096))
            except BlockingIOError:
                continue
        time.sleep(0.0002)

    def close(self) -> None:
        """Give the pseudo-terminals back."""
        for modem in self.modems:
            modem.close()
        for end in self._ends:
            for descriptor in end:
                os.close(descriptor)


class EmulatedBench:
    """Two emulated modems on pseudo-terminals, in virtual time."""

    def __init__(self, kind: str, loss: float) -> None:
        self.facts = Facts(kind=kind, loss=loss, range_m=RANGE_M, peer_address=2)
        self._directory = tempfile.TemporaryDirectory(prefix="fathomlink-")
        settings = EmulationSettings(
            kind=kind, water=water_settings(loss), directory=Path(self._directory.name)
        )
        self._lock_step = LockStep(Emulation(settings, position_of=place))
        self.modems: list[Modem] = list(self._lock_step.drivers)

    @property
    def now_s(self) -> float:
        """The virtual time."""
        return self._lock_step.now_s

    def step(self) -> None:
        """Let one step pass."""
        self._lock_step.step()

    def close(self) -> None:
        """Give the pseudo-terminals back."""
        self._lock_step.close()
        self._directory.cleanup()


class RealBench:
    """Two modems at the ports that the command line names, in real time.

    Time zero is a whole second of this machine's UTC, which has to be kept by NTP or GNSS: the
    modems' pulses come on those seconds.
    """

    def __init__(self, url_a: str, url_b: str, peer_address: int) -> None:
        kind = url_a.split(":", maxsplit=1)[0]
        self.facts = Facts(kind=kind, is_real=True, peer_address=peer_address)
        self._zero_s = time.monotonic() - time.clock_gettime(time.CLOCK_REALTIME) % 1.0
        self.modems: list[Modem] = [open_modem(url_a), open_modem(url_b)]

    @property
    def now_s(self) -> float:
        """Seconds since the bench was opened."""
        return time.monotonic() - self._zero_s

    def step(self) -> None:
        """Poll both drivers, then rest a moment."""
        for modem in self.modems:
            modem.poll(self.now_s)
        time.sleep(0.005)

    def close(self) -> None:
        """Give the ports back."""
        for modem in self.modems:
            modem.close()
