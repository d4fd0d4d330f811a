"""The leader's own sub-maps as grids, straight from binned soundings."""

import numpy as np

from firmware.submaps import BinnedSoundings, GriddedSubmap

_LEAST_SHARE = 0.25  # of a bin: a cell that is touched by less lies beside the soundings


def grid_of(bins: BinnedSoundings, cell_m: float) -> GriddedSubmap:
    """Return binned soundings averaged into cells of a regular grid.

    A cell's depth is the mean of its bins weighted by their variance. Cell centres lie at whole
    multiples of cell_m, so that grids of one vehicle share their raster. Bins of more than half a
    cell lie across its edges: each counts in the four cells about it, by how near it is.
    """
    north, east = bins.north_m / cell_m, bins.east_m / cell_m
    north0, east0 = np.floor(north.min()), np.floor(east.min())
    places = [(np.round(north), np.round(east), np.ones(north.size))]
    if 2.0 * bins.cell_m > cell_m:
        places = [
            (at_north, at_east, (1.0 - abs(north - at_north)) * (1.0 - abs(east - at_east)))
            for at_north in (np.floor(north), np.floor(north) + 1.0)
            for at_east in (np.floor(east), np.floor(east) + 1.0)
        ]
    rows, columns, shares = (np.concatenate(part) for part in zip(*places, strict=True))
    row, column = (rows - north0).astype(np.intp), (columns - east0).astype(np.intp)
    shape = (int(row.max()) + 1, int(column.max()) + 1)
    index, size = row * shape[1] + column, shape[0] * shape[1]
    weight = shares / np.tile(np.maximum(bins.variance_m2, 1e-6), len(places))
    total = np.bincount(index, weight, size)
    with np.errstate(invalid="ignore", divide="ignore"):
        depth_m = np.bincount(index, weight * np.tile(bins.depth_m, len(places)), size) / total
        time_s = np.bincount(index, weight * np.tile(bins.time_s, len(places)), size) / total
        variance_m2 = np.where(total > 0, 1.0 / total, np.nan)
    beside = np.bincount(index, shares, size) < _LEAST_SHARE
    depth_m[beside] = variance_m2[beside] = time_s[beside] = np.nan
    return GriddedSubmap(
        north0_m=float(north0 * cell_m),
        east0_m=float(east0 * cell_m),
        cell_m=cell_m,
        depth_m=depth_m.reshape(shape),
        variance_m2=variance_m2.reshape(shape),
        time_s=time_s.reshape(shape),
    )
