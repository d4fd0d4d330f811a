"""Sub-cell optimum of one candidate shift and an honest covariance.

The difference of two aligned sub-maps is d = r(x + s) - q(x) - B beta. Besides the shift s the fit
carries nuisances with Gaussian priors: depth offset, tilt and bend between the passes (tide,
roll bias, refraction smile) and what is left of each sub-map's drift. They are solved together, so
that their uncertainty reaches the covariance of the shift.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import fft, ndimage

from firmware.geometry import Array
from firmware.leader.screening import Layer, landing
from firmware.leader.warping import bilinear

_ITERATIONS = 8  # Gauss-Newton from the lattice's best cell settles in three to five
_SETTLED_M = 0.005
_LONGEST_STEP_M = 3.0  # gradients are not believed further than their smoothing
_LEAST_CELLS = 12  # fewer cells than unknowns determine nothing


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseModel:
    """Standard deviations that the fit assumes; all may be zero but cell_sigma_m."""

    cell_sigma_m: float
    position_sigma_m: float
    offset_sigma_m: float
    tilt_sigma: float
    bend_sigma_per_m: float
    drift_sigma_mps: float
    walk_m2_per_s: float
    correlation_m: float
    correlated_share: float


class Slopes(NamedTuple):
    """Smoothed depth gradients of a grid to north and east, metres per metre, (R, C)."""

    north: Array
    east: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Refined:
    """The optimum near one candidate.

    covariance_m2 (2, 2) is of the shift between the two reference times, inf along a direction
    that the overlap says nothing about. variance_m2 is the predicted mean variance of a cell's
    difference; misfit the mean of squared normalised residuals (1 when the noise model holds).
    """

    shift_m: Array
    covariance_m2: Array
    depth_offset_m: float
    variance_m2: float
    misfit: float
    overlap_cells: int
    reference_time_s: float
    query_time_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _Aligned:
    """Fields of the overlap at one shift, (R, C) on the query's lattice, zero outside."""

    both: Array
    difference_m: Array
    weight: Array
    variance_m2: Array
    slope_r: Array  # (2, R, C)
    slope_q: Array  # (2, R, C)
    age_r_s: Array
    age_q_s: Array
    basis: Array  # (n, R, C) offset, tilt, bend


def slopes(layer: Layer, smoothing_cells: float) -> Slopes:
    """Return gradients of the grid smoothed over the known cells, NaN where unknown."""
    depth = np.where(layer.known > 0, layer.grid.depth_m, 0.0)
    share = ndimage.gaussian_filter(layer.known, smoothing_cells, mode="constant")
    smooth = ndimage.gaussian_filter(depth, smoothing_cells, mode="constant")
    smooth = np.where(share > 0.3, smooth / np.maximum(share, 0.3), np.nan)
    gradient = np.gradient(smooth, layer.grid.cell_m)
    return Slopes(*(np.where(layer.known > 0, g, np.nan) for g in gradient))


def refine(
    reference: Layer,
    query: Layer,
    slopes_rq: tuple[Slopes, Slopes],
    start_m: Array,
    times_s: tuple[float | None, float | None],
    noise: NoiseModel,
) -> Refined | None:
    """Return the optimum near `start_m`, or None where the fit leaves the overlap or diverges.

    times_s are the instants of the reference and the query to which the shift refers; None means
    the mean time of the overlap, where the fit is best determined.
    """
    shift = np.array(start_m, dtype=np.float64)
    for _ in range(_ITERATIONS):
        field = _align(reference, query, slopes_rq, shift, times_s, noise)
        if field is None:
            return None
        unknowns = _solve(field, *_columns(field, noise))
        step = -unknowns[:2]
        length = float(np.hypot(*step))
        if not np.isfinite(length):
            return None
        shift = shift + step * min(1.0, _LONGEST_STEP_M / max(length, 1e-12))
        if length < _SETTLED_M:
            break
    if np.hypot(*(shift - start_m)) > 4.0 * reference.grid.cell_m + _LONGEST_STEP_M:
        return None
    field = _align(reference, query, slopes_rq, shift, times_s, noise)
    if field is None:
        return None
    return _result(reference, query, field, shift, times_s, noise)


def _align(
    reference: Layer,
    query: Layer,
    slopes_rq: tuple[Slopes, Slopes],
    shift_m: Array,
    times_s: tuple[float | None, float | None],
    noise: NoiseModel,
) -> _Aligned | None:
    """Return the fields of the overlap at a shift, None when too few cells overlap."""
    rows, cols = landing(reference.grid, query.grid, shift_m)
    box = _overlap_box(rows, cols, reference.known.shape)
    if box is None:
        return None
    row, col = rows[box], cols[box]
    difference = bilinear(reference.grid.depth_m, row, col) - query.grid.depth_m[box]
    slope_r = np.stack([bilinear(s, row, col) for s in slopes_rq[0]])
    slope_q = np.stack([s[box] for s in slopes_rq[1]])
    both = np.isfinite(difference) & np.isfinite(slope_r[0]) & np.isfinite(slope_q[0])
    if both.sum() < _LEAST_CELLS:
        return None
    clean = np.where(both, 1.0, 0.0)
    slope_r, slope_q = np.where(both, slope_r, 0.0), np.where(both, slope_q, 0.0)
    mean_slope2 = 0.25 * np.sum((slope_r + slope_q) ** 2, axis=0)
    variance = (
        np.nan_to_num(bilinear(reference.grid.variance_m2, row, col))
        + np.nan_to_num(query.grid.variance_m2[box])
        + noise.cell_sigma_m**2
        + noise.position_sigma_m**2 * mean_slope2
    )
    age_r = _age(bilinear(reference.grid.time_s, row, col), both, times_s[0])
    age_q = _age(query.grid.time_s[box], both, times_s[1])
    return _Aligned(
        both=clean,
        difference_m=np.where(both, difference, 0.0),
        weight=clean / variance,
        variance_m2=variance,
        slope_r=slope_r,
        slope_q=slope_q,
        age_r_s=age_r,
        age_q_s=age_q,
        basis=_polynomials(clean, query.grid.cell_m),
    )


def _overlap_box(rows: Array, cols: Array, shape: tuple[int, ...]) -> tuple[slice, slice] | None:
    """Return the query's rectangle that can lie on the reference."""
    i = np.flatnonzero((rows[:, 0] >= 0) & (rows[:, 0] <= shape[0] - 1))
    j = np.flatnonzero((cols[0] >= 0) & (cols[0] <= shape[1] - 1))
    if not i.size or not j.size:
        return None
    return slice(i[0], i[-1] + 1), slice(j[0], j[-1] + 1)


def _age(time_s: Array, both: Array, origin_s: float | None) -> Array:
    """Return time since the origin (default: the overlap's mean time), zero outside."""
    known = both & np.isfinite(time_s)
    if not known.any():
        return np.zeros(both.shape)
    start = float(time_s[known].mean()) if origin_s is None else origin_s
    return np.where(known, time_s - start, 0.0)


def _polynomials(both: Array, cell_m: float) -> Array:
    """Return 1, n, e, n^2, n e, e^2 over the overlap, centred, in metres; (6, R, C)."""
    rows, cols = both.shape
    total = both.sum()
    n = np.arange(rows) * cell_m
    e = np.arange(cols) * cell_m
    n = (n - both.sum(axis=1) @ n / total)[:, None] * both
    e = (e - both.sum(axis=0) @ e / total)[None, :] * both
    return np.asarray(np.stack([both, n, e, n * n, n * e, e * e]), dtype=np.float64)


def _columns(field: _Aligned, noise: NoiseModel) -> tuple[Array, Array]:
    """Return the design (p, R, C) and the prior information (p,) of its unknowns.

    The unknowns are the shift, which has no prior, then those of offset, drift of reference and
    query, tilt and bend whose sigma is not zero, in this order.
    """
    slope = 0.5 * (field.slope_r + field.slope_q)
    groups = [
        (field.basis[:1], noise.offset_sigma_m),
        (-slope * field.age_r_s, noise.drift_sigma_mps),
        (slope * field.age_q_s, noise.drift_sigma_mps),
        (field.basis[1:3], noise.tilt_sigma),
        (field.basis[3:], noise.bend_sigma_per_m),
    ]
    active = [(columns, sigma) for columns, sigma in groups if sigma > 0.0]
    prior = [0.0, 0.0] + [1.0 / sigma**2 for columns, sigma in active for _ in columns]
    return np.concatenate([slope, *(columns for columns, _ in active)]), np.array(prior)


def _solve(field: _Aligned, columns: Array, prior: Array) -> Array:
    """Return the unknowns (p,) that explain the difference."""
    design = columns.reshape(columns.shape[0], -1)
    weighted = design * field.weight.ravel()
    information = weighted @ design.T + np.diag(prior)
    information[:2, :2] += np.eye(2) * 1e-9
    return np.linalg.solve(information, weighted @ field.difference_m.ravel())


def _result(
    reference: Layer,
    query: Layer,
    field: _Aligned,
    shift_m: Array,
    times_s: tuple[float | None, float | None],
    noise: NoiseModel,
) -> Refined:
    """Return the fit at its optimum with the sandwich covariance."""
    columns, prior = _columns(field, noise)
    unknowns = _solve(field, columns, prior)
    residual = field.both * (field.difference_m - np.tensordot(unknowns, columns, axes=1))
    cells = field.both.sum()
    misfit = float(np.sum(field.weight * residual**2) / cells)
    score = _score_covariance(field, columns, residual, max(misfit, 1.0), query.grid.cell_m, noise)
    covariance = _sandwich(field, columns, prior, score)
    row, col = landing(reference.grid, query.grid, shift_m)
    time_r, time_q = bilinear(reference.grid.time_s, row, col), query.grid.time_s
    both = np.isfinite(time_r) & np.isfinite(time_q)
    times = [
        (float(t[both].mean()), float(np.ptp(t[both]))) if both.any() else (0.0, 0.0)
        for t in (time_r, time_q)
    ]
    for (mean_s, span_s), origin_s in zip(times, times_s, strict=True):
        away_s = 0.0 if origin_s is None else abs(mean_s - origin_s)
        covariance = covariance + np.eye(2) * noise.walk_m2_per_s * (away_s + span_s / 12.0)
    return Refined(
        shift_m=shift_m,
        covariance_m2=covariance,
        depth_offset_m=float(unknowns[2]) if noise.offset_sigma_m > 0.0 else 0.0,
        variance_m2=float(np.sum(field.variance_m2 * field.both) / cells),
        misfit=misfit,
        overlap_cells=int(cells),
        reference_time_s=times[0][0] if times_s[0] is None else times_s[0],
        query_time_s=times[1][0] if times_s[1] is None else times_s[1],
    )


def _sandwich(field: _Aligned, columns: Array, prior: Array, score: Array) -> Array:
    """Return H^-1 (B + P) H^-1 of the shift, (2, 2).

    H is the curvature; its shift block multiplies the slopes of one grid with those of the other,
    whose noises are independent, so that noise alone makes no information. B is the covariance of
    the score under residuals correlated as they are seen to be, and at least as the model says.
    """
    p = columns.shape[0]
    design = columns.reshape(p, -1)
    weight = field.weight.ravel()
    curvature = (design * weight) @ design.T
    cross = (field.slope_r.reshape(2, -1) * weight) @ field.slope_q.reshape(2, -1).T
    raw = curvature[:2, :2].copy()
    curvature[:2, :2] = 0.5 * (cross + cross.T)
    values, vectors = np.linalg.eigh(curvature[:2, :2])
    usable = values > 0.25 * np.einsum("ia,ij,ja->a", vectors, raw, vectors)
    rotated = np.eye(p)
    rotated[:2, :2] = vectors.T
    keep = np.concatenate([usable, np.ones(p - 2, dtype=bool)])
    h = (rotated @ (curvature + np.diag(prior)) @ rotated.T)[np.ix_(keep, keep)]
    b = (rotated @ (score + np.diag(prior)) @ rotated.T)[np.ix_(keep, keep)]
    inverse = np.linalg.inv(h)
    covariance = inverse @ b @ inverse.T
    known = int(usable.sum())
    local = np.full(2, 1e6)  # a kilometre: nothing is known in that direction
    spread = np.diag(local)
    spread[np.ix_(usable, usable)] = covariance[:known, :known]
    result = vectors @ spread @ vectors.T
    return np.asarray(0.5 * (result + result.T))


def _score_covariance(
    field: _Aligned,
    columns: Array,
    residual: Array,
    misfit: float,
    cell_m: float,
    noise: NoiseModel,
) -> Array:
    """Return sum_ij u_i C(i - j) u_j' (p, p), where u = weight * column and C is seen in r."""
    shape = field.both.shape
    size = tuple(fft.next_fast_len(2 * n, real=True) for n in shape)
    root = np.sqrt(field.weight)
    stack = np.concatenate([[field.both, root * residual], columns * root], axis=0)
    spectrum = fft.rfft2(stack, s=size)
    pairs = fft.irfft2(np.abs(spectrum[0]) ** 2, s=size)
    seen = fft.irfft2(np.abs(spectrum[1]) ** 2, s=size) / np.maximum(pairs, 1.0)
    lag = [fft.fftfreq(n, 1.0 / n) * cell_m for n in size]
    distance = np.hypot(lag[0][:, None], lag[1][None, :])
    taper = np.maximum(1.0 - distance / (4.0 * noise.correlation_m), 0.0)
    model = np.exp(-0.5 * (distance / noise.correlation_m) ** 2) * noise.correlated_share * misfit
    model[0, 0] = misfit
    floor = np.maximum(fft.rfft2(np.where(pairs > 0.5, seen, 0.0) * taper).real, 0.0)
    power = np.maximum(floor, fft.rfft2(model).real)
    return _quadratic(spectrum[2:], power, size)


def _quadratic(spectrum: Array, power: Array, size: tuple[int, ...]) -> Array:
    """Return Parseval's sum over both halves of the spectrum of u power u', (p, p)."""
    double = np.full(spectrum.shape[2], 2.0)
    double[0] = 1.0
    if size[1] % 2 == 0:
        double[-1] = 1.0
    flat = spectrum.reshape(spectrum.shape[0], -1)
    weight = (power * double).ravel() / (size[0] * size[1])
    return np.asarray(((flat * weight) @ flat.conj().T).real)
