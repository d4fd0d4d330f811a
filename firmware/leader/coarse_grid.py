"""Grids of larger cells, for what is told by relief that is smooth."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from firmware.geometry import Array
from firmware.submaps import GriddedSubmap


def coarse(grid: GriddedSubmap) -> GriddedSubmap:
    """Return a grid of cells twice as large, each the mean of those known of four.

    Noise of soundings is averaged; a reconstruction's is alike in neighbours.
    """
    rows, columns = (n // 2 * 2 for n in grid.depth_m.shape)
    known = np.isfinite(grid.depth_m) & np.isfinite(grid.variance_m2)
    count = _blocks(known, rows, columns).sum(axis=(1, 3))

    def mean(values: Array, of: NDArray[np.bool_]) -> Array:
        total = _blocks(np.where(of, values, 0.0), rows, columns).sum(axis=(1, 3))
        number = _blocks(of, rows, columns).sum(axis=(1, 3))
        return np.where(number > 0, total / np.maximum(number, 1), np.nan)

    variance_m2 = mean(grid.variance_m2, known)
    return replace(
        grid,
        north0_m=grid.north0_m + grid.cell_m / 2.0,
        east0_m=grid.east0_m + grid.cell_m / 2.0,
        cell_m=2.0 * grid.cell_m,
        depth_m=mean(grid.depth_m, known),
        variance_m2=variance_m2 if grid.reconstructed else variance_m2 / np.maximum(count, 1),
        time_s=mean(grid.time_s, known & np.isfinite(grid.time_s)),
    )


def _blocks(values: NDArray[np.generic], rows: int, columns: int) -> NDArray[np.generic]:
    return values[:rows, :columns].reshape(rows // 2, 2, columns // 2, 2)
