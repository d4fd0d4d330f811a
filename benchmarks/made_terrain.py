"""Seabed that is hard to match, made from a seed: figures over it can be made again anywhere.

    python -m benchmarks.made_terrain ridge ridge.tif

writes 1.4 km of it in cells of 5 m. A straight ridge or canyon, or waves with straight crests, look
alike along their whole length; only the faint relief on top says how far along it a place is.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import from_origin

from firmware.geometry import Array
from host_tools.commands import status_of

CELLS, CELL_M = 280, 5.0
_LONGEST_WAVE_M = 600.0
_WEST_M, _NORTH_M, _CRS = 400_000.0, 5_000_000.0, "EPSG:32633"


def ridge() -> Array:
    """Return the elevation of a ridge, 25 m high."""
    return -60.0 + 25.0 * np.exp(-((_aside_m() / 60.0) ** 2)) + relief(3.2, 0.15, seed=25)


def canyon() -> Array:
    """Return the elevation of a canyon, 80 m deep."""
    return -60.0 - 80.0 * np.exp(-((_aside_m() / 150.0) ** 2)) + relief(3.0, 0.4, seed=26)


def straight_waves() -> Array:
    """Return the elevation of sand waves that are alike along their crests, and nothing else."""
    return -30.0 + _waves(60.0)


def gullies() -> Array:
    """Return the elevation of straight gullies, 5 m deep, down a slope of 3 %."""
    east_m, north_m = _positions()
    across_m = 2.5 * np.cos(2.0 * np.pi * east_m / 120.0)
    return -60.0 + 0.03 * north_m + across_m + relief(3.0, 0.1, seed=27)


def sand_waves() -> Array:
    """Return the elevation of sand waves of uneven height on faint relief."""
    uneven = 1.0 + 0.2 * relief(4.0, 1.0, seed=15)
    return -30.0 + _waves(55.0) * uneven + relief(3.0, 0.12, seed=16)


KINDS: dict[str, Callable[[], Array]] = {
    "ridge": ridge,
    "canyon": canyon,
    "straight-waves": straight_waves,
    "gullies": gullies,
    "sand-waves": sand_waves,
}


def relief(power: float, sigma_m: float, seed: int) -> Array:
    """Return relief (R, C) of a sigma, whose spectrum falls with a power of the wave number."""
    rng = np.random.default_rng(seed)
    rows, columns = np.fft.fftfreq(CELLS, CELL_M), np.fft.rfftfreq(CELLS, CELL_M)
    wave = np.hypot(rows[:, None], columns)
    height = np.maximum(wave, 1.0 / _LONGEST_WAVE_M) ** (-power / 2.0)
    height[0, 0] = 0.0
    real, imaginary = (rng.standard_normal(wave.shape) for _ in range(2))
    relief_m = np.fft.irfft2(height * (real + 1j * imaginary), s=(CELLS, CELLS))
    return np.asarray(relief_m / relief_m.std() * sigma_m)


def _positions() -> tuple[Array, Array]:
    """Return east and north (R, C) of the cells from the north-western one, in metres."""
    south, east = np.mgrid[0:CELLS, 0:CELLS] * CELL_M
    return east, -south


def _aside_m() -> Array:
    """Return how far cells (R, C) lie from a line through the middle."""
    east_m, north_m = _positions()
    return np.asarray((east_m - 700.0) * np.cos(0.5) + (north_m + 700.0) * np.sin(0.5))


def _waves(length_m: float) -> Array:
    east_m, north_m = _positions()
    along_m = east_m * np.sin(np.radians(30.0)) + north_m * np.cos(np.radians(30.0))
    return np.asarray(0.8 * np.sin(2.0 * np.pi * along_m / length_m))


def write(path: Path, elevation_m: Array) -> None:
    """Write elevations (R, C), the northernmost row first, as a GeoTIFF."""
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=CELLS,
        width=CELLS,
        count=1,
        dtype="float32",
        crs=_CRS,
        transform=from_origin(_WEST_M, _NORTH_M, CELL_M, CELL_M),
    ) as dataset:
        dataset.write(elevation_m.astype(np.float32), 1)


def main() -> None:
    """Write what the arguments ask for."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.made_terrain", description=__doc__)
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    write(arguments.out, KINDS[arguments.kind]())


if __name__ == "__main__":
    sys.exit(status_of("benchmarks.made_terrain", main))
