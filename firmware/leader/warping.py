"""Taking estimated drift out of a sub-map's grid before it is matched."""

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from firmware.geometry import Array
from firmware.submaps import GriddedSubmap

_ITERATIONS = 2  # the time field changes slowly, so the inverse warp settles to a centimetre in two


def remove_drift(
    grid: GriddedSubmap,
    drift_north_mps: float,
    drift_east_mps: float,
    reference_time_s: float,
    *,
    nearest: bool = False,
) -> GriddedSubmap:
    """Return the grid with a constant drift velocity of dead reckoning taken out.

    A cell measured at time t lies drift * (t - reference_time_s) too far along the drift; it is
    moved back by that, so that the whole grid agrees with dead reckoning at the reference time.
    The grid keeps its cell size and grows by the largest displacement; values are bilinear, or
    those of the nearest cell: half a cell coarser, but as noisy as they were.
    """
    known = np.isfinite(grid.time_s) & np.isfinite(grid.depth_m)
    drift_mps = np.array([drift_north_mps, drift_east_mps])
    if not known.any() or not np.any(drift_mps):
        return grid
    age_s = grid.time_s[known] - reference_time_s
    moves_m = -drift_mps[:, None] * np.array([age_s.min(), age_s.max()])
    low = np.floor(np.minimum(moves_m.min(axis=1), 0.0) / grid.cell_m).astype(int)
    high = np.ceil(np.maximum(moves_m.max(axis=1), 0.0) / grid.cell_m).astype(int)
    row = np.arange(low[0], grid.depth_m.shape[0] + high[0], dtype=np.float64)[:, None]
    col = np.arange(low[1], grid.depth_m.shape[1] + high[1], dtype=np.float64)[None, :]
    time_at = _time_plane(grid, known)
    time_s = time_at(row, col)
    for _ in range(_ITERATIONS):
        step = drift_mps[:, None, None] * (time_s - reference_time_s) / grid.cell_m
        time_s = time_at(row + step[0], col + step[1])
    step = drift_mps[:, None, None] * (time_s - reference_time_s) / grid.cell_m
    source_row, source_col = row + step[0], col + step[1]
    if nearest:
        source_row, source_col = np.round(source_row), np.round(source_col)
    fields = np.stack([grid.depth_m, grid.variance_m2, grid.time_s])
    depth_m, variance_m2, time_s = bilinear(fields, source_row, source_col)
    return dataclasses.replace(
        grid,
        north0_m=grid.north0_m + low[0] * grid.cell_m,
        east0_m=grid.east0_m + low[1] * grid.cell_m,
        depth_m=depth_m,
        variance_m2=variance_m2,
        time_s=time_s,
    )


def bilinear(values: Array, row: Array, col: Array) -> Array:
    """Return values (..., R, C) at fractional indices; NaN outside and next to unknown cells.

    A neighbour whose weight is zero is not asked, so whole indices return the cell itself.
    """
    *fields, rows, cols = values.shape
    inside = (row >= 0) & (row <= rows - 1) & (col >= 0) & (col <= cols - 1)
    i = np.clip(np.floor(row), 0, max(rows - 2, 0)).astype(np.intp)
    j = np.clip(np.floor(col), 0, max(cols - 2, 0)).astype(np.intp)
    a, b = row - i, col - j
    flat = values.reshape(*fields, -1)
    corner = np.where(inside, i * cols + j, 0)
    total = np.zeros((*fields, *corner.shape))
    down = cols if rows > 1 else 0
    right = 1 if cols > 1 else 0
    for offset, weight in (
        (0, (1 - a) * (1 - b)),
        (down, a * (1 - b)),
        (right, (1 - a) * b),
        (down + right, a * b),
    ):
        total += np.where(weight == 0.0, 0.0, flat.take(corner + offset, axis=-1) * weight)
    return np.where(inside, total, np.nan)


def _time_plane(grid: GriddedSubmap, known: NDArray[np.bool_]) -> Callable[[Array, Array], Array]:
    """Return what tells the time of measurement by row and column: a plane through the known cells.

    Within forty seconds of straight track the time of a cell is a plane in its position to within
    the attitude; the plane also covers the margin where no cell is known.
    """
    i, j = np.nonzero(known)
    design = np.column_stack([np.ones(i.size), i, j])
    known_s = grid.time_s[known]
    plane = np.linalg.lstsq(design, known_s, rcond=None)[0]
    first_s, last_s = known_s.min(), known_s.max()

    def time_at(row: Array, col: Array) -> Array:
        return np.asarray(np.clip(plane[0] + plane[1] * row + plane[2] * col, first_s, last_s))

    return time_at
