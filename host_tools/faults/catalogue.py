"""What can go wrong, and when it does in one trial: a function of the trial's seed."""

import enum
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

VEHICLES = (0, 1)
SHORTEST_S, LONGEST_S = 5.0, 60.0
"""How long one fault lasts."""
MOST_BESIDE = 3
"""Faults drawn beside the seed's own, so that kinds also meet each other."""
_STREAM = 0xFA017


class Fault(enum.Enum):
    """A kind of fault; the value says what happens."""

    BURST_LOSS = "most frames to a vehicle are lost, 50 to 90 %"
    OUTAGE = "no frame reaches a vehicle"
    DUPLICATED = "frames arrive twice"
    REORDERED = "frames are overtaken by the next"
    LATE = "frames arrive half a minute to two minutes late"
    BITS_FLIPPED = "bits of frames are turned"
    TRUNCATED = "frames lose their end"
    SPLICED = "a frame goes on as another one"
    ARRIVAL_WILD = "a modem tells absurd times of arrival"
    ARRIVAL_UNVOUCHED = "a modem tells no time of arrival"
    FORGED = "frames with a right CRC and a wrong tag"
    REPLAYED = "recorded frames are played again"
    REFLECTED = "a vehicle hears what it sent itself"
    STRANGER = "another fleet uses our numbers: unsealed, or with its own key"
    SAME_NUMBER = "a stranger's frames bear the number of the vehicle that hears them"
    OTHER_VERSION = "the peer speaks another version of the wire"
    LINE_NOISE = "garbage between and within the frames of the modem's line"
    MODEM_RESET = "a modem restarts: what it holds is gone, its port is away"
    MODEM_BUSY = "a modem keeps frames back, and sends them later"
    CLOCK_AHEAD = "a vehicle's clock is up to two minutes ahead, then right again"
    CLOCK_BEHIND = "a vehicle's clock is up to two minutes behind, then right again"
    KILLED = "a computer dies at any event, and restarts"
    DISK_FULL = "a disk takes nothing"
    TORN_WRITE = "a computer dies within a write, of which a part is on disk"
    STORE_CORRUPT = "a computer dies, and bytes of its store are other ones"
    STORE_READ_ONLY = "a computer dies, and may not write its store any more"
    COUNTER_LOST = "a computer dies, and its files of seal counters are gone"


AIR = tuple(Fault)[:16]
"""What the water and those in it do."""
DEADLY = (
    Fault.KILLED,
    Fault.TORN_WRITE,
    Fault.STORE_CORRUPT,
    Fault.STORE_READ_ONLY,
    Fault.COUNTER_LOST,
)
"""What begins with the death of a computer."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Strike:
    """One fault of one vehicle (of the air: at its receiver), from one time until another.

    share, from 0 to 1, is how hard it is, as far as its kind has a measure.
    """

    fault: Fault
    vehicle: int
    from_s: float
    until_s: float
    share: float


class Plan:
    """The strikes of a trial, and how often each kind did something."""

    def __init__(self, strikes: Sequence[Strike]) -> None:
        self.strikes = tuple(strikes)
        self.fired: Counter[Fault] = Counter()
        self._of: defaultdict[tuple[Fault, int], list[Strike]] = defaultdict(list)
        for strike in self.strikes:
            self._of[strike.fault, strike.vehicle].append(strike)

    @property
    def last_s(self) -> float:
        """When the last fault ends."""
        return max((strike.until_s for strike in self.strikes), default=0.0)

    def kinds(self, vehicle: int) -> set[Fault]:
        """Return what ever strikes a vehicle."""
        return {fault for fault, struck in self._of if struck == vehicle}

    def active(self, fault: Fault, vehicle: int, now_s: float) -> Strike | None:
        """Return the strike that is on, or None."""
        for strike in self._of.get((fault, vehicle), ()):
            if strike.from_s <= now_s < strike.until_s:
                return strike
        return None


def plan_of(seed: int, from_s: float, span_s: float) -> Plan:
    """Return the plan of a seed: the seeds take the kinds in turn, and others come beside."""
    rng = np.random.default_rng([seed, _STREAM])
    kinds = list(Fault)
    beside = rng.choice(len(kinds), int(rng.integers(0, MOST_BESIDE + 1)), replace=False)
    faults = [kinds[seed % len(kinds)], *(kinds[k] for k in beside)]
    return Plan([_strike(fault, rng, from_s, span_s) for fault in faults])


def _strike(fault: Fault, rng: np.random.Generator, from_s: float, span_s: float) -> Strike:
    begins_s = from_s + float(np.floor(rng.random() * span_s))
    lasts_s = float(np.ceil(rng.uniform(SHORTEST_S, LONGEST_S)))
    lasts_s += LONGEST_S * (fault is Fault.STORE_READ_ONLY)  # the computer is down at first
    return Strike(
        fault=fault,
        vehicle=int(rng.choice(VEHICLES)),
        from_s=begins_s,
        until_s=begins_s + lasts_s,
        share=float(rng.random()),
    )
