"""Modem drivers' cores on a bench of emulated modems, in virtual time and without any port."""

import math
from collections.abc import Mapping

from host_tools.emulators.bench import Bench
from protocol.modems.dialect_driver import Core
from protocol.modems.events import DialectEvent

SMALLEST_STEP_S = 1e-4
"""Wake-ups closer than this are one; no line carries a byte faster."""


class Rig:
    """Moves bytes between each core and its unit, from one event to the next.

    With a period the cores are polled on its multiples only, as a vehicle's loop does.
    """

    def __init__(self, bench: Bench, cores: Mapping[int, Core], period_s: float = 0.0) -> None:
        self.bench, self.cores, self.period_s = bench, dict(cores), period_s
        self.now_s = 0.0
        self.unplugged: set[int] = set()
        self.events: dict[int, list[DialectEvent]] = {node: [] for node in cores}

    def run_until(self, time_s: float) -> None:
        """Let virtual time pass."""
        while True:
            self.bench.advance(self.now_s)
            for node in self.cores:
                self._move(node)
            wakeups = [
                core.next_wakeup_s(self.now_s)
                for node, core in self.cores.items()
                if node not in self.unplugged
            ]
            next_s = min([self.bench.next_event_s(), *wakeups])
            if max(next_s, self.now_s + SMALLEST_STEP_S) > time_s or math.isinf(next_s):
                break
            self.now_s = max(next_s, self.now_s + SMALLEST_STEP_S)
            if self.period_s:
                self.now_s = math.ceil(self.now_s / self.period_s) * self.period_s
        self.now_s = max(self.now_s, time_s)

    def unplug(self, node: int) -> None:
        """Pull the cable between a core and its modem."""
        self.unplugged.add(node)
        self.cores[node].lost(self.now_s)

    def plug(self, node: int) -> None:
        """Put the cable back; what the modem said meanwhile is gone."""
        self.bench.units[node].poll(self.now_s)
        self.unplugged.discard(node)

    def taken(self, node: int, kind: type[DialectEvent]) -> list[DialectEvent]:
        """Return and forget the events of one kind."""
        found = [event for event in self.events[node] if isinstance(event, kind)]
        self.events[node] = [event for event in self.events[node] if not isinstance(event, kind)]
        return found

    def _move(self, node: int) -> None:
        core, unit = self.cores[node], self.bench.units[node]
        data = unit.poll(self.now_s)
        if node in self.unplugged:
            return
        if data:
            core.receive_data(data, self.now_s)
        output = core.poll(self.now_s)
        if output:
            unit.receive_data(output, self.now_s)
            self.bench.advance(self.now_s)
        while (event := core.next_event()) is not None:
            self.events[node].append(event)
