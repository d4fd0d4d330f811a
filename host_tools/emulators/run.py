"""Emulated modems on pseudo-terminals: for programs of others, and for tests with a clock.

`emulate` is what `fathomlink emulate micromodem --nodes 2` calls: it prints the names and URLs of
the ports, then is the modems and the water until it is interrupted.
"""

import contextlib
import math
import select
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from host_tools.emulators.bench import Bench, Unit
from host_tools.emulators.micromodem import MicroModemUnit
from host_tools.emulators.micromodem_firmware import MicroModemQuirks
from host_tools.emulators.nanomodem import NanomodemQuirks, NanomodemUnit
from host_tools.emulators.ptys import PseudoPort
from protocol.acoustics import Position, Water, WaterSettings
from protocol.errors import ConfigError

KINDS = ("micromodem", "nanomodem")
FARTHEST_M = 100e3
LONGEST_NAP_S = 0.05
"""How long the loop may sleep while nothing happens; a host's bytes wake it at once."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EmulationSettings:
    """Which modems, how far apart, and in what water."""

    kind: str = "micromodem"
    nodes: int = 2
    range_m: float = 500.0
    seed: int = 1
    water: WaterSettings = WaterSettings(outlier_share=0.0)
    directory: Path | None = None


class Emulation:
    """A bench with a pseudo-terminal for every modem; `step` moves bytes and passes time on."""

    def __init__(
        self,
        settings: EmulationSettings,
        position_of: Callable[[int, float], Position] | None = None,
        make_unit: Callable[[int], Unit] | None = None,
    ) -> None:
        if settings.kind not in KINDS:
            raise ConfigError(f"no emulator {settings.kind!r}; known are {', '.join(KINDS)}")
        if not 2 <= settings.nodes <= 15:
            raise ConfigError(f"{settings.nodes} nodes; give 2 to 15")
        if not 0.0 <= settings.range_m <= FARTHEST_M:
            raise ConfigError(
                f"{settings.range_m:g} m between neighbours; give 0 to {FARTHEST_M:g}"
            )
        self.settings = settings
        nodes = range(1, settings.nodes + 1)
        rng = np.random.default_rng(settings.seed)
        place = position_of or (lambda node, _: (settings.range_m * (node - 1), 0.0, 20.0))
        self.water = Water(settings.water, rng, place, nodes=tuple(nodes))
        self.bench = Bench(self.water, {n: (make_unit or self._unit)(n) for n in nodes})
        self.ports = {node: PseudoPort(self._baud(), self._link(node)) for node in nodes}

    def urls(self) -> list[str]:
        """Return one modem URL per node, to be given to the programs under test."""
        kind = self.settings.kind
        return [f"{kind}://{port.name}?address={node}" for node, port in self.ports.items()]

    def step(self, now_s: float) -> None:
        """Hand on what the hosts wrote, let time pass, and hand back what the modems say."""
        self.bench.advance(now_s)
        for node, port in self.ports.items():
            data = port.read()
            if data:
                self.bench.units[node].receive_data(data, now_s)
        self.bench.advance(now_s)
        for node, port in self.ports.items():
            port.write(self.bench.units[node].poll(now_s))

    def next_event_s(self) -> float:
        """Return when something will happen by itself."""
        return self.bench.next_event_s()

    def close(self) -> None:
        """Take the ports away."""
        for port in self.ports.values():
            port.close()

    def _baud(self) -> int:
        return 19_200 if self.settings.kind == "micromodem" else 9_600

    def _link(self, node: int) -> Path | None:
        directory = self.settings.directory
        return None if directory is None else directory / f"{self.settings.kind}-{node}"

    def _unit(self, node: int) -> Unit:
        if self.settings.kind == "micromodem":
            return MicroModemUnit(node, MicroModemQuirks())
        return NanomodemUnit(node, NanomodemQuirks())


@contextlib.contextmanager
def emulation(settings: EmulationSettings) -> Iterator[Emulation]:
    """Give an emulation, and take its ports away in the end."""
    running = Emulation(settings)
    try:
        yield running
    finally:
        running.close()


def emulate(
    settings: EmulationSettings,
    say: Callable[[str], None] = print,
    clock: Callable[[], float] = time.monotonic,
    should_stop: Callable[[], bool] = lambda: False,
) -> int:
    """Run emulated modems in real time until interrupted; return the exit status.

    The modems' pulses come on this machine's whole UTC seconds, as from a GNSS receiver, so any
    host program here whose mission clock starts on such a second gets one-way ranges.
    """
    with emulation(settings) as running, contextlib.suppress(KeyboardInterrupt):
        zero_s = clock() - time.clock_gettime(time.CLOCK_REALTIME) % 1.0
        for node, url in enumerate(running.urls(), 1):
            say(f"node {node}: {url}")
        while not should_stop():
            now_s = clock() - zero_s
            running.step(now_s)
            _nap(running.ports.values(), running.next_event_s() - now_s)
    return 0


def _nap(ports: Iterable[PseudoPort], due_in_s: float) -> None:
    """Sleep until a host writes, something is due, or the longest nap is over."""
    descriptors = [port.fileno for port in ports if port.fileno is not None]
    nap_s = LONGEST_NAP_S if math.isinf(due_in_s) else min(max(due_in_s, 0.001), LONGEST_NAP_S)
    select.select(descriptors, [], [], nap_s)
