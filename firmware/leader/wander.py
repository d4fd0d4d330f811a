"""How much the drift of dead reckoning wanders, as the mission itself tells.

The drift is a random walk, whose step nobody knows beforehand: still water has next to none, a
tidal current turns within the hour. Between epochs minutes apart the drift changes by an amount
that the map and the ranges measure; how large such changes are tells how large to expect them.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from firmware.geometry import Array

_REACH = 16.0  # how far from the first belief a walk is looked for, up and down, as a factor
_GRID = 41


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftChange:
    """A change of drift: its interval, its estimate (2,) in m/s and the covariance (2, 2) of it."""

    interval_s: float
    change_mps: Array
    covariance: Array


def changes_of(times_s: Array, bias_mps: Array, covariance: Array) -> list[DriftChange]:
    """Return the changes between successive epochs (K,) of a drift (K, 2), (2K, 2K)."""
    changes = []
    for k in range(1, len(times_s)):
        difference = np.zeros((2, 2 * len(times_s)))
        difference[:, 2 * k : 2 * k + 2] = np.eye(2)
        difference[:, 2 * k - 2 : 2 * k] = -np.eye(2)
        changes.append(
            DriftChange(
                interval_s=float(times_s[k] - times_s[k - 1]),
                change_mps=bias_mps[k] - bias_mps[k - 1],
                covariance=difference @ covariance @ difference.T,
            )
        )
    return changes


def likely_walk(
    changes: Iterable[DriftChange], assumed: float, believed: float, factor: float
) -> float:
    """Return the walk in m/s/sqrt(s) that an estimate's changes of drift speak for.

    The estimate assumed one walk: what its changes and their covariances hold of it is taken out
    again. Before any evidence the walk is log-normal, may well be wrong by the factor, and has the
    believed one as the root of its mean square. So has the answer, over what remains likely: little
    evidence leaves more room for drift rather than less.
    """
    walks = believed * np.geomspace(1 / _REACH, _REACH, _GRID)
    spread = np.log(factor)
    log_likely = -0.5 * (np.log(walks / believed) / spread + spread) ** 2
    for change in changes:
        assumed_variance = assumed**2 * change.interval_s
        variances, axes = np.linalg.eigh(change.covariance)
        seen = variances < 0.999 * assumed_variance
        kept_share = 1.0 - variances[seen] / assumed_variance
        measured = (change.change_mps @ axes)[seen] / kept_share
        noise = variances[seen] / kept_share
        total = walks[:, None] ** 2 * change.interval_s + noise
        log_likely -= 0.5 * np.sum(np.log(total) + measured**2 / total, axis=1)
    weights = np.exp(log_likely - log_likely.max())
    return float(np.sqrt(np.average(walks**2, weights=weights)))
