"""Drivers on emulated modems behind real pseudo-terminals, in virtual time."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from host_tools.emulators.bench import Unit
from host_tools.emulators.lock_step import STEP_S, LockStep
from host_tools.emulators.run import Emulation, EmulationSettings
from protocol.modems.base import LinkNotice, ModemEvent, Reception, Tap
from tests.modems.rigs import CALM


class Pair(LockStep):
    """An emulation in lock step with two drivers, whose events are kept."""

    def __init__(
        self, emulation: Emulation, urls: list[str], tap: Tap | None, step_s: float
    ) -> None:
        super().__init__(emulation, urls, tap, step_s)
        self.events: list[list[ModemEvent]] = [[] for _ in urls]

    def run(self, seconds: float) -> None:
        """Let virtual time pass in steps of a loop's period."""
        for _ in range(round(seconds / self.step_s)):
            self.step()
            for driver, events in zip(self.drivers, self.events, strict=True):
                while (event := driver.next_event()) is not None:
                    events.append(event)

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
    step_s: float = STEP_S,
) -> Iterator[Pair]:
    settings = EmulationSettings(kind=kind, water=CALM, directory=directory)
    make = None if units is None else units.__getitem__
    emulation = Emulation(settings, make_unit=make)
    both = Pair(emulation, urls or [url + options for url in emulation.urls()], tap, step_s)
    try:
        yield both
    finally:
        both.close()
