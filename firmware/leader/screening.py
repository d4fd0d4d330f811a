"""The residual error of Eq. (8) and Eq. (10) at every lattice shift, by masked FFT correlation.

At a shift that lays the query's lattice on the reference's, bilinear interpolation returns the cell
itself, so the correlation surfaces hold Eq. (8) and (10) exactly; `error_at` evaluates the same
sums by interpolation at any shift.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy import fft

from firmware.geometry import Array
from firmware.submaps import GriddedSubmap


@dataclass(frozen=True, slots=True, kw_only=True)
class Layer:
    """A grid cropped to its known cells, ready for correlation.

    depth_m is zero and weight zero where nothing is known; weight is 1, or exp(-Omega) of Eq. (10)
    when the grid is reconstructed. map_m2 is the variance of the map, noise_m2 what it contributes
    to the variance of a difference; both zero where unknown. All fields are (R, C).
    """

    grid: GriddedSubmap
    known: Array
    weight: Array
    map_m2: Array
    noise_m2: Array

    @property
    def plane_m(self) -> Array:
        """The plane through the known depths, everywhere, (R, C)."""
        i, j = np.nonzero(self.known)
        at = np.stack([np.ones(i.size), i - i.mean(), j - j.mean()])
        normal = at @ at.T + 1e-9 * np.eye(3)
        level, north, east = np.linalg.solve(normal, at @ self.grid.depth_m[i, j])
        rows, columns = (np.arange(n) for n in self.known.shape)
        by_row = level + north * (rows - i.mean())
        return np.asarray(by_row[:, None] + east * (columns - j.mean()))

    def charged(self, map_m2: float, difference_m2: float) -> "Layer":
        """Return the layer with more variance of its map, and of differences besides."""
        return dataclasses.replace(
            self,
            map_m2=self.map_m2 + map_m2 * self.known,
            noise_m2=self.noise_m2 + (map_m2 + difference_m2) * self.known,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorSurface:
    """Residual error over lattice shifts (K,), (L,): what to add to the query's coordinates.

    residual_m2 is E with the depth offset taken out, inf where overlap_cells <= N_T; noise_m2 is
    what the layers' noise alone would make of it; depth_offset_m is the reference's depth less the
    query's; (K, L).
    """

    north_m: Array
    east_m: Array
    overlap_cells: Array
    residual_m2: Array
    noise_m2: Array
    depth_offset_m: Array

    @property
    def misfit(self) -> Array:
        """E in units of the noise, inf where there is no overlap; (K, L)."""
        return self.residual_m2 / self.noise_m2

    def window(self, north: slice, east: slice) -> "ErrorSurface":
        """Return a rectangle of it."""
        return ErrorSurface(
            north_m=self.north_m[north],
            east_m=self.east_m[east],
            overlap_cells=self.overlap_cells[north, east],
            residual_m2=self.residual_m2[north, east],
            noise_m2=self.noise_m2[north, east],
            depth_offset_m=self.depth_offset_m[north, east],
        )

    def around(self, centre_m: Array, half_m: Array) -> "ErrorSurface | None":
        """Return the shifts no farther than half_m (2,) from a centre (2,), None if they are few.

        Two along each axis are the least of which a surface is made.
        """
        north = np.flatnonzero(np.abs(self.north_m - centre_m[0]) <= half_m[0])
        east = np.flatnonzero(np.abs(self.east_m - centre_m[1]) <= half_m[1])
        if north.size < 2 or east.size < 2:
            return None
        return self.window(slice(north[0], north[-1] + 1), slice(east[0], east[-1] + 1))

    def squares_from(self, mean_m: Array, covariance_m2: Array) -> Array:
        """Return squared distances (K, L) of the shifts from a mean, in units of a covariance."""
        north, east = self.north_m - mean_m[0], self.east_m - mean_m[1]
        inverse = np.linalg.inv(covariance_m2)
        return np.asarray(
            inverse[0, 0] * north[:, None] ** 2
            + 2.0 * inverse[0, 1] * north[:, None] * east[None, :]
            + inverse[1, 1] * east[None, :] ** 2
        )


def prepare(grid: GriddedSubmap) -> Layer | None:
    """Return the grid cropped to its known cells, or None if no cell is known.

    The variance of a reconstruction (Eq. 6) includes sigma^2 of the soundings, alike everywhere;
    the map is better than that by its least value.
    """
    known = np.isfinite(grid.depth_m) & np.isfinite(grid.variance_m2)
    rows, cols = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    if not rows.size:
        return None
    box = (slice(rows[0], rows[-1] + 1), slice(cols[0], cols[-1] + 1))
    known, depth_m, variance_m2 = known[box], grid.depth_m[box], grid.variance_m2[box]
    cropped = dataclasses.replace(
        grid,
        north0_m=grid.north0_m + float(rows[0]) * grid.cell_m,
        east0_m=grid.east0_m + float(cols[0]) * grid.cell_m,
        depth_m=np.where(known, depth_m, np.nan),
        variance_m2=np.where(known, variance_m2, np.nan),
        time_s=_filled(grid.time_s[box]),
    )
    mask, map_m2 = known.astype(np.float64), np.where(known, variance_m2, 0.0)
    weight = mask
    if grid.reconstructed:
        weight, map_m2 = mask * np.exp(-map_m2), map_m2 - mask * map_m2[known].min()
    return Layer(grid=cropped, known=mask, weight=weight, map_m2=map_m2, noise_m2=map_m2)


def _filled(time_s: Array) -> Array:
    """Return times with the mean where unknown: a cell whose time was lost still has a depth."""
    known = np.isfinite(time_s)
    return np.where(known, time_s, time_s[known].mean() if known.any() else 0.0)


def mean_slope2(grid: GriddedSubmap) -> float:
    """Return the mean squared slope per axis, free of the cells' noise.

    A product of differences that share no cell: noise is independent, relief is not.
    """
    products = []
    for values in (grid.depth_m, grid.depth_m.T):
        difference = np.diff(values, axis=0)
        product = difference[:-2] * difference[2:]
        products.append(product[np.isfinite(product)])
    both = np.concatenate(products)
    return max(float(both.mean()) / grid.cell_m**2, 0.0) if both.size else 0.0


def error_surface(
    reference: Layer, query: Layer, minimum_cells: float, offset_ridge_cells: float
) -> ErrorSurface:
    """Return E at every lattice shift with any overlap.

    offset_ridge_cells is the noise variance over the variance of the depth offset's prior: inf
    leaves no offset (the paper's reading), zero takes the whole mean difference out.
    """
    datum_m = float(np.nanmean(reference.grid.depth_m))
    stack_r = _moments(reference, datum_m)
    stack_q = _moments(query, datum_m)[:, ::-1, ::-1]  # a correlation is a convolution with that
    rows, cols = reference.known.shape
    query_rows, query_cols = query.known.shape
    full = (rows + query_rows - 1, cols + query_cols - 1)
    size = tuple(fft.next_fast_len(n, real=True) for n in full)
    f_r = fft.rfft2(stack_r, s=size)
    f_q = fft.rfft2(stack_q, s=size)
    spectra = np.stack(
        [
            f_r[0] * f_q[0],
            f_r[1] * f_q[1],
            f_r[2] * f_q[1] - f_r[1] * f_q[2],
            f_r[3] * f_q[1] - 2.0 * f_r[2] * f_q[2] + f_r[1] * f_q[3],
            f_r[4] * f_q[0] + f_r[0] * f_q[4],
        ]
    )
    sums = fft.irfft2(spectra, s=size)[:, : full[0], : full[1]]
    count, weight, first, second, noise = sums
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
        noise_m2=np.maximum(noise / np.maximum(count, 1.0), 1e-9),
        depth_offset_m=offset,
    )


def _moments(layer: Layer, datum_m: float) -> Array:
    """Return mask, weight, weighted depth, its square and the noise, zero where unknown."""
    depth = np.where(layer.known > 0, layer.grid.depth_m - datum_m, 0.0)
    weighted = layer.weight * depth
    return np.stack([layer.known, layer.weight, weighted, weighted * depth, layer.noise_m2])


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
    at = land(reference.grid, query.grid, shift_m)
    if at is None:
        return np.inf, 0, 0.0
    depth, mass = sample(np.stack([reference.grid.depth_m, reference.weight]), at)
    difference = depth - query.grid.depth_m[at.query]
    weight = query.weight[at.query] * mass
    both = np.isfinite(difference) & (weight > 0)
    count = int(both.sum())
    if count <= minimum_cells:
        return np.inf, count, 0.0
    d, w = difference[both], weight[both]
    offset = float((w @ d) / (w.sum() + offset_ridge_cells))
    norm = np.abs(d - offset) if absolute else (d - offset) ** 2
    return float(w @ norm) / count, count, offset


@dataclass(frozen=True, slots=True, kw_only=True)
class Landing:
    """Where a shifted lattice lies on another: one fraction of a cell for all of its cells.

    query is the rectangle of the query that meets the reference; row and col are the reference's
    indices under its first cell, north and east the fractions beyond them.
    """

    query: tuple[slice, slice]
    row: int
    col: int
    north: float
    east: float


def land(reference: GriddedSubmap, query: GriddedSubmap, shift_m: Array) -> Landing | None:
    """Return where the shifted query lies on the reference, None if they do not meet."""
    row = (query.north0_m + shift_m[0] - reference.north0_m) / query.cell_m
    col = (query.east0_m + shift_m[1] - reference.east0_m) / query.cell_m
    if not np.isfinite(row) or not np.isfinite(col):
        return None
    (i, north), (j, east) = _split(float(row)), _split(float(col))
    rows, cols = reference.depth_m.shape
    query_rows, query_cols = query.depth_m.shape
    first_row, first_col = max(0, -i), max(0, -j)
    last_row = min(query_rows, rows - i - (north > 0.0))
    last_col = min(query_cols, cols - j - (east > 0.0))
    if last_row <= first_row or last_col <= first_col:
        return None
    return Landing(
        query=(slice(first_row, last_row), slice(first_col, last_col)),
        row=i + first_row,
        col=j + first_col,
        north=north,
        east=east,
    )


def sample(fields: Array, at: Landing) -> Array:
    """Return the fields (..., R, C) of the reference under the landed rectangle, bilinear.

    NaN next to unknown cells, unless their weight is zero: a shift by whole cells returns the
    cells themselves.
    """
    rows = at.query[0].stop - at.query[0].start
    cols = at.query[1].stop - at.query[1].start
    total = np.zeros((*fields.shape[:-2], rows, cols))
    for down, weight_n in ((0, 1.0 - at.north), (1, at.north)):
        for right, weight_e in ((0, 1.0 - at.east), (1, at.east)):
            if weight_n * weight_e > 0.0:
                i, j = at.row + down, at.col + right
                total += weight_n * weight_e * fields[..., i : i + rows, j : j + cols]
    return total


def _split(index: float) -> tuple[int, float]:
    """Return whole and fraction, rounding noise removed so that lattice shifts stay whole."""
    near = round(index)
    if abs(index - near) < 1e-7:
        return near, 0.0
    whole = int(np.floor(index))
    return whole, index - whole
