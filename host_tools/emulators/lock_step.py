"""Drivers and emulated modems in one process and one virtual time, over real pseudo-terminals.

The kernel hands bytes across a pseudo-terminal a little later. Virtual time would run ahead of
them, so every step waits, in real time, until what was said can be heard.
"""

import time
from collections.abc import Callable

from host_tools.emulators.run import Emulation
from protocol.errors import ModemError
from protocol.modems.base import ModemContext, Tap
from protocol.modems.dialect_driver import DialectDriver
from protocol.modems.registry import open_modem

STEP_S = 0.02
"""Of virtual time: the bench polls its modems this often, and a vehicle's loop ten times less."""
HANDOVER_S = 1.0
"""Of real time: a kernel that takes longer is not going to."""


class LockStep:
    """An emulation, and a driver on each of its ports (or on the URLs that are given)."""

    def __init__(
        self,
        emulation: Emulation,
        urls: list[str] | None = None,
        tap: Tap | None = None,
        step_s: float = STEP_S,
    ) -> None:
        self.emulation, self.now_s, self.step_s = emulation, 0.0, step_s
        self.drivers: list[DialectDriver] = []
        urls = urls or emulation.urls()
        self._spoken = [0 for _ in urls]
        for index, url in enumerate(urls):
            tapped = self._counting_tap(index, tap if index == 0 else None)
            driver = open_modem(url, ModemContext(tap=tapped))
            if not isinstance(driver, DialectDriver):
                raise ModemError(f"{url} is no dialect that can be emulated")
            self.drivers.append(driver)

    def step(self) -> None:
        """Let one step pass at the modems and at the drivers."""
        self.step_water()
        for index in range(len(self.drivers)):
            self.step_driver(index)

    def step_water(self) -> None:
        """Let one step pass at the modems, until its bytes can be read."""
        self.now_s += self.step_s
        ports = list(self.emulation.ports.values())
        wanted = [port.waiting_bytes()[0] - port.written_bytes for port in ports]
        self.emulation.step(self.now_s)
        for port, before in zip(ports, wanted, strict=True):
            _wait(lambda p=port, b=before: p.waiting_bytes()[0] >= b + p.written_bytes)  # type: ignore[misc]

    def step_driver(self, index: int) -> None:
        """Poll a driver, until the modem's end can read what it said."""
        port = list(self.emulation.ports.values())[index]
        before = port.waiting_bytes()[1] - self._spoken[index]
        self.drivers[index].poll(self.now_s)
        wanted = before + self._spoken[index]
        _wait(lambda: port.fileno is None or port.waiting_bytes()[1] >= wanted)

    def close(self) -> None:
        """Give all ports back."""
        for driver in self.drivers:
            driver.close()
        self.emulation.close()

    def _counting_tap(self, index: int, inner: Tap | None) -> Tap:
        def tap(direction: str, data: bytes, now_s: float) -> None:
            if direction == "out":
                self._spoken[index] += len(data)
            if inner is not None:
                inner(direction, data, now_s)

        return tap


def _wait(condition: Callable[[], bool]) -> None:
    end_s = time.monotonic() + HANDOVER_S
    while not condition():
        if time.monotonic() > end_s:
            raise ModemError("the pseudo-terminal did not hand the bytes across")
