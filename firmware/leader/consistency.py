"""Which closures agree with each other: pairwise consistency and its largest clique.

Two closures a -> b and c -> d and the dead reckoning b -> d and a -> c make a loop. Where the loop
does not close within its covariance, at least one of the two is false. False closures seldom agree
with one another, so the largest set that agrees pairwise is believed.

Source: Mangelson et al., Pairwise consistent measurement set maximization, ICRA 2018; a greedy
clique in bounded windows stands for the exact one.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware.geometry import Array
from protocol.settings import Settings, setting

Keys = NDArray[np.int64]
RelativeOdometry = Callable[[Keys, Keys], tuple[Array, Array]]
"""Positions of the second nodes minus those of the first by odometry alone, (P, 2), and their
covariances (P, 2, 2); NaN where no odometry connects the two."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConsistencySettings(Settings):
    """When two closures agree, and how many are looked at together."""

    chi_square_limit: float = setting(
        9.21, "", "99 % of true pairs close their loop, two degrees of freedom", minimum=0.0
    )
    window: int = setting(
        200, "closures", "a clique among them takes a tenth of a second", minimum=2, maximum=2000
    )
    seeds: int = setting(
        16, "", "cliques grown from the best connected closures", minimum=1, maximum=200
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class CandidateClosure:
    """A closure as measured: position of `target` minus position of `origin` (2,).

    Both are nodes as the odometry numbers them; the covariance is (2, 2).
    """

    origin: int
    target: int
    offset_m: Array
    covariance_m2: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Consistency:
    """The verdict on each closure, in the order given.

    believed (K,) is membership of the largest consistent set; partners (K,) the number of others
    in that set whose loop with it could be tested and closes, and that saw something else.
    """

    believed: NDArray[np.bool_]
    partners: NDArray[np.int64]


def consistent_set(
    closures: Sequence[CandidateClosure],
    odometry: RelativeOdometry,
    settings: ConsistencySettings,
    alike: NDArray[np.bool_],
) -> Consistency:
    """Return which closures belong to the largest pairwise consistent set of their window.

    Windows overlap by half; a closure is believed when one of its windows believes it. alike (K, K)
    are pairs that rest on the same soundings: one error makes both, and they are no partners.
    """
    count = len(closures)
    believed = np.zeros(count, dtype=bool)
    partners = np.zeros(count, dtype=np.int64)
    step = max(settings.window // 2, 1)
    for start in range(0, max(count - step, 1), step):
        window = np.arange(start, min(start + settings.window, count))
        if not window.size:
            break
        agree, known = agreement([closures[int(i)] for i in window], odometry, settings)
        members = largest_clique(agree, settings.seeds)
        chosen = np.zeros(window.size, dtype=bool)
        chosen[members] = True
        vouches = agree & known & ~alike[np.ix_(window, window)]
        support = vouches[:, chosen].sum(axis=1)
        partners[window] = np.maximum(partners[window], support)
        believed[window] |= chosen
    return Consistency(believed=believed, partners=partners)


def agreement(
    closures: Sequence[CandidateClosure],
    odometry: RelativeOdometry,
    settings: ConsistencySettings,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return (K, K) which pairs do not contradict each other, and which could be tested.

    A pair is tested both as it stands and with one closure turned round; of the loops that odometry
    connects, the one with the smaller covariance counts. Untested pairs do not contradict.
    """
    count = len(closures)
    origin = np.array([c.origin for c in closures], dtype=np.int64)
    target = np.array([c.target for c in closures], dtype=np.int64)
    offset = np.array([c.offset_m for c in closures]).reshape(count, 2)
    covariance = np.array([c.covariance_m2 for c in closures]).reshape(count, 2, 2)
    i, j = np.triu_indices(count, 1)
    both_m2 = covariance[i] + covariance[j]
    square = np.full(i.size, np.nan)
    least = np.full(i.size, np.inf)
    for first, second, sign in ((origin[j], target[j], 1.0), (target[j], origin[j], -1.0)):
        head_m, head_m2 = odometry(target[i], second)
        tail_m, tail_m2 = odometry(origin[i], first)
        gap = offset[i] + head_m - sign * offset[j] - tail_m
        spread = both_m2 + head_m2 + tail_m2
        size = np.trace(spread, axis1=1, axis2=2)
        usable = np.isfinite(gap).all(axis=1) & np.isfinite(size) & (size < least)
        solved = np.linalg.solve(spread[usable], gap[usable][:, :, None])[:, :, 0]
        square[usable] = np.einsum("pi,pi->p", gap[usable], solved)
        least[usable] = size[usable]
    known = np.zeros((count, count), dtype=bool)
    known[i, j] = known[j, i] = np.isfinite(square)
    agree = np.ones((count, count), dtype=bool)
    agree[i, j] = agree[j, i] = ~(square > settings.chi_square_limit)
    np.fill_diagonal(agree, val=False)
    return agree, known


def largest_clique(agree: NDArray[np.bool_], seeds: int) -> NDArray[np.intp]:
    """Return members of a large clique, ascending, grown greedily from the best connected.

    Each step takes the candidate that leaves most candidates; the largest of the cliques so grown
    is returned, the first of equals.
    """
    order = np.argsort(-agree.sum(axis=1), kind="stable")
    best: list[int] = []
    for seed in order[:seeds]:
        members = [int(seed)]
        candidates = np.flatnonzero(agree[seed])
        while candidates.size:
            left = agree[np.ix_(candidates, candidates)]
            taken = int(np.argmax(left.sum(axis=1)))
            members.append(int(candidates[taken]))
            candidates = candidates[left[taken]]
        if len(members) > len(best):
            best = members
    return np.sort(np.array(best, dtype=np.intp))
