"""The true seabed: depths in mission NED, looked up by bilinear interpolation."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from firmware.geometry import Array

Grid = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class Datum:
    """Where mission NED lies in the terrain's projection.

    North and east of NED are northing - origin_north_m and easting - origin_east_m; depth is
    depth_shift_m - elevation.
    """

    crs_wkt: str
    origin_north_m: float
    origin_east_m: float
    depth_shift_m: float


class Seabed:
    """Depths on a north-up grid; row 0 is the southernmost, NaN is no-data.

    Between cell centres depth is bilinear. Where any of the four cells is no-data, and outside the
    grid, the depth is NaN.
    """

    def __init__(
        self,
        depth_m: NDArray[np.floating],
        north0_m: float,
        east0_m: float,
        cell_north_m: float,
        cell_east_m: float,
    ) -> None:
        padded = np.pad(depth_m.astype(np.float32), 1, constant_values=np.nan)
        self.depth_m: Grid = padded[1:-1, 1:-1]
        self.north0_m, self.east0_m = north0_m, east0_m
        self.cell_north_m, self.cell_east_m = cell_north_m, cell_east_m
        self._known = padded.ravel()
        self._columns = padded.shape[1]
        self._last_row, self._last_column = padded.shape[0] - 2, padded.shape[1] - 2
        nearest = ndimage.distance_transform_edt(
            np.isnan(padded), return_distances=False, return_indices=True
        )
        filled = padded[tuple(nearest)]
        self._filled = filled.ravel()
        slope_north = np.abs(np.diff(filled, axis=0)) / cell_north_m
        slope_east = np.abs(np.diff(filled, axis=1)) / cell_east_m
        self._slope = np.hypot(slope_north[:, :-1], slope_east[:-1, :])
        self._filled_grid = filled

    def depth_at(self, north_m: Array, east_m: Array) -> Array:
        """Return the depths at the positions, NaN outside the data."""
        return self._interpolate(self._known, north_m, east_m)

    def filled_depth_at(self, north_m: Array, east_m: Array) -> Array:
        """Return the same with no-data filled from the nearest cell: for rays that pass over it."""
        return self._interpolate(self._filled, north_m, east_m)

    def shallowest_and_steepest(
        self, north_m: tuple[float, float], east_m: tuple[float, float]
    ) -> tuple[float, float]:
        """Return the least depth and the largest slope (m/m) within a box of NED."""
        rows = self._rows(north_m)
        columns = self._columns_of(east_m)
        return (
            float(self._filled_grid[rows, columns].min()),
            float(self._slope[rows, columns].max()),
        )

    def _rows(self, north_m: tuple[float, float]) -> slice:
        low = int(np.clip((north_m[0] - self.north0_m) / self.cell_north_m, 0, self._last_row))
        high = int(np.clip((north_m[1] - self.north0_m) / self.cell_north_m, 0, self._last_row))
        return slice(low, high + 3)

    def _columns_of(self, east_m: tuple[float, float]) -> slice:
        low = int(np.clip((east_m[0] - self.east0_m) / self.cell_east_m, 0, self._last_column))
        high = int(np.clip((east_m[1] - self.east0_m) / self.cell_east_m, 0, self._last_column))
        return slice(low, high + 3)

    def _interpolate(self, grid: Grid, north_m: Array, east_m: Array) -> Array:
        # One cell of padding on every side: index 1 is the grid's first cell.
        row = (north_m - (self.north0_m - self.cell_north_m)) / self.cell_north_m
        column = (east_m - (self.east0_m - self.cell_east_m)) / self.cell_east_m
        np.clip(row, 0.0, self._last_row + 0.999, out=row)
        np.clip(column, 0.0, self._last_column + 0.999, out=column)
        i, j = row.astype(np.int32), column.astype(np.int32)
        row -= i
        column -= j
        k = i * self._columns + j
        south = grid.take(k)
        south += column * (grid.take(k + 1) - south)
        k += self._columns
        north = grid.take(k)
        north += column * (grid.take(k + 1) - north)
        depth: Array = south + row * (north - south)
        return depth
