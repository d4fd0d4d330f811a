"""The residual error of Eq. (8) and Eq. (10) at every lattice shift, by masked FFT correlation.

At a shift that lays the query's lattice on the reference's, bilinear interpolation returns the cell
itself, so the correlation surfaces hold Eq. (8) and (10) exactly; `error_at` evaluates the same
sums by interpolation at any shift.
"""

from dataclasses import dataclass

import numpy as np
from scipy import fft

from firmware.geometry import Array
from firmware.leader.warping import bilinear
from firmware.submaps import GriddedSubmap


@dataclass(frozen=True, slots=True, kw_only=True)
class Layer:
    """A grid cropped to its known cells, ready for correlation.

    depth_m is zero and weight zero where nothing is known; weight is 1, or exp(-Omega) of Eq. (10)
    when the grid is reconstructed. All fields are (R, C).
    """

    grid: GriddedSubmap
    known: Array
    weight: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorSurface:
    """Residual error over lattice shifts (K,), (L,): what to add to the query's coordinates.

    residual_m2 is E with the depth offset taken out, inf where overlap_cells <= N_T; (K, L).
    """

    north_m: Array
    east_m: Array
    overlap_cells: Array
    residual_m2: Array
    depth_offset_m: Array


def prepare(grid: GriddedSubmap, *, reconstructed: bool) -> Layer | None:
    """Return the grid cropped to its known cells, or None if no cell is known."""
    known = np.isfinite(grid.depth_m) & np.isfinite(grid.variance_m2)
    rows, cols = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    if not rows.size:
        return None
    box = (slice(rows[0], rows[-1] + 1), slice(cols[0], cols[-1] + 1))
    cropped = GriddedSubmap(
        north0_m=grid.north0_m + float(rows[0]) * grid.cell_m,
        east0_m=grid.east0_m + float(cols[0]) * grid.cell_m,
        cell_m=grid.cell_m,
        depth_m=np.where(known, grid.depth_m, np.nan)[box],
        variance_m2=np.where(known, grid.variance_m2, np.nan)[box],
        time_s=grid.time_s[box],
    )
    mask = known[box].astype(np.float64)
    weight = mask * np.exp(-np.nan_to_num(cropped.variance_m2)) if reconstructed else mask
    return Layer(grid=cropped, known=mask, weight=weight)


def error_surface(
    reference: Layer, query: Layer, minimum_cells: float, offset_ridge_cells: float
) -> ErrorSurface:
    """Return E at every lattice shift with any overlap.

    offset_ridge_cells is the noise variance over the variance of the depth offset's prior: inf
    leaves no offset (the paper's reading), zero takes the whole mean difference out.
    """
    datum_m = float(np.nanmean(reference.grid.depth_m))
    stack_r = _moments(reference, datum_m)
    stack_q = _moments(query, datum_m)
    rows, cols = reference.known.shape
    query_rows, query_cols = query.known.shape
    full = (rows + query_rows - 1, cols + query_cols - 1)
    size = tuple(fft.next_fast_len(n, real=True) for n in full)
    f_r = fft.rfft2(stack_r, s=size)
    f_q = np.conj(fft.rfft2(stack_q, s=size))
    spectra = np.stack(
        [
            f_r[0] * f_q[0],
            f_r[1] * f_q[1],
            f_r[2] * f_q[1] - f_r[1] * f_q[2],
            f_r[3] * f_q[1] - 2.0 * f_r[2] * f_q[2] + f_r[1] * f_q[3],
        ]
    )
    sums = np.roll(fft.irfft2(spectra, s=size), (query_rows - 1, query_cols - 1), axis=(1, 2))
    count, weight, first, second = sums[:, : full[0], : full[1]]
    count = np.round(count)
    weight = np.maximum(weight, 0.0)
    offset = first / (np.maximum(weight, 1e-9) + offset_ridge_cells)
    error = np.maximum(second - 2.0 * offset * first + offset**2 * weight, 0.0)
    enough = count > minimum_cells
    cell_m = reference.grid.cell_m
    return ErrorSurface(
        north_m=reference.grid.north0_m
        - query.grid.north0_m
        + cell_m * np.arange(1 - query_rows, rows),
        east_m=reference.grid.east0_m
        - query.grid.east0_m
        + cell_m * np.arange(1 - query_cols, cols),
        overlap_cells=count,
        residual_m2=np.where(enough, error / np.maximum(count, 1.0), np.inf),
        depth_offset_m=offset,
    )


def _moments(layer: Layer, datum_m: float) -> Array:
    """Return mask, weight, weighted depth and weighted squared depth, zero where unknown."""
    depth = np.where(layer.known > 0, layer.grid.depth_m - datum_m, 0.0)
    return np.stack([layer.known, layer.weight, layer.weight * depth, layer.weight * depth**2])


def error_at(
    reference: Layer,
    query: Layer,
    shift_m: Array,
    minimum_cells: float,
    offset_ridge_cells: float,
    *,
    absolute: bool = False,
) -> tuple[float, int, float]:
    """Return E of Eq. (8)/(10) at any shift, the overlap N_o and the depth offset taken out.

    The reference is interpolated at the query's cells; with `absolute` the norm is |d| in metres
    instead of its square.
    """
    row, col = landing(reference.grid, query.grid, shift_m)
    difference = bilinear(reference.grid.depth_m, row, col) - query.grid.depth_m
    weight = query.weight * np.nan_to_num(bilinear(reference.weight, row, col))
    both = np.isfinite(difference) & (weight > 0)
    count = int(both.sum())
    if count <= minimum_cells:
        return np.inf, count, 0.0
    d, w = difference[both], weight[both]
    offset = float((w @ d) / (w.sum() + offset_ridge_cells))
    norm = np.abs(d - offset) if absolute else (d - offset) ** 2
    return float(w @ norm) / count, count, offset


def landing(reference: GriddedSubmap, query: GriddedSubmap, shift_m: Array) -> tuple[Array, Array]:
    """Return the reference's fractional row and column (R, C) under each shifted query cell."""
    rows, cols = query.depth_m.shape
    row = (query.north0_m + shift_m[0] - reference.north0_m) / query.cell_m + np.arange(rows)
    col = (query.east0_m + shift_m[1] - reference.east0_m) / query.cell_m + np.arange(cols)
    row, col = _snap(row), _snap(col)
    grid_row, grid_col = np.meshgrid(row, col, indexing="ij")
    return grid_row, grid_col


def _snap(index: Array) -> Array:
    """Return indices with rounding noise removed, so that lattice shifts stay on the lattice."""
    near = np.round(index)
    return np.where(np.abs(index - near) < 1e-7, near, index)
