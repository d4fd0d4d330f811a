"""Drivers on emulated modems behind real pseudo-terminals, in virtual time."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from host_tools.emulators.bench import Unit
from host_tools.emulators.run import Emulation, EmulationSettings
from protocol.modems.base import LinkNotice, ModemContext, ModemEvent, Reception, Tap
from protocol.modems.dialect_driver import DialectDriver
from protocol.modems.registry import open_modem
from tests.modems.rigs import CALM

STEP_S = 0.02


class Pair:
    """An emulation, and a driver on each of its ports."""

    def __init__(self, emulation: Emulation, urls: list[str], tap: Tap | None = None) -> None:
        self.emulation, self.now_s = emulation, 0.0
        self.drivers: list[DialectDriver] = []
        self._spoken = [0 for _ in urls]
        self._tap = tap
        for index, url in enumerate(urls):
            driver = open_modem(url, ModemContext(tap=self._counting_tap(index)))
            assert isinstance(driver, DialectDriver)
            self.drivers.append(driver)
        self.events: list[list[ModemEvent]] = [[] for _ in urls]

    def run(self, seconds: float) -> None:
        """Let virtual time pass in steps of a loop's period."""
        for _ in range(round(seconds / STEP_S)):
            self.step_water()
            for index, driver in enumerate(self.drivers):
                self.step_driver(index)
                while (event := driver.next_event()) is not None:
                    self.events[index].append(event)

    def step_water(self) -> None:
        """Let one step pass at the modems, until its bytes can be read."""
        self.now_s += STEP_S
        ports = list(self.emulation.ports.values())
        wanted = [port.waiting_bytes()[0] - port.written_bytes for port in ports]
        self.emulation.step(self.now_s)
        for port, before in zip(ports, wanted, strict=True):
            self._wait(lambda p=port, b=before: p.waiting_bytes()[0] >= b + p.written_bytes)  # type: ignore[misc]

    def step_driver(self, index: int) -> None:
        """Poll a driver, until the modem's end can read what it said."""
        port = list(self.emulation.ports.values())[index]
        before = port.waiting_bytes()[1] - self._spoken[index]
        self.drivers[index].poll(self.now_s)
        wanted = before + self._spoken[index]
        self._wait(lambda: port.fileno is None or port.waiting_bytes()[1] >= wanted)

    @staticmethod
    def _wait(condition: Callable[[], bool]) -> None:
        end_s = time.monotonic() + 1.0
        while not condition():
            assert time.monotonic() < end_s, "the pseudo-terminal did not hand the bytes across"

    def _counting_tap(self, index: int) -> Tap:
        def tap(direction: str, data: bytes, now_s: float) -> None:
            if direction == "out":
                self._spoken[index] += len(data)
            if self._tap is not None and index == 0:
                self._tap(direction, data, now_s)

        return tap

    def frames(self, index: int) -> list[bytes]:
        return [e.frame for e in self.events[index] if isinstance(e, Reception)]

    def notices(self, index: int) -> list[str]:
        return [e.text for e in self.events[index] if isinstance(e, LinkNotice)]


@contextmanager
def pair(
    kind: str,
    directory: Path,
    *,
    options: str = "",
    urls: list[str] | None = None,
    tap: Tap | None = None,
    units: dict[int, Unit] | None = None,
) -> Iterator[Pair]:
    settings = EmulationSettings(kind=kind, water=CALM, directory=directory)
    make = None if units is None else units.__getitem__
    emulation = Emulation(settings, make_unit=make)
    both = Pair(emulation, urls or [url + options for url in emulation.urls()], tap)
    try:
        yield both
    finally:
        for driver in both.drivers:
            driver.close()
        emulation.close()
