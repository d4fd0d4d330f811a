"""c and sigma^2 such that the leader's variance (Eq. 6) is that of soundings about its map."""

from dataclasses import replace

import numpy as np
from scipy.special import erf

from firmware.compression.decoder import point_decoder
from firmware.compression.kernels import Hyperparameters
from firmware.geometry import Array
from firmware.submaps import BinnedSoundings

_MOST_ROWS = 4096  # residuals looked at: a hundred would do for two numbers
_ROW_WORK = 4096 * 150**2  # rows x points^2: 4 ms
_TAIL = 30.0  # times the median: four sigma of a Gaussian
_GROUPS = 8  # of cells by density, nadir to outer beams
_SMALLEST_M2 = 1e-6


def calibrated(
    points_ned_m: Array, hyper: Hyperparameters, bins: BinnedSoundings
) -> tuple[Hyperparameters, float]:
    """Return hyperparameters with c and sigma^2 refitted, and the map's RMSE on the bins in m.

    A sounding in a cell deviates from the map by the cell's spread and by the map's error there:
    E[e^2] = c v + sigma^2, with v the posterior variance for c = 1. Both are found by weighted
    least squares, weights 1 / E^2, neither below zero.
    """
    rows = max(512, min(_MOST_ROWS, _ROW_WORK // max(len(points_ned_m), 1) ** 2))
    every = max(1, -(-bins.depth_m.size // rows))
    unit = replace(hyper, c_m2=1.0, sigma2_m2=0.0, noise_applied=False)
    decoder = point_decoder(points_ned_m, unit)
    position_m = np.column_stack([bins.north_m, bins.east_m])[::every]
    depth_m, posterior = decoder.predict(position_m)
    count = bins.count[::every]
    spread = bins.variance_m2[::every] * np.maximum(count - 1.0, 0.0)
    residual_m = bins.depth_m[::every] - depth_m
    every_squared = spread + residual_m**2
    squared = without_tail(every_squared)
    c, sigma2 = _fitted(posterior, squared, count)
    told = c * posterior + sigma2
    wider = max(widening(squared / told, count), heaviness(every_squared / told))
    refitted = replace(hyper, c_m2=wider * c, sigma2_m2=wider * sigma2)
    return refitted, float(np.sqrt(np.mean(residual_m**2)))


def _fitted(posterior: Array, squared: Array, count: Array) -> tuple[float, float]:
    mean = max(float(np.average(squared, weights=count)), _SMALLEST_M2)
    c, sigma2 = mean, mean
    for _ in range(4):
        weight = count / (c * posterior + sigma2) ** 2
        design = np.column_stack([posterior, np.ones_like(posterior)])
        normal = design.T @ (design * weight[:, None])
        right = design.T @ (squared * weight)
        c, sigma2 = np.linalg.solve(normal + 1e-12 * np.trace(normal) * np.eye(2), right)
        if c <= 0.0:
            c, sigma2 = _SMALLEST_M2, mean
        elif sigma2 <= 0.0:
            c, sigma2 = right[0] / max(normal[0, 0], 1e-300), _SMALLEST_M2
    return max(float(c), _SMALLEST_M2), max(float(sigma2), _SMALLEST_M2)


def without_tail(squared: Array) -> Array:
    """Return squared residuals, the few wild ones held at a value that none would have by chance.

    A cliff under one line of cells says nothing of the map elsewhere, and the packet has but one
    sigma^2 for all of it.
    """
    out: Array = np.minimum(squared, _TAIL * max(float(np.median(squared)), _SMALLEST_M2))
    return out


def heaviness(ratio: Array) -> float:
    """Return the factor on the variance that 95 % of the cells ask for, whatever their tail.

    More than a few wild cells are no accident of one place, and the map has to admit them.
    """
    return float(np.quantile(ratio, 0.95)) / 1.96**2


def widening(ratio: Array, count: Array) -> float:
    """Return the factor on the variance that puts 95 % of soundings into its 95 % interval.

    Noise differs between nadir and the outer beams, and a mixture has heavier tails than the
    Gaussian of its mean variance. Cells are grouped by how densely they were sounded, which tells
    the beams apart; each group is Gaussian with its own variance.
    """
    order = np.argsort(count, kind="stable")
    groups = [part for part in np.array_split(order, _GROUPS) if part.size]
    share = np.array([count[part].sum() for part in groups]) / count.sum()
    variance = np.array([np.average(ratio[part], weights=count[part]) for part in groups])
    variance = np.maximum(variance, 1e-6)
    low, high = 0.25, 4.0
    for _ in range(30):
        middle = 0.5 * (low + high)
        inside = float(share @ erf(1.96 * np.sqrt(0.5 * middle / variance)))
        low, high = (middle, high) if inside < 0.95 else (low, middle)
    return 0.5 * (low + high)
