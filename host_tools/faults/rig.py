"""Two computers, their modems and the water between them, under one plan of faults."""

import hashlib
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from host_tools.faults.air import FaultyMedium
from host_tools.faults.catalogue import VEHICLES, Fault, Plan
from host_tools.faults.computer import Computer, LocalClock, Program
from host_tools.faults.disk import Fate, MemoryFiles
from host_tools.faults.modem import FaultyModem
from protocol.acoustics import Delivery, Position, Water, WaterSettings
from protocol.codec import decode
from protocol.errors import RemoteProtocolError
from protocol.modems.sealed import SealedLink, SealedModem
from protocol.packets import SealedFrame
from protocol.seal import Keys, Opener, Sealer
from protocol.seal_state import FileMarks, ReservedCounter

KEYS = Keys(b"the key of the two of one fleet.")
RECOVERY_S = 600.0
"""Within this after the last fault all must be well again."""

_FORGETFUL = (Fault.DISK_FULL, Fault.STORE_READ_ONLY)
"""With no disk for its marks, a receiver that dies may take a replayed frame for a new one."""
CLOCK_AT_ZERO_S = 50_000_000
"""What a vehicle's clock shows when the trial begins: counters are never small at sea."""

Start = Callable[[int, SealedModem, Fate, float], Program]
"""Vehicle, modem, fate and local time, to a program that has just been started."""
Sail = Callable[[], float | None]
"""Lets all time pass; returns how long after the last fault all was well again, None for never."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What one trial came to; digest is of every frame that any modem was handed."""

    seed: int
    violations: tuple[str, ...]
    fired: dict[Fault, int]
    digest: str
    recovered_s: float | None
    deaths: int


class WatchedLink(SealedLink):
    """A seal that notes, beyond all deaths of the computer, what it has opened."""

    seen: Counter[bytes]

    def open(self, frame: bytes) -> bytes | None:
        """Open, and note it."""
        opened = super().open(frame)
        if opened is not None:
            self.seen[frame] += 1
        return opened


class Rig:
    """The world of one trial; `step` lets a period pass for all in it."""

    def __init__(
        self,
        seed: int,
        plan: Plan,
        water: WaterSettings,
        position_of: Callable[[int, float], Position],
        start: Start,
    ) -> None:
        self.seed, self.plan, self.now_s = seed, plan, 0.0
        self._digest = hashlib.sha256()
        rngs = [np.random.default_rng([seed, k]) for k in range(6)]
        self.medium = FaultyMedium(
            Water(water, rngs[0], position_of), plan, rngs[1], self._note_delivery
        )
        self.links: dict[int, SealedLink] = {}
        self._seen: dict[int, Counter[bytes]] = {vehicle: Counter() for vehicle in VEHICLES}
        self.computers = [self._computer(v, start, rngs[2 + v], rngs[4 + v]) for v in VEHICLES]

    def step(self, now_s: float) -> None:
        """Let all happen that happens until then."""
        self.now_s = now_s
        self.medium.advance(now_s)
        for computer in self.computers:
            computer.step(now_s)

    def outcome(self, sail: Sail, final: Callable[[], list[str]], violations: list[str]) -> Outcome:
        """Sail, and return what came of it; what final and the seals find wrong is added."""
        recovered_s = None
        try:
            recovered_s = sail()
        except Exception:
            violations.append("escaped: " + traceback.format_exc().replace("\n", " | "))
        else:
            violations += [*final(), *self._opened_twice(), *self._used_twice()]
            if recovered_s is None:
                violations.append(f"not well again {RECOVERY_S:g} s after the last fault")
        return Outcome(
            seed=self.seed,
            violations=tuple(violations),
            fired=dict(self.plan.fired),
            digest=self._digest.hexdigest()[:16],
            recovered_s=recovered_s,
            deaths=sum(computer.deaths for computer in self.computers),
        )

    def _opened_twice(self) -> list[str]:
        return [
            f"vehicle {vehicle} opened a frame again that it had opened before"
            for vehicle, seen in self._seen.items()
            if max(seen.values(), default=0) > 1 and not self.plan.kinds(vehicle) & set(_FORGETFUL)
        ]

    def _used_twice(self) -> list[str]:
        if Fault.COUNTER_LOST in self.plan.fired:
            return []  # a lost file begins at the clock's second; the peer refuses what it saw
        wrong = []
        for vehicle, computer in zip(VEHICLES, self.computers, strict=True):
            counters = [_counter(frame) for frame in computer.modem.sent]
            if len(set(counters)) < len(counters):
                wrong.append(f"vehicle {vehicle} used a seal counter twice")
        return wrong

    def _computer(
        self,
        vehicle: int,
        start: Start,
        fate_rng: np.random.Generator,
        modem_rng: np.random.Generator,
    ) -> Computer:
        fate = Fate(vehicle, self.plan, fate_rng)
        files, clock = MemoryFiles(fate), LocalClock(vehicle, self.plan)
        modem = FaultyModem(vehicle, self.medium.modem(vehicle), self.plan, modem_rng, clock)

        def begin(now_s: float) -> Program:
            floor = CLOCK_AT_ZERO_S + int(now_s)
            counter = ReservedCounter(Path("counter"), floor=floor, files=files)
            marks = FileMarks(Path("marks"), files)
            link = WatchedLink(Sealer(KEYS, counter), Opener(vehicle, KEYS, marks))
            link.seen = self._seen[vehicle]
            self.links[vehicle] = link
            return start(vehicle, SealedModem(modem, link), fate, now_s)

        return Computer(fate, files, modem, clock, begin)

    def _note_delivery(self, delivery: Delivery) -> None:
        self._digest.update(repr((delivery.destination, delivery.t_rx_s)).encode())
        self._digest.update(delivery.frame)


def _counter(frame: bytes) -> int:
    try:
        packet = decode(frame)
    except RemoteProtocolError:
        return -1
    return packet.counter if isinstance(packet, SealedFrame) else -1
