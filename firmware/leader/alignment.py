"""Two sub-maps laid on each other at one shift: differences, slopes, and what may explain them.

The difference of two aligned sub-maps is d = r(x + s) - q(x) - B beta. Besides the shift s the
design carries nuisances with Gaussian priors: depth offset, tilt and bend between the passes
(tide, roll bias, refraction smile) and what is left of each sub-map's drift.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from firmware.geometry import Array
from firmware.leader.screening import Landing, Layer, land, sample

_DEPTH, _VARIANCE, _TIME, _SLOPES = 0, 1, 2, slice(3, 5)  # of the fields
_LEAST_CELLS = 12  # fewer cells than unknowns determine nothing


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseModel:
    """Standard deviations that the fit assumes; all may be zero but cell_sigma_m.

    correlated_share is the share of a cell's variance that is alike within correlation_m.
    """

    cell_sigma_m: float
    position_sigma_m: float
    offset_sigma_m: float
    tilt_sigma: float
    bend_sigma_per_m: float
    drift_sigma_mps: float
    walk_m2_per_s: float
    correlation_m: float
    correlated_share: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Span:
    """When one side of the overlap was measured; age_s (R, C) counts from the mean time."""

    mean_s: float
    length_s: float
    age_s: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Aligned:
    """Fields of the overlap at one shift, (R, C) on the query's lattice, zero outside."""

    shift_m: Array  # (2,) added to the query's coordinates
    cell_m: float
    centre_m: Array  # (2,) of the overlap, in the reference's coordinates
    both: Array
    difference_m: Array
    weight: Array
    variance_m2: Array
    slope_r: Array  # (2, R, C)
    slope_q: Array  # (2, R, C)
    spans: tuple[Span, Span]  # of reference and query
    basis: Array  # (6, R, C) offset, tilt, bend

    @property
    def extent_m(self) -> float:
        """How far the overlap's cells lie from its middle, root mean square."""
        return float(np.sqrt(np.sum(self.basis[1:3] ** 2) / self.both.sum()))


def fields_of(layer: Layer, smoothing_cells: float) -> Array:
    """Return depth, variance, time and smoothed slopes to north and east, (5, R, C).

    Slopes are smoothed over the known cells to keep sounding noise out; all fields are NaN where
    one of them is unknown. A grid of one row or column has no slopes: nothing of it is known.
    """
    depth = np.where(layer.known > 0, layer.grid.depth_m - np.nanmean(layer.grid.depth_m), 0.0)
    share = ndimage.gaussian_filter(layer.known, smoothing_cells, mode="constant")
    smooth = ndimage.gaussian_filter(depth, smoothing_cells, mode="constant")
    smooth = np.where(share > 0.3, smooth / np.maximum(share, 0.3), np.nan)
    if min(smooth.shape) < 2:
        return np.full((5, *smooth.shape), np.nan)
    slopes = np.gradient(smooth, layer.grid.cell_m)
    stack = np.stack([layer.grid.depth_m, layer.map_m2, layer.grid.time_s, *slopes])
    return np.where(np.isfinite(stack).all(axis=0), stack, np.nan)


def align(
    reference: Layer,
    query: Layer,
    fields: tuple[Array, Array],
    shift_m: Array,
    noise: NoiseModel,
) -> Aligned | None:
    """Return the fields of the overlap at a shift, None when too few cells overlap."""
    at = land(reference.grid, query.grid, shift_m)
    if at is None:
        return None
    under, over = sample(fields[0], at), fields[1][:, *at.query]
    both = np.isfinite(under[0]) & np.isfinite(over[0])
    if both.sum() < _LEAST_CELLS:
        return None
    under, over = np.where(both, under, 0.0), np.where(both, over, 0.0)
    slope_r, slope_q = under[_SLOPES], over[_SLOPES]
    variance = under[_VARIANCE] + over[_VARIANCE] + noise.cell_sigma_m**2
    variance += 0.25 * noise.position_sigma_m**2 * np.sum((slope_r + slope_q) ** 2, axis=0)
    clean = both.astype(np.float64)
    return Aligned(
        shift_m=shift_m,
        cell_m=query.grid.cell_m,
        centre_m=_centre(clean, query, at) + shift_m,
        both=clean,
        difference_m=under[_DEPTH] - over[_DEPTH],
        weight=clean / variance,
        variance_m2=variance,
        slope_r=slope_r,
        slope_q=slope_q,
        basis=_polynomials(clean, query.grid.cell_m),
        spans=(_span(under[_TIME], clean), _span(over[_TIME], clean)),
    )


def _centre(both: Array, query: Layer, at: Landing) -> Array:
    """Return the middle (2,) of the overlap in the query's coordinates."""
    cells = both.sum()
    row = at.query[0].start + both.sum(axis=1) @ np.arange(both.shape[0]) / cells
    column = at.query[1].start + both.sum(axis=0) @ np.arange(both.shape[1]) / cells
    origin_m = np.array([query.grid.north0_m, query.grid.east0_m])
    return np.asarray(origin_m + query.grid.cell_m * np.array([row, column]))


def _span(time_s: Array, both: Array) -> Span:
    """Return when the overlap's cells were measured, of times that are zero outside."""
    cells = both.sum()
    mean_s = float(np.sum(time_s) / cells)
    inside = time_s[both > 0.0]
    return Span(
        mean_s=mean_s,
        length_s=float(inside.max() - inside.min()),
        age_s=both * (time_s - mean_s),
    )


def _polynomials(both: Array, cell_m: float) -> Array:
    """Return 1, n, e, n^2, n e, e^2 over the overlap, centred, in metres; (6, R, C)."""
    rows, cols = both.shape
    total = both.sum()
    n = np.arange(rows) * cell_m
    e = np.arange(cols) * cell_m
    n = (n - both.sum(axis=1) @ n / total)[:, None] * both
    e = (e - both.sum(axis=0) @ e / total)[None, :] * both
    return np.asarray(np.stack([both, n, e, n * n, n * e, e * e]), dtype=np.float64)


def design_of(field: Aligned, noise: NoiseModel) -> tuple[Array, Array]:
    """Return the design (p, R, C) and the prior information (p,) of its unknowns.

    The unknowns are the shift, which has no prior, then those of offset, drift of reference and
    query, tilt and bend whose sigma is not zero, in this order.
    """
    slope = 0.5 * (field.slope_r + field.slope_q)
    groups = [
        (field.basis[:1], noise.offset_sigma_m),
        (-slope * field.spans[0].age_s, noise.drift_sigma_mps),
        (slope * field.spans[1].age_s, noise.drift_sigma_mps),
        (field.basis[1:3], noise.tilt_sigma),
        (field.basis[3:], noise.bend_sigma_per_m),
    ]
    active = [(columns, sigma) for columns, sigma in groups if sigma > 0.0]
    prior = [0.0, 0.0] + [1.0 / sigma**2 for columns, sigma in active for _ in columns]
    return np.concatenate([slope, *(columns for columns, _ in active)]), np.array(prior)
