"""How much the drift of dead reckoning wanders, as the mission itself tells.

The drift is a random walk, whose step nobody knows beforehand: still water has next to none, a
tidal current turns within the hour. Between epochs minutes apart the drift changes by an amount
that the map and the ranges measure; how large such changes are tells how large to expect them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from firmware.geometry import Array

_REACH = 256.0  # how far from the first belief a walk is looked for, up and down, as a factor
_GRID = 81
_LARGE = 3.0  # sigmas of a change that counts however vague it is
_TOLD = 0.99  # of the expected variance: what leaves more was told nothing


@dataclass(frozen=True, slots=True, kw_only=True)
class Wandering:
    """How dead reckoning errs: noise in m/sqrt(s), and walks of its drift in m/s/sqrt(s).

    `walk` is shared by all vehicles in the water, `apart` each one's own.
    """

    noise: float
    walk: float
    apart: float


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftChange:
    """A change of drift over an interval: what was expected of it, and what was found.

    expected and found are covariances (2, 2) in (m/s)^2, before and after the map and the ranges
    were asked; change_mps (2,) is the estimate.
    """

    interval_s: float
    expected: Array
    change_mps: Array
    found: Array


def reckoned_m2(
    duration_s: float, noise: float, walk: float, *, start_m: float = 0.0, drift_mps: float = 0.0
) -> float:
    """Return the variance, each axis, of dead reckoning that nothing corrects for a time.

    start_m and drift_mps are the sigmas of position and drift when it began.
    """
    drifted = (noise**2 + drift_mps**2 * duration_s) * duration_s
    return start_m**2 + drifted + walk**2 * duration_s**3 / 3


@dataclass(frozen=True, slots=True, kw_only=True)
class MeanDrift:
    """What the mean drift over a time says of dead reckoning within it, each axis.

    variance_m2ps2 is that of the mean drift; a drift leads dead reckoning astray by gain_s
    times itself within the span, give or take left_m2.
    """

    variance_m2ps2: float
    gain_s: float
    left_m2: float


def mean_drift(
    span_s: tuple[float, float], duration_s: float, wandering: Wandering, drift_mps: float
) -> MeanDrift:
    """Return what the mean drift of a time, counted from zero, says of a span (begin, end) in it.

    drift_mps is the sigma of drift when it began, from where it walks.
    """
    begin_s, end_s = span_s
    length_s = end_s - begin_s
    noise_m2ps, walk, drift = wandering.noise**2, wandering.walk**2, drift_mps**2
    both_s3 = duration_s * (end_s**2 - begin_s**2) / 2 - (end_s**3 - begin_s**3) / 6
    whole_m2 = reckoned_m2(duration_s, wandering.noise, wandering.walk, drift_mps=drift_mps)
    both_m2 = drift * length_s * duration_s + walk * both_s3 + noise_m2ps * length_s
    span_m2 = drift * length_s**2 + walk * length_s**2 * (begin_s + length_s / 3)
    span_m2 += noise_m2ps * length_s
    return MeanDrift(
        variance_m2ps2=whole_m2 / duration_s**2,
        gain_s=both_m2 * duration_s / whole_m2,
        left_m2=max(span_m2 - both_m2**2 / whole_m2, 0.0),
    )


def bridged_m2(duration_s: float, noise: float, walk: float) -> float:
    """Return the variance, each axis, of dead reckoning between two times whose drift is given.

    Their mean is the drift of a random walk between them, give or take walk^2 / 12 times duration.
    """
    return (noise**2 + walk**2 * duration_s**2 / 12) * duration_s


def changes_of(times_s: Array, bias_mps: Array, expected: Array, found: Array) -> list[DriftChange]:
    """Return the changes between successive epochs (K,) of a drift (K, 2).

    expected and found are the joint covariances (2K, 2K) before and after measurements.
    """
    changes = []
    for k in range(1, len(times_s)):
        difference = np.zeros((2, 2 * len(times_s)))
        difference[:, 2 * k : 2 * k + 2] = np.eye(2)
        difference[:, 2 * k - 2 : 2 * k] = -np.eye(2)
        changes.append(
            DriftChange(
                interval_s=float(times_s[k] - times_s[k - 1]),
                expected=difference @ expected @ difference.T,
                change_mps=bias_mps[k] - bias_mps[k - 1],
                found=difference @ found @ difference.T,
            )
        )
    return changes


def expected_walk(changes: Sequence[DriftChange]) -> float:
    """Return the walk in m/s/sqrt(s) that an estimate expected, whatever it was told.

    Vehicles whose drift is tied each bring an expectation of their own: together they expect less.
    """
    rates = [np.trace(change.expected) / (2.0 * change.interval_s) for change in changes]
    return float(np.sqrt(np.mean(rates)))


def likely_walk(changes: Sequence[DriftChange], believed: float, factor: float) -> float:
    """Return the walk in m/s/sqrt(s) that an estimate's changes of drift speak for.

    What the estimate expected is taken out of what it found; what is left was measured. Successive
    changes are taken for independent, which neighbours are not quite: many that were measured more
    vaguely than the believed walk makes them would argue for still water, and do not count unless
    they are large. The walk's prior is log-normal: the factor is its one-sigma spread, the believed
    walk its root mean square. The answer is the root mean square of the posterior, so that little
    evidence leaves more room for drift rather than less.
    """
    walks = believed * np.geomspace(1 / _REACH, _REACH, _GRID)
    spread = np.log(factor)
    log_likely = -0.5 * (np.log(walks / believed) / spread + spread) ** 2
    for change in changes:
        expected = np.trace(change.expected) / 2.0
        variances, axes = np.linalg.eigh(change.found)
        seen = variances < _TOLD * expected
        told_share = 1.0 - variances[seen] / expected
        measured = (change.change_mps @ axes)[seen] / told_share
        noise = variances[seen] / told_share
        clear = (noise < believed**2 * change.interval_s) | (measured**2 > _LARGE**2 * noise)
        total = walks[:, None] ** 2 * change.interval_s + noise[clear]
        log_likely -= 0.5 * np.sum(np.log(total) + measured[clear] ** 2 / total, axis=1)
    weights = np.exp(log_likely - log_likely.max())
    return float(np.sqrt(np.average(walks**2, weights=weights)))
