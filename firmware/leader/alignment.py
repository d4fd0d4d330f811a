"""Two sub-maps laid on each other at one shift: differences, slopes, and what may explain them.

The difference of two aligned sub-maps is d = r(x + s) - q(x) - B beta. Besides the shift s the
design carries nuisances with Gaussian priors: depth offset, tilt and bend between the passes
(tide, roll bias, refraction smile) and what is left of each sub-map's drift.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from firmware.geometry import Array
from firmware.leader.screening import Landing, Layer, land, sample

_DEPTH, _VARIANCE, _TIME, _SLOPES, _SMOOTH = 0, 1, 2, slice(3, 5), slice(5, 7)  # of the fields
TINY_M2 = 1e-6  # two sub-maps of one node have no offset
_LEAST_SHARE = 0.1  # of a smoothing that lies on known cells
_LEAST_CELLS = 12  # fewer cells than unknowns determine nothing


@dataclass(frozen=True, slots=True, kw_only=True)
class Coupling:
    """What is believed of a pair before its match: the shift, and how it goes with the drifts.

    covariance (6, 6) is that of the shift between times_s of both, of the drift of the reference
    and of that of the query, in m and m/s. A shift of mean_m (2,) implies the drifts that the grids
    were rid of, others imply more or less.
    """

    mean_m: Array
    covariance: Array
    times_s: tuple[float, float]

    def drifts_at(self, times_s: tuple[float, float]) -> tuple[Array, Array]:
        """Return the gain (4, 2) of both drifts by the shift between other times, and the rest.

        The latter is their covariance (4, 4) where that shift is known.
        """
        moved = np.eye(6)
        moved[:2, 2:4] = (times_s[0] - self.times_s[0]) * np.eye(2)
        moved[:2, 4:] = (self.times_s[1] - times_s[1]) * np.eye(2)
        both = moved @ self.covariance @ moved.T
        gain = np.asarray(np.linalg.solve(both[:2, :2] + TINY_M2 * np.eye(2), both[:2, 2:]).T)
        return gain, both[2:, 2:] - gain @ both[:2, 2:]


UNCOUPLED = Coupling(mean_m=np.zeros(2), covariance=np.zeros((6, 6)), times_s=(0.0, 0.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseModel:
    """What the fit assumes: standard deviations, which may be zero but for cell_sigma_m, and drift.

    correlated_share is the share of a cell's variance that is alike within correlation_m.
    drift_sigma_mps is that of drifts beside what is believed of them.
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
    coupling: Coupling = UNCOUPLED


@dataclass(frozen=True, slots=True, kw_only=True)
class Span:
    """When one side of the overlap was measured; age_s (N,) counts from the mean time."""

    mean_s: float
    age_s: Array

    @property
    def length_s(self) -> float:
        """From the first cell to the last."""
        return float(np.ptp(self.age_s))


@dataclass(frozen=True, slots=True, kw_only=True)
class Aligned:
    """Fields of the overlap at one shift, (N,) by its cells, of the query's lattice.

    both (R, C) are these cells in the rectangle `at.query` of the query.
    """

    shift_m: Array  # (2,) added to the query's coordinates
    cell_m: float
    centre_m: Array  # (2,) of the overlap, in the reference's coordinates
    at: Landing
    both: NDArray[np.bool_]
    difference_m: Array
    variance_m2: Array
    slope_r: Array  # (2, N)
    slope_q: Array  # (2, N)
    smooth_r: Array  # (2, N) the same without most of the noise, and of the finest relief
    smooth_q: Array  # (2, N)
    spans: tuple[Span, Span]  # of reference and query
    basis: Array  # (6, N) offset, tilt, bend

    @property
    def cells(self) -> int:
        """How many cells overlap."""
        return self.difference_m.size

    @property
    def extent_m(self) -> float:
        """How far the overlap's cells lie from its middle, root mean square."""
        return float(np.sqrt(np.sum(self.basis[1:3] ** 2) / self.cells))


def fields_of(layer: Layer, smoothing_cells: float) -> Array:
    """Return depth, variance, time, and slopes to north and east as they are and smooth, (7, R, C).

    Smooth slopes are those of the grid's plane and of what it leaves, smoothed over the known cells
    to keep sounding noise out: edges flatten only the latter. All fields are NaN where one of them
    is unknown. A grid of one row or column has no slopes: nothing of it is known.
    """
    depth_m, cell_m, is_known = layer.grid.depth_m, layer.grid.cell_m, layer.known > 0
    if min(depth_m.shape) < 2:
        return np.full((7, *depth_m.shape), np.nan)
    plane_m = layer.plane_m
    rough = np.where(is_known, depth_m - plane_m, 0.0)
    share = ndimage.gaussian_filter(layer.known, smoothing_cells, mode="constant")
    smooth = ndimage.gaussian_filter(rough, smoothing_cells, mode="constant")
    smooth = plane_m + smooth / np.maximum(share, _LEAST_SHARE)
    whole = np.where(is_known, depth_m, smooth)
    slopes = np.gradient(whole, cell_m)  # at edges half of it is smooth
    stack = [depth_m, layer.map_m2, layer.grid.time_s, *slopes, *np.gradient(smooth, cell_m)]
    fields = np.stack(stack)
    return np.where(np.isfinite(fields).all(axis=0), fields, np.nan)


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
    both = np.isfinite(under[_DEPTH]) & np.isfinite(over[_DEPTH])
    found = np.flatnonzero(both)
    if found.size < _LEAST_CELLS:
        return None
    under, over = (side.reshape(len(side), -1).take(found, axis=1) for side in (under, over))
    row, column = np.divmod(found, both.shape[1])
    smooth_r, smooth_q = under[_SMOOTH], over[_SMOOTH]
    variance = under[_VARIANCE] + over[_VARIANCE] + noise.cell_sigma_m**2
    variance += 0.25 * noise.position_sigma_m**2 * np.sum((smooth_r + smooth_q) ** 2, axis=0)
    cell_m, middle = query.grid.cell_m, np.array([row.mean(), column.mean()])
    first_m = np.array([query.grid.north0_m, query.grid.east0_m])
    corner = np.array([at.query[0].start, at.query[1].start])
    return Aligned(
        shift_m=shift_m,
        cell_m=cell_m,
        centre_m=first_m + cell_m * (corner + middle) + shift_m,
        at=at,
        both=both,
        difference_m=under[_DEPTH] - over[_DEPTH],
        variance_m2=variance,
        slope_r=under[_SLOPES],
        slope_q=over[_SLOPES],
        smooth_r=smooth_r,
        smooth_q=smooth_q,
        basis=_polynomials(cell_m * (row - middle[0]), cell_m * (column - middle[1])),
        spans=(_span(under[_TIME]), _span(over[_TIME])),
    )


def _span(time_s: Array) -> Span:
    """Return when the overlap's cells (N,) were measured."""
    mean_s = float(time_s.mean())
    return Span(mean_s=mean_s, age_s=time_s - mean_s)


def _polynomials(n: Array, e: Array) -> Array:
    """Return 1, n, e, n^2, n e, e^2, of metres from the middle; (6, N)."""
    return np.stack([np.ones(n.size), n, e, n * n, n * e, e * e])
