"""How well a map lies on the truth map: differences of depth, and shifts of tiles."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from firmware.geometry import Array

TILE_M = 100.0
SEARCH_M = 20.0
LEAST_CELLS = 60
# A tile says where it lies when moving it by a metre changes depth by more than this, root mean
# square, in its least sensitive direction.
LEAST_GRADIENT = 0.01
REFINEMENTS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationError:
    """The paper's registration error: absolute differences of depth, cell by cell.

    mapped_share says how much of the truth map the map holds; what it lacks has no difference.
    """

    cells: int
    mapped_share: float
    mean_m: float
    median_m: float
    p95_m: float
    share_under_half_m: float
    share_under_1m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TileShifts:
    """Horizontal shifts of tiles registered on the truth map.

    Neither flat tiles, which cannot say theirs, nor those that fit best at `SEARCH_M` or beyond,
    where the search ends, or nowhere on the truth map, are among the tiles that median and 95 % are
    of.
    """

    tiles: int
    flat_tiles: int
    far_tiles: int
    median_m: float
    p95_m: float


def registration_error(depth_m: Array, truth_m: Array) -> RegistrationError:
    """Return the differences of two maps (R, C) over the cells that both hold."""
    difference_m = np.abs(depth_m - truth_m)
    difference_m = difference_m[np.isfinite(difference_m)]
    surveyed = np.count_nonzero(np.isfinite(truth_m))
    if difference_m.size == 0:
        nan = float("nan")
        return RegistrationError(
            cells=0,
            mapped_share=0.0 if surveyed else nan,
            mean_m=nan,
            median_m=nan,
            p95_m=nan,
            share_under_half_m=nan,
            share_under_1m=nan,
        )
    return RegistrationError(
        cells=int(difference_m.size),
        mapped_share=difference_m.size / surveyed,
        mean_m=float(difference_m.mean()),
        median_m=float(np.median(difference_m)),
        p95_m=float(np.percentile(difference_m, 95)),
        share_under_half_m=float((difference_m < 0.5).mean()),
        share_under_1m=float((difference_m < 1.0).mean()),
    )


def tile_shifts(
    depth_m: Array, truth_m: Array, cell_north_m: float, cell_east_m: float
) -> TileShifts:
    """Return the shifts of 100 m tiles of a map that fit the truth map best, depth offset free."""
    rows = max(2, round(TILE_M / cell_north_m))
    columns = max(2, round(TILE_M / cell_east_m))
    lengths, flat, far = [], 0, 0
    nearest = ndimage.distance_transform_edt(
        np.isnan(truth_m), return_distances=False, return_indices=True
    )
    filled_m = truth_m[tuple(nearest)] if np.isfinite(truth_m).any() else truth_m
    known = np.isfinite(truth_m).astype(np.float64)
    for i in range(0, depth_m.shape[0] - rows + 1, rows):
        for j in range(0, depth_m.shape[1] - columns + 1, columns):
            tile_m = depth_m[i : i + rows, j : j + columns]
            row, column = np.nonzero(np.isfinite(tile_m))
            if row.size < max(LEAST_CELLS, 0.3 * tile_m.size):
                continue
            tile = _Tile(
                tile_m[row, column], row + i, column + j, filled_m, known, cell_north_m, cell_east_m
            )
            shift_m = tile.best_shift()
            if shift_m is None:
                flat += 1
            elif np.abs(shift_m).max() >= SEARCH_M:
                far += 1
            else:
                lengths.append(float(np.hypot(*shift_m)))
    if not lengths:
        nan = float("nan")
        return TileShifts(tiles=0, flat_tiles=flat, far_tiles=far, median_m=nan, p95_m=nan)
    return TileShifts(
        tiles=len(lengths),
        flat_tiles=flat,
        far_tiles=far,
        median_m=float(np.median(lengths)),
        p95_m=float(np.percentile(lengths, 95)),
    )


class _Tile:
    """The cells of one tile, ready to be laid on the truth map at any shift."""

    def __init__(
        self,
        depth_m: Array,
        row: NDArray[np.intp],
        column: NDArray[np.intp],
        truth_m: Array,
        known: Array,
        cell_north_m: float,
        cell_east_m: float,
    ) -> None:
        self._depth_m = depth_m
        self._row, self._column = row.astype(np.float64), column.astype(np.float64)
        self._truth_m, self._known = truth_m, known
        self._cell_m = np.array([cell_north_m, cell_east_m])

    def best_shift(self) -> Array | None:
        """Return the shift (2,) north, east that the tile is off by, or None for a flat tile."""
        overlaps = self._residual(np.zeros(2)) is not None
        if overlaps and not self._is_telling():
            return None
        step_m = max(float(self._cell_m.min()), SEARCH_M / 10.0)
        centre_m, best_m = np.zeros(2), np.zeros(2)
        reach_m = SEARCH_M
        for _ in range(REFINEMENTS):
            steps = np.arange(-reach_m, reach_m + step_m / 2, step_m)
            candidates = [centre_m + np.array([n, e]) for n in steps for e in steps]
            costs = [self._cost(candidate) for candidate in candidates]
            best_m = candidates[int(np.argmin(costs))]
            centre_m, reach_m, step_m = best_m, step_m, step_m / 4.0
        return best_m

    def _is_telling(self) -> bool:
        d_north = self._sample(self._truth_m, np.array([self._cell_m[0], 0.0]))
        d_north -= self._sample(self._truth_m, np.array([-self._cell_m[0], 0.0]))
        d_east = self._sample(self._truth_m, np.array([0.0, self._cell_m[1]]))
        d_east -= self._sample(self._truth_m, np.array([0.0, -self._cell_m[1]]))
        slope = np.stack([d_north / (2 * self._cell_m[0]), d_east / (2 * self._cell_m[1])])
        slope -= slope.mean(axis=1, keepdims=True)  # a plane slides within the free depth offset
        weakest = float(np.linalg.eigvalsh(slope @ slope.T / slope.shape[1])[0])
        return weakest > LEAST_GRADIENT**2

    def _sample(self, grid: Array, shift_m: Array) -> Array:
        at = np.stack(
            [self._row - shift_m[0] / self._cell_m[0], self._column - shift_m[1] / self._cell_m[1]]
        )
        sampled: Array = ndimage.map_coordinates(grid, at, order=1, mode="nearest")
        return sampled

    def _residual(self, shift_m: Array) -> Array | None:
        good = self._sample(self._known, shift_m) > 0.99
        if good.sum() < max(LEAST_CELLS, 0.5 * good.size):
            return None
        difference_m = (self._depth_m - self._sample(self._truth_m, shift_m))[good]
        residual_m: Array = difference_m - difference_m.mean()
        return residual_m

    def _cost(self, shift_m: Array) -> float:
        residual_m = self._residual(shift_m)
        return float("inf") if residual_m is None else float(np.mean(residual_m**2))
