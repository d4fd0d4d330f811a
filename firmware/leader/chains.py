"""The nodes of one vehicle in the pose graph, and what ties those of two vehicles in one water."""

import bisect
from dataclasses import dataclass, field

import numpy as np

from firmware.geometry import Array
from firmware.leader.ledger import SharedWalkRecord


@dataclass(slots=True)
class Chain:
    """The nodes of one vehicle, in time order, and the key of its parameters."""

    number: int
    parameters: int
    times_s: list[float] = field(default_factory=list)
    reckoned_m: list[Array] = field(default_factory=list)
    keys: list[int] = field(default_factory=list)

    def key_at(self, time_s: float) -> int | None:
        """Return the key of the node at exactly this time, or None."""
        at = bisect.bisect_left(self.times_s, time_s)
        return self.keys[at] if at < len(self.times_s) and self.times_s[at] == time_s else None


def shared_walk(
    first: Chain, chain: Chain, interval_s: float, bias_walk_apart: float
) -> list[SharedWalkRecord]:
    """Return that a chain's bias has changed over an interval as the first chain's has.

    It ends at the chain's newest node; nothing is said when one of the four nodes is not there.
    """
    end_s = chain.times_s[-1]
    if chain is first or end_s % interval_s:
        return []
    origins = first.key_at(end_s - interval_s), chain.key_at(end_s - interval_s)
    targets = first.key_at(end_s), chain.key_at(end_s)
    if origins[0] is None or origins[1] is None or targets[0] is None or targets[1] is None:
        return []
    sigma_mps = bias_walk_apart * float(np.sqrt(interval_s))
    return [
        SharedWalkRecord(
            origins=(origins[0], origins[1]), targets=(targets[0], targets[1]), sigma_mps=sigma_mps
        )
    ]
