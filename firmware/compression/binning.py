"""Soundings thinned to cells as they stream in: bounded memory, robust to fliers.

Each occupied cell keeps its first few soundings and, from then on, sums over the soundings near
their median. Memory depends on the area measured, never on the number of soundings; when the cap
of cells is reached the cell doubles. Fliers are thrown out against the cell's neighbourhood when
the result is taken, so a lone wild sounding in an empty cell goes as well.
"""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from firmware.compression.settings import BinningSettings
from firmware.geometry import Array
from firmware.submaps import BinnedSoundings

D = TypeVar("D", bound=np.generic)
_ROW_STRIDE = 1 << 31  # cells per key row: 2 million km at 1 m
_CHUNK = 1 << 12  # soundings gathered before they are sorted in: 20 pings, 4 ms
_SIGMA_PER_MAD = 1.4826
_LONE_SHARE = 0.1  # of the usual soundings in 5 x 5 cells; an edge of the swath has twice that
_SMALLEST_SIGMA_M = 0.02  # a noise-free bottom must not gate its own slope away


class SoundingBins:
    """Builds `BinnedSoundings` from any number of soundings in memory that depends on area only."""

    def __init__(self, settings: BinningSettings | None = None) -> None:
        self._settings = settings or BinningSettings()
        self.reset()

    def reset(self) -> None:
        """Forget all soundings; keep the settings."""
        self._cell_m = self._settings.cell_m
        self._keys: NDArray[np.int64] = np.empty(0, dtype=np.int64)
        # per cell: sums of d, d^2 (about its reference), n, north, east and time
        self._sums: Array = np.empty((0, 6))
        self._reference_m: Array = np.empty(0)
        self._held: NDArray[np.float32] = np.empty((0, self._settings.reservoir), dtype=np.float32)
        self._filled: NDArray[np.int64] = np.empty(0, dtype=np.int64)
        self._waiting = np.empty((4, _CHUNK))  # north, east, depth and time
        self._waiting_count = 0
        self._sigma_m = np.inf  # gate of the sums, known once reservoirs fill
        self.dropped_bad = 0
        self.dropped_fliers = 0  # as of the last result
        self._late_fliers = 0
        self.soundings = 0

    def add(self, soundings_ned_m: Array, time_s: Array | float) -> None:
        """Take soundings (N, 3) as north, east, depth, measured at time_s (N,) or one time."""
        soundings_ned_m = np.asarray(soundings_ned_m, dtype=np.float64).reshape(-1, 3)
        times_s = np.broadcast_to(np.asarray(time_s, dtype=np.float64), len(soundings_ned_m))
        start = 0
        while start < len(soundings_ned_m):
            first = self._waiting_count
            taken = min(_CHUNK - first, len(soundings_ned_m) - start)
            part = self._waiting[:, first : first + taken]
            part[:3] = soundings_ned_m[start : start + taken].T
            part[3] = times_s[start : start + taken]
            self._waiting_count += taken
            start += taken
            if self._waiting_count == _CHUNK:
                self._sort_in()

    def _sort_in(self) -> None:
        chunk, self._waiting_count = self._waiting[:, : self._waiting_count], 0
        limit_m = self._cell_m * (_ROW_STRIDE // 4)
        good = (np.abs(chunk[:3]) < limit_m).all(axis=0) & np.isfinite(chunk[3])
        self.dropped_bad += int(good.size - np.count_nonzero(good))
        chunk = chunk[:, good]
        if not chunk.size:
            return
        self.soundings += chunk.shape[1]
        keys, chunk = _ordered(_keys_of(chunk[0], chunk[1], self._cell_m), chunk)
        first = np.flatnonzero(_is_first(keys))
        self._make_room(keys[first], chunk[2, first])
        while self._keys.size > self._settings.max_cells:
            self._coarsen()
            keys, chunk = _ordered(_halved(keys), chunk)
        self._accumulate(keys, chunk)

    def _make_room(self, keys: NDArray[np.int64], depth_m: Array) -> None:
        """Make cells of the keys, ascending, that have none yet, each about its first depth."""
        at = np.searchsorted(self._keys, keys)
        is_new = np.append(self._keys, -1)[at] != keys
        if not is_new.any():
            return
        merged = np.insert(self._keys, at[is_new], keys[is_new])
        old = np.searchsorted(merged, self._keys)
        self._sums = _scattered(self._sums, old, merged.size, 0.0)
        self._reference_m = np.insert(self._reference_m, at[is_new], depth_m[is_new])
        self._held = _scattered(self._held, old, merged.size, np.nan)
        self._filled = _scattered(self._filled, old, merged.size, 0)
        self._keys = merged

    def _accumulate(self, keys: NDArray[np.int64], chunk: Array) -> None:
        """Add sorted soundings to their cells: into the reservoir while it fills, then the sums."""
        north_m, east_m, depth_m, time_s = chunk
        first = np.flatnonzero(_is_first(keys))
        cells, counts = np.searchsorted(self._keys, keys[first]), np.diff(first, append=keys.size)
        rows = np.repeat(cells, counts)
        offset_m = depth_m - self._reference_m[rows]
        slot = np.arange(keys.size) + np.repeat(self._filled[cells] - first, counts)
        held = slot < self._settings.reservoir
        self._held[rows[held], slot[held]] = offset_m[held]
        self._filled[cells] = np.minimum(self._filled[cells] + counts, self._settings.reservoir)
        summed = ~held
        if summed.any():
            if not np.isfinite(self._sigma_m):
                self._sigma_m = self._noise_m()
            late = np.flatnonzero(summed)
            centre_m = _median(self._held[rows[late]], self._filled[rows[late]])
            gate_m = 2.0 * self._settings.flier_gate * self._sigma_m
            summed[late] = np.abs(offset_m[late] - centre_m) <= gate_m
            self._late_fliers += late.size - int(np.count_nonzero(summed))
        values = (offset_m, offset_m**2, np.ones_like(offset_m), north_m, east_m, time_s)
        run = np.repeat(np.arange(cells.size), counts)
        for these, lowest in ((summed, 0), (held, 3)):  # depths of held ones come later
            for column in range(lowest, 6):
                self._sums[cells, column] += np.bincount(run, these * values[column])

    def _noise_m(self) -> float:
        """Return the robust spread of a sounding, from the first two of each cell."""
        if self._held.shape[1] < 2 or not (self._filled >= 2).any():
            return 1.0
        pairs = self._held[self._filled >= 2, :2]
        apart_m = np.abs(pairs[:, 1] - pairs[:, 0])
        sigma_m = _SIGMA_PER_MAD * float(np.median(apart_m)) / float(np.sqrt(2.0))
        return max(sigma_m, _SMALLEST_SIGMA_M)

    def _coarsen(self) -> None:
        """Double the cell; each new cell keeps the soundings first held by its parts."""
        self._cell_m *= 2.0
        keys = _halved(self._keys)
        order = np.argsort(keys, kind="stable")
        new, first, inverse = np.unique(keys[order], return_index=True, return_inverse=True)
        reference_m = self._reference_m[order][first]
        shift_m = self._reference_m[order] - reference_m[inverse]
        sums = self._sums[order]
        count = sums[:, 2]
        sums[:, 1] += 2.0 * shift_m * sums[:, 0] + count * shift_m**2
        sums[:, 0] += count * shift_m
        self._sums = np.add.reduceat(sums, first, axis=0)
        offsets_m = (self._held[order] + shift_m[:, None]).ravel()
        rows = np.repeat(inverse, self._held.shape[1])
        rows, offsets_m = rows[np.isfinite(offsets_m)], offsets_m[np.isfinite(offsets_m)]
        rank = _rank(rows)
        kept = rank < self._held.shape[1]
        self._held = np.full((new.size, self._held.shape[1]), np.nan, dtype=np.float32)
        self._held[rows[kept], rank[kept]] = offsets_m[kept]
        self._filled = np.bincount(rows[kept], minlength=new.size)
        rows, offsets_m = rows[~kept], offsets_m[~kept]
        for column, values in enumerate((offsets_m, offsets_m**2, np.ones_like(offsets_m))):
            self._sums[:, column] += np.bincount(rows, values, new.size)
        self._keys, self._reference_m = new, reference_m

    def result(self) -> BinnedSoundings:
        """Return the mean of each cell without fliers; cells of fliers alone are left out."""
        self._sort_in()
        if not self._keys.size:
            empty = np.empty(0)
            return BinnedSoundings(
                cell_m=self._cell_m,
                north_m=empty,
                east_m=empty,
                depth_m=empty,
                variance_m2=empty,
                count=empty,
                time_s=empty,
            )
        sigma_m = self._noise_m()
        held_m = self._held + self._reference_m[:, None]
        begin, end = self._around()
        centre_m, spread_m = self._neighbourhood(held_m, sigma_m, begin, end)
        gate_m = self._settings.flier_gate * np.hypot(spread_m, sigma_m)
        with np.errstate(invalid="ignore"):
            near = np.abs(held_m - centre_m[:, None]) <= gate_m[:, None]
        fliers = self._late_fliers + int(np.count_nonzero(np.isfinite(held_m) & ~near))
        sums_near = (
            np.abs(
                self._reference_m + self._sums[:, 0] / np.maximum(self._sums[:, 2], 1.0) - centre_m
            )
            <= gate_m
        )
        offset = np.where(near, self._held.astype(np.float64), 0.0)
        n_sums = np.where(sums_near, self._sums[:, 2], 0.0)
        count: Array = near.sum(axis=1).astype(np.float64) + n_sums
        total = offset.sum(axis=1) + np.where(sums_near, self._sums[:, 0], 0.0)
        squares = (offset**2).sum(axis=1) + np.where(sums_near, self._sums[:, 1], 0.0)
        placed = self._filled + self._sums[:, 2]
        lone = _lone(placed, begin, end)
        self.dropped_fliers = fliers + int(count[lone].sum())
        kept = (count > 0) & ~lone
        count = np.maximum(count, 1.0)
        mean = total / count
        within = np.maximum(squares - count * mean**2, 0.0)
        variance = (within + 4.0 * sigma_m**2) / (count + 3.0) / count
        return BinnedSoundings(
            cell_m=self._cell_m,
            north_m=(self._sums[:, 3] / placed)[kept],
            east_m=(self._sums[:, 4] / placed)[kept],
            depth_m=(mean + self._reference_m)[kept],
            variance_m2=variance[kept],
            count=count[kept],
            time_s=(self._sums[:, 5] / placed)[kept],
        )

    def _around(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return where in the keys the 5 x 5 cells around each begin and end, row by row (5, K)."""
        lowest = self._keys + np.arange(-2, 3)[:, None] * _ROW_STRIDE - 2
        return np.searchsorted(self._keys, lowest), np.searchsorted(self._keys, lowest + 5)

    def _neighbourhood(
        self, held_m: Array, sigma_m: float, begin: NDArray[np.intp], end: NDArray[np.intp]
    ) -> tuple[Array, Array]:
        """Return the median and robust spread of the cell medians in the 5 x 5 cells around."""
        median_m = _median(held_m, self._filled)
        count = (end - begin).sum(axis=0)
        centre_m, spread_m = np.empty(count.size), np.empty(count.size)
        for start in range(0, count.size, _CHUNK):
            part = slice(start, start + _CHUNK)
            rows = begin[:, part, None] + np.arange(5)
            inside = rows < end[:, part, None]
            around = np.where(inside, median_m.take(rows, mode="clip"), np.nan)
            around = np.concatenate(around, axis=1)
            centre_m[part] = _median(around, count[part])
            apart_m = np.abs(around - centre_m[part, None])
            spread_m[part] = _SIGMA_PER_MAD * _median(apart_m, count[part])
        few = count < 4
        spread_m[few] = np.maximum(spread_m[few], 2.0 * sigma_m)
        return centre_m, spread_m


def coarsened(bins: BinnedSoundings, cell_m: float) -> BinnedSoundings:
    """Return the bins gathered into cells of about cell_m; unchanged if they are as coarse."""
    if bins.cell_m >= 0.75 * cell_m or not bins.north_m.size:
        return bins
    keys = _keys_of(bins.north_m, bins.east_m, cell_m)
    _, inverse = np.unique(keys, return_inverse=True)
    count = np.bincount(inverse, bins.count).astype(np.float64)

    def mean(values: Array) -> Array:
        return np.bincount(inverse, bins.count * values) / count

    depth_m = mean(bins.depth_m)
    noise = np.bincount(inverse, bins.count**2 * bins.variance_m2) / count**2
    return BinnedSoundings(
        cell_m=cell_m,
        north_m=mean(bins.north_m),
        east_m=mean(bins.east_m),
        depth_m=depth_m,
        variance_m2=noise,
        count=count,
        time_s=mean(bins.time_s),
    )


def _keys_of(north_m: Array, east_m: Array, cell_m: float) -> NDArray[np.int64]:
    row, column = (
        np.floor(along_m / cell_m).astype(np.int64) + _ROW_STRIDE // 2
        for along_m in (north_m, east_m)
    )
    return row * _ROW_STRIDE + column


def _ordered(keys: NDArray[np.int64], chunk: Array) -> tuple[NDArray[np.int64], Array]:
    order = np.argsort(keys, kind="stable")
    return keys[order], chunk[:, order]


def _halved(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    half = _ROW_STRIDE // 2
    rows, columns = keys // _ROW_STRIDE - half, keys % _ROW_STRIDE - half
    return (rows // 2 + half) * _ROW_STRIDE + columns // 2 + half


def _rank(rows: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return 0, 1, 2 ... within each run of equal values."""
    first = np.flatnonzero(_is_first(rows))
    return np.arange(rows.size) - np.repeat(first, np.diff(np.r_[first, rows.size]))


def _is_first(ordered: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Return which of the ascending values differ from the one before."""
    return np.asarray(np.diff(ordered, prepend=ordered[:1] - 1) != 0)


def _median(values: NDArray[D], count: NDArray[np.intp]) -> Array:
    """Return the median of each row, of which all but so many numbers are NaN."""
    ordered = np.sort(values, axis=1)  # NaN last
    row = np.arange(len(ordered))
    middle: Array = 0.5 * (ordered[row, (count - 1) // 2] + ordered[row, count // 2])
    return middle


def _lone(placed: Array, begin: NDArray[np.intp], end: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return which cells lie almost alone: long echoes fall beyond the swath, cell by cell."""
    total = np.append(0.0, np.cumsum(placed))
    crowd = (total[end] - total[begin]).sum(axis=0)
    return np.asarray(crowd < _LONE_SHARE * np.median(crowd))


def _scattered(values: NDArray[D], where: NDArray[np.intp], size: int, fill: float) -> NDArray[D]:
    out = np.full((size, *values.shape[1:]), fill, dtype=values.dtype)
    out[where] = values
    return out
