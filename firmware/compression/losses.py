"""How many frames may be lost, which, and how likely."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import NDArray

from firmware.geometry import Array

_RARELY = 0.02  # how often fewer frames may arrive than are relied on


def arrival_chances(frames: int, loss: float) -> list[float]:
    """Return how likely 0, 1 ... all of the frames arrive, each lost with the same probability."""
    return [comb(frames, r) * (1.0 - loss) ** r * loss ** (frames - r) for r in range(frames + 1)]


def frames_relied_on(frames: int, loss: float) -> int:
    """Return how many of the frames nearly always arrive, at least half of them."""
    half, chance = (frames + 1) // 2, arrival_chances(frames, loss)
    return max([k for k in range(half, frames + 1) if sum(chance[:k]) <= _RARELY] or [half])


@dataclass(frozen=True, slots=True, kw_only=True)
class LossPatterns:
    """Sets of lost fragments with probabilities; together with no loss they sum to one."""

    no_loss: float
    lost: tuple[tuple[int, ...], ...]
    probability: Array  # (P,)

    def lost_points(self, fragment: NDArray[np.intp]) -> list[NDArray[np.intp]]:
        """Return the points lost under each pattern, for points dealt to fragments (M,)."""
        return [np.flatnonzero(np.isin(fragment, lost)) for lost in self.lost]


def loss_patterns(loss: float, fragments: int) -> LossPatterns:
    """Return all single and double losses and an even design of triple ones, by their weight.

    Losses are independent with the given probability. More than three are counted as three; the
    last weight takes all that is left, so that the expectation is a true mean.
    """
    if loss <= 0.0 or fragments < 4:
        return LossPatterns(no_loss=1.0, lost=(), probability=np.empty(0))
    singles = [(i,) for i in range(fragments)]
    doubles = [(i, j) for i in range(fragments) for j in range(i)]
    triples = [(i, (i + 1) % fragments, (i + 3) % fragments) for i in range(fragments)]
    none, one, two = (
        comb(fragments, lost) * loss**lost * (1.0 - loss) ** (fragments - lost) for lost in range(3)
    )
    more = max(1.0 - none - one - two, 0.0)
    groups: list[tuple[float, Sequence[tuple[int, ...]]]] = [
        (one, singles),
        (two, doubles),
        (more, triples),
    ]
    return LossPatterns(
        no_loss=none,
        lost=tuple(pattern for _, group in groups for pattern in group),
        probability=np.concatenate([np.full(len(group), p / len(group)) for p, group in groups]),
    )
