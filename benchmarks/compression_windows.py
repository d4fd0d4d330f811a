"""Patches of seabed, made and real, and the soundings of forty seconds over them."""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates, zoom
from scipy.spatial import Delaunay

from firmware.compression.binning import SoundingBins
from firmware.geometry import Array
from firmware.submaps import BinnedSoundings, Track

ALTITUDE_M = 40.0
SPEED_MPS = 2.06  # 4 kn
PINGS, BEAMS = 160, 192
NORTH_M, EAST_M = 110.0, 190.0  # of a patch; the swath covers 82 x 139 m of it
OCTREE_LEAVES = 200
REAL = {
    "ripples": ("portsmouth_ripples_50cm.bag", True),
    "massbay": ("massbay_west_5m.tif", False),
    "medes": ("medes_islands_10m.tif", False),
    "shelf": ("flat_shelf_2m.bag", False),
}
"""Files, and whether a patch is taken only as it is; of coarser ones the relief is scaled, too."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """A patch with its soundings (N, 3), and the truth on a 1 m grid inside their hull."""

    name: str
    smooth: bool
    soundings_ned_m: Array
    time_s: Array
    bins: BinnedSoundings
    track: Track
    grid_m: Array  # (P, 2)
    true_m: Array  # (P,)
    depth_of: Callable[[Array], Array]


def windows(per_site: int, seed: int) -> Iterator[Window]:
    """Yield synthetic windows, then real ones when FATHOMLINK_DATA is set."""
    rng = np.random.default_rng(seed)
    for number in range(per_site):
        for slope in (2.5, 3.0, 3.5):
            yield _window(f"fractal-{slope}", _scaled(_fractal(rng, slope), 0.5), 0.5, rng, number)
        yield _window("rocks", _scaled(_rocks(rng), 0.5), 0.5, rng, number)
    data = os.environ.get("FATHOMLINK_DATA")
    if data is None:
        return
    for name, (file, as_is) in REAL.items():
        path = Path(data) / "terrain" / file
        for number, (relief_m, cell_m) in enumerate(_patches(path, per_site, rng)):
            if as_is:
                yield _window(name, relief_m, cell_m, rng, number)
                continue
            yield _window(f"{name}-scaled", _scaled(relief_m, cell_m), cell_m, rng, number)
            yield _window(f"{name}-smooth", relief_m, cell_m, rng, number, smooth=True)


def _window(
    name: str,
    relief_m: Array,
    cell_m: float,
    rng: np.random.Generator,
    number: int,
    smooth: bool = False,
) -> Window:
    depth_of = _surface(relief_m, cell_m)
    soundings_ned_m, time_s = _soundings(depth_of, rng)
    bins = SoundingBins()
    bins.add(soundings_ned_m, time_s)
    low, high = soundings_ned_m[:, :2].min(axis=0), soundings_ned_m[:, :2].max(axis=0)
    axes = [np.arange(np.ceil(low[i]), high[i]) for i in range(2)]
    grid_m = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    grid_m = grid_m[Delaunay(soundings_ned_m[::5, :2]).find_simplex(grid_m) >= 0]
    seconds = np.arange(40.0)
    return Window(
        name=f"{name}-{number}",
        smooth=smooth,
        soundings_ned_m=soundings_ned_m,
        time_s=time_s,
        bins=bins.result(),
        track=Track(
            time_s=seconds,
            north_m=SPEED_MPS * (seconds - 20.0),
            east_m=np.zeros(40),
            yaw_rad=np.zeros(40),
        ),
        grid_m=grid_m,
        true_m=depth_of(grid_m),
        depth_of=depth_of,
    )


def _surface(relief_m: Array, cell_m: float) -> Callable[[Array], Array]:
    middle = (np.array(relief_m.shape) - 1.0) / 2.0

    def depth_of(position_m: Array) -> Array:
        where = position_m.T / cell_m + middle[:, None]
        return np.asarray(
            ALTITUDE_M + map_coordinates(relief_m - relief_m.mean(), where, order=1, mode="nearest")
        )

    return depth_of


def _soundings(depth_of: Callable[[Array], Array], rng: np.random.Generator) -> tuple[Array, Array]:
    """Return soundings with 0.15 m and 0.3 % of the slant range of noise, and their times."""
    time_s = np.repeat(np.arange(PINGS) / 4.0, BEAMS)
    angle = np.tile(np.deg2rad(np.linspace(-60.0, 60.0, BEAMS)), PINGS)
    north_m = SPEED_MPS * (time_s - 20.0)
    range_m = ALTITUDE_M / np.cos(angle)
    for _ in range(20):
        below_m = depth_of(np.column_stack([north_m, range_m * np.sin(angle)]))
        range_m = 0.5 * range_m + 0.5 * below_m / np.cos(angle)
    range_m = range_m + rng.normal(size=range_m.size) * _range_sigma_m(range_m)
    east_m, depth_m = range_m * np.sin(angle), range_m * np.cos(angle)
    return np.column_stack([north_m, east_m, depth_m]), time_s


def _range_sigma_m(range_m: Array) -> Array:
    return np.hypot(0.15, 0.003 * range_m)


def noise_variance_m2(soundings_ned_m: Array) -> Array:
    """Return the variance of depth (N,) of soundings from the track, which runs along east = 0."""
    range_m = np.hypot(soundings_ned_m[:, 1], soundings_ned_m[:, 2])
    out: Array = (_range_sigma_m(range_m) * soundings_ned_m[:, 2] / range_m) ** 2
    return out


def _fractal(rng: np.random.Generator, slope: float, cell_m: float = 0.5) -> Array:
    """Return relief whose spectral density falls with this power, level above 120 m."""
    shape = (int(NORTH_M / cell_m) + 1, int(EAST_M / cell_m) + 1)
    size = 512
    k = np.fft.fftfreq(size, cell_m)
    radius = np.maximum(np.hypot(k[:, None], k[None, :]), 1.0 / 120.0)
    noise = np.fft.fft2(rng.normal(size=(size, size)))
    return np.asarray(np.fft.ifft2(noise * radius ** (-slope / 2.0)).real[: shape[0], : shape[1]])


def _rocks(rng: np.random.Generator, cell_m: float = 0.5) -> Array:
    """Return smooth sediment with boulders on its western part."""
    relief_m = _fractal(rng, 3.5, cell_m)
    relief_m *= 0.2 / relief_m.std()
    north, east = (cell_m * np.arange(n) for n in relief_m.shape)
    for _ in range(200):
        at_m = rng.uniform([0.0, 0.0], [NORTH_M, 0.6 * EAST_M])
        size_m, height_m = rng.uniform(1.5, 6.0), rng.uniform(0.3, 1.0)
        bump = np.exp(-0.5 * ((north - at_m[0]) / size_m) ** 2)[:, None]
        relief_m -= height_m * bump * np.exp(-0.5 * ((east - at_m[1]) / size_m) ** 2)[None, :]
    return relief_m


def _patches(path: Path, count: int, rng: np.random.Generator) -> Iterator[tuple[Array, float]]:
    """Yield random patches without gaps as depth (rows, columns), at 1 m or finer."""
    import rasterio  # noqa: PLC0415  slow, and only for real windows

    with rasterio.open(path) as source:
        elevation_m = source.read(1).astype(np.float64)
        cell_m = float(abs(source.res[0]))
        if source.nodata is not None:
            elevation_m[elevation_m == source.nodata] = np.nan
    elevation_m[np.abs(elevation_m) > 1e5] = np.nan
    side = [int(np.ceil(length / cell_m)) + 2 for length in (NORTH_M, EAST_M)]
    found = 0
    for _ in range(20_000):
        if found == count:
            return
        row = rng.integers(0, elevation_m.shape[0] - side[0])
        column = rng.integers(0, elevation_m.shape[1] - side[1])
        patch = -elevation_m[row : row + side[0], column : column + side[1]]
        if not np.isfinite(patch).all() or np.ptp(patch) == 0.0:
            continue
        found += 1
        finer = max(1, round(cell_m))
        yield zoom(patch, finer, order=3) if finer > 1 else patch, cell_m / finer


def _scaled(relief_m: Array, cell_m: float) -> Array:
    """Return the relief times what makes the octree of its soundings' area need 200 leaves."""
    rows, columns = (int(length / cell_m) for length in (82.0, 139.0))
    top = (relief_m.shape[0] - rows) // 2, (relief_m.shape[1] - columns) // 2
    area_m = relief_m[top[0] : top[0] + rows, top[1] : top[1] + columns]
    low, high = 1e-3, 1e3
    for _ in range(30):
        middle = float(np.sqrt(low * high))
        if _leaves(area_m * middle, cell_m) < OCTREE_LEAVES:
            low = middle
        else:
            high = middle
    return relief_m * low


def _leaves(area_m: Array, cell_m: float) -> int:
    """Count blocks of 2 to 32 m, each split while its depths span more than 1.25 m (paper, 6.1)."""

    def split(row: int, column: int, side: int) -> int:
        block = area_m[row : row + side, column : column + side]
        if block.size == 0:
            return 0
        if np.ptp(block) <= 1.25 or side * cell_m < 4.0:
            return 1
        half = side // 2
        return sum(split(row + i, column + j, half) for i in (0, half) for j in (0, half))

    side = round(32.0 / cell_m)
    starts = [range(0, length, side) for length in area_m.shape]
    return sum(split(row, column, side) for row in starts[0] for column in starts[1])
