"""Sub-maps as sounding patches that a map can be drawn from."""

import numpy as np
from scipy import ndimage

from firmware.submaps import GriddedSubmap
from host_tools.results import SoundingPatch
from host_tools.simulator.placement import Window

FINEST_SPLIT = 8


def patch_of_grid(vehicle: int, grid: GriddedSubmap, window: Window) -> SoundingPatch:
    """Return the patch of a gridded sub-map, interpolated where the map's cells are finer.

    Each point's variance is that of its cell: splitting a cell makes its information no larger,
    only more finely spread.
    """
    cell_m = min(window.cell_north_m, window.cell_east_m)
    split = int(np.clip(np.ceil(grid.cell_m / cell_m - 1e-6), 1, FINEST_SPLIT))
    rows, columns = grid.depth_m.shape
    row = np.arange((rows - 1) * split + 1) / split
    column = np.arange((columns - 1) * split + 1) / split
    at = np.stack(np.meshgrid(row, column, indexing="ij")).reshape(2, -1)
    layers = []
    for layer in (grid.depth_m, grid.variance_m2, grid.time_s):
        if split > 1:
            layers.append(ndimage.map_coordinates(layer, at, order=1, mode="nearest"))
        else:
            layers.append(layer.ravel())
    depth_m, variance_m2, time_s = layers
    kept = np.isfinite(depth_m)
    return SoundingPatch(
        vehicle=vehicle,
        north_m=grid.north0_m + grid.cell_m * at[0][kept],
        east_m=grid.east0_m + grid.cell_m * at[1][kept],
        depth_m=depth_m[kept],
        variance_m2=variance_m2[kept] * split**2,
        time_s=time_s[kept],
    )
