"""Terrain files: opened with rasterio, or a built-in seeded relief."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray
from rasterio.crs import CRS
from rasterio.errors import RasterioError
from rasterio.windows import Window

from protocol.errors import ConfigError

BUILT_IN = "built-in relief"
BUILT_IN_EPSG = 32631
BUILT_IN_CELL_M = 5.0
BUILT_IN_CELLS = 600
COARSE_CELLS = 4_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Raster:
    """A north-up grid of elevations in a projected system in metres; row 0 is the northernmost.

    `read` may be asked for any window; `coarse_m` (R, C) is the whole grid thinned for planning,
    NaN where there is no data, and `coarse_step` says by how many cells.
    """

    name: str
    path: Path | None
    crs_wkt: str
    transform: Affine
    rows: int
    columns: int
    coarse_m: NDArray[np.float32]
    coarse_step: int
    positive_down: bool
    relief_m: NDArray[np.float32] | None = None

    @property
    def cell_east_m(self) -> float:
        """Cell size along a row."""
        return float(self.transform.a)

    @property
    def cell_north_m(self) -> float:
        """Cell size along a column."""
        return float(-self.transform.e)

    def read(
        self, first_row: int, first_column: int, rows: int, columns: int
    ) -> NDArray[np.float32]:
        """Return elevations (rows, columns), up positive, NaN where there is no data."""
        if self.relief_m is not None:
            return self.relief_m[
                first_row : first_row + rows, first_column : first_column + columns
            ]
        with rasterio.open(self.path) as dataset:
            window = Window(first_column, first_row, columns, rows)
            return _clean(dataset.read(1, window=window, masked=True), self.positive_down)


def open_terrain(path: Path | None, relief_seed: int = 1) -> Raster:
    """Return the raster of a file, or the built-in relief when there is none.

    A grid whose median is above zero is taken to hold depths, positive down.

    Raises
    ------
    ConfigError
        When the file is not a raster, has no projected system in metres, or holds no data.
    """
    if path is None:
        return _built_in(relief_seed)
    if not path.is_file():
        raise ConfigError(f"terrain {path} is not a file; give a GeoTIFF, a BAG or another raster")
    try:
        with rasterio.open(path) as dataset:
            _check_reference(path, dataset.crs, dataset.transform, dataset.count)
            step = max(1, int(np.ceil(np.sqrt(dataset.width * dataset.height / COARSE_CELLS))))
            shape = (max(1, dataset.height // step), max(1, dataset.width // step))
            thinned = dataset.read(1, masked=True, out_shape=shape)
            elevation_m = _clean(thinned, positive_down=False)
            known = np.isfinite(elevation_m)
            if not known.any():
                raise ConfigError(f"terrain {path} holds no data: every cell is no-data")
            positive_down = bool(np.median(elevation_m[known]) > 0.0)
            return Raster(
                name=path.name,
                path=path,
                crs_wkt=dataset.crs.to_wkt(),
                transform=dataset.transform,
                rows=dataset.height,
                columns=dataset.width,
                coarse_m=-elevation_m if positive_down else elevation_m,
                coarse_step=step,
                positive_down=positive_down,
            )
    except RasterioError as error:
        raise ConfigError(f"terrain {path} cannot be read as a raster: {error}") from error


def _check_reference(path: Path, crs: CRS | None, transform: Affine, bands: int) -> None:
    wanted = "reproject it to a metric projection such as UTM (gdalwarp -t_srs EPSG:326xx)"
    if bands < 1:
        raise ConfigError(f"terrain {path} has no raster band")
    if crs is None:
        raise ConfigError(f"terrain {path} has no coordinate reference system; {wanted}")
    if not crs.is_projected:
        raise ConfigError(f"terrain {path} is not in a projected system ({crs}); {wanted}")
    if abs(crs.linear_units_factor[1] - 1.0) > 1e-9:
        raise ConfigError(f"terrain {path} is in {crs.linear_units}, not in metres; {wanted}")
    if transform.b or transform.d or transform.a <= 0 or transform.e >= 0:
        raise ConfigError(f"terrain {path} is not a north-up grid; rotate it with gdalwarp")


def _clean(grid: NDArray[np.generic], positive_down: bool) -> NDArray[np.float32]:
    elevation_m = np.ma.filled(np.ma.asarray(grid).astype(np.float32), np.nan)
    # Nothing on Earth is farther from the sea's surface: undeclared no-data values.
    elevation_m[~(np.abs(elevation_m) < 12_000.0)] = np.nan
    cleaned: NDArray[np.float32] = -elevation_m if positive_down else elevation_m
    return cleaned


def _built_in(seed: int) -> Raster:
    """Return a relief whose spectrum falls with the cube of the wave number, 25 m deep."""
    rng = np.random.default_rng([seed, 0x5EAB])
    size = BUILT_IN_CELLS
    wave = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None, :])
    wave[0, 0] = np.inf
    amplitude = np.where(wave > 1.0 / size, wave, 1.0 / size) ** -1.5
    amplitude[~np.isfinite(wave)] = 0.0
    spectrum = amplitude * np.exp(2j * np.pi * rng.random(wave.shape))
    relief_m = np.fft.irfft2(spectrum, s=(size, size))
    elevation_m = (-25.0 + 4.0 * relief_m / relief_m.std()).astype(np.float32)
    return Raster(
        name=f"{BUILT_IN} {seed}",
        path=None,
        crs_wkt=CRS.from_epsg(BUILT_IN_EPSG).to_wkt(),
        transform=Affine(BUILT_IN_CELL_M, 0.0, 500_000.0, 0.0, -BUILT_IN_CELL_M, 4_600_000.0),
        rows=size,
        columns=size,
        coarse_m=elevation_m,
        coarse_step=1,
        positive_down=False,
        relief_m=elevation_m,
    )
