"""Depth maps on the terrain's own grid, gathered sounding by sounding."""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from firmware.geometry import Array
from host_tools.simulator.placement import Window

# A sounding's depth is never known better than this: tide, draught, the grid itself.
FLOOR_VARIANCE_M2 = 0.02**2


class DepthMap:
    """Weighted mean and spread of depth per cell of a window, in mission NED.

    Memory is four numbers a cell, whatever the number of soundings. Row 0 is the southernmost.
    """

    def __init__(self, window: Window) -> None:
        self.window = window
        self._sums = np.zeros((4, window.rows, window.columns))

    def add(self, soundings_m: Array, variance_m2: Array | float = FLOOR_VARIANCE_M2) -> None:
        """Add soundings (N, 3) north, east, depth; variance_m2 is (N,) or one for all.

        Soundings that are not finite, and those outside the window, are left out.
        """
        weight = 1.0 / (np.broadcast_to(variance_m2, len(soundings_m)) + FLOOR_VARIANCE_M2)
        row = (soundings_m[:, 0] - self.window.north0_m) / self.window.cell_north_m + 0.5
        column = (soundings_m[:, 1] - self.window.east0_m) / self.window.cell_east_m + 0.5
        with np.errstate(invalid="ignore"):
            good = np.isfinite(soundings_m).all(axis=1) & np.isfinite(weight)
            good &= (row >= 0) & (row < self.window.rows)
            good &= (column >= 0) & (column < self.window.columns)
        if not good.any():
            return
        i, j = row[good].astype(np.int64), column[good].astype(np.int64)
        depth_m, weight = soundings_m[good, 2], weight[good]
        # Only the box that is touched: a window may hold a million cells.
        i0, j0 = int(i.min()), int(j.min())
        shape = (int(i.max()) - i0 + 1, int(j.max()) - j0 + 1)
        cell = (i - i0) * shape[1] + (j - j0)
        box = self._sums[:, i0 : i0 + shape[0], j0 : j0 + shape[1]]
        terms = (np.ones_like(weight), weight, weight * depth_m, weight * depth_m**2)
        for k, term in enumerate(terms):
            box[k] += np.bincount(cell, term, shape[0] * shape[1]).reshape(shape)

    @property
    def sums(self) -> NDArray[np.float64]:
        """What was gathered, (4, rows, columns): count, and sums of weight, depth and square."""
        return self._sums

    def add_sums(self, sums: NDArray[np.float64]) -> None:
        """Add what another map of the same window has gathered."""
        self._sums += sums

    def grids(self, fill_m: float = 0.0) -> tuple[Array, Array]:
        """Return depth and standard deviation (rows, columns), NaN where nothing was measured.

        A cell within fill_m of measured ones, and without soundings of its own, takes their mean:
        grids finer than the soundings would otherwise be full of holes.
        """
        sums = self._filled(fill_m)
        count, weight, first, second = sums
        empty = count == 0
        safe = np.where(empty, 1.0, weight)
        depth_m = np.where(empty, np.nan, first / safe)
        spread_m2 = np.maximum(second / safe - (first / safe) ** 2, 0.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            variance_m2 = np.maximum(1.0 / safe, spread_m2 / np.maximum(count, 1.0))
        return depth_m, np.where(empty, np.nan, np.sqrt(variance_m2))

    def _filled(self, fill_m: float) -> NDArray[np.float64]:
        reach = (
            round(fill_m / self.window.cell_north_m),
            round(fill_m / self.window.cell_east_m),
        )
        if reach == (0, 0):
            return self._sums
        size = (2 * reach[0] + 1, 2 * reach[1] + 1)
        cells = size[0] * size[1]
        near = np.stack(
            [ndimage.uniform_filter(layer, size, mode="constant") * cells for layer in self._sums]
        )
        near[:, np.round(near[0]) == 0] = 0.0
        filled: NDArray[np.float64] = np.where(self._sums[0] > 0, self._sums, near)
        return filled


def displaced_sigma_m(depth_m: Array, sigma_m: Array, position_m2: Array, window: Window) -> Array:
    """Return the sigma (rows, columns) of depths that were measured a little way off.

    position_m2 (2, 2) is the covariance of where they lie, north and east: felt on slopes. Next to
    what is unknown no slope is told, and sigma stays.
    """
    if min(depth_m.shape) < 2:
        return sigma_m
    slopes = np.asarray(np.gradient(depth_m, window.cell_north_m, window.cell_east_m))
    added_m2 = np.einsum("irc,ij,jrc->rc", slopes, position_m2, slopes)
    return np.asarray(np.sqrt(sigma_m**2 + np.nan_to_num(added_m2)))
