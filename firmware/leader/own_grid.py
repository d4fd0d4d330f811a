"""The leader's own sub-maps as grids, straight from binned soundings."""

import numpy as np

from firmware.submaps import BinnedSoundings, GriddedSubmap


def grid_of(bins: BinnedSoundings, cell_m: float) -> GriddedSubmap:
    """Return binned soundings averaged into cells of a regular grid.

    A cell's depth is the mean of its bins weighted by their variance. Cell centres lie at whole
    multiples of cell_m, so that grids of one vehicle share their raster.
    """
    north0, east0 = np.floor(bins.north_m.min() / cell_m), np.floor(bins.east_m.min() / cell_m)
    row = (np.round(bins.north_m / cell_m) - north0).astype(np.intp)
    column = (np.round(bins.east_m / cell_m) - east0).astype(np.intp)
    shape = (int(row.max()) + 1, int(column.max()) + 1)
    index, size = row * shape[1] + column, shape[0] * shape[1]
    weight = 1.0 / np.maximum(bins.variance_m2, 1e-6)
    total = np.bincount(index, weight, size)
    with np.errstate(invalid="ignore", divide="ignore"):
        depth_m = np.bincount(index, weight * bins.depth_m, size) / total
        time_s = np.bincount(index, weight * bins.time_s, size) / total
        variance_m2 = np.where(total > 0, 1.0 / total, np.nan)
    return GriddedSubmap(
        north0_m=float(north0 * cell_m),
        east0_m=float(east0 * cell_m),
        cell_m=cell_m,
        depth_m=depth_m.reshape(shape),
        variance_m2=variance_m2.reshape(shape),
        time_s=time_s.reshape(shape),
    )
