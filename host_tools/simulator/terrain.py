"""Terrain files: opened with rasterio, or a built-in seeded relief."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray
from rasterio.crs import CRS
from rasterio.enums import ColorInterp
from rasterio.errors import RasterioError
from rasterio.io import DatasetReader
from rasterio.windows import Window

from protocol.errors import ConfigError
from protocol.packets import DEEPEST_M, HIGHEST_M

BUILT_IN = "built-in relief"
BUILT_IN_EPSG = 32631
BUILT_IN_CELL_M = 5.0
BUILT_IN_CELLS = 600
COARSE_CELLS = 4_000_000
LEAST_OTHER_SIGN_SHARE = 0.1
"""Of a grid that is mostly above zero: with more below it, it may be sea beside higher land."""
MOST_ZEROS_SHARE = 0.01
"""Of a grid that declares no no-data: with more cells of exactly zero, it may mean them by that."""
FILLS = (-9999, 9999, -32768, -32767, 32767, -99999, 99999, -999999)
"""Stored where nothing was measured, though a file may declare another value or none."""
COLOURS = (ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.palette)
OTHER_UNITS = re.compile(
    r"((us|international|survey)[ _-])*(ft|f[eo]{2}t|fathom|yard|inch)"
    r"|[cdmk]m\b|(centi|deci|milli|kilo)met",
    re.I,
)
"""Of heights; names that files have for metres are past counting."""
VERTICAL_UNIT = re.compile(r'VERT_?CR?S\[.*?UNIT\["(.+?)",([\d.eE+-]+)', re.DOTALL)
"""Name and metres of the unit of heights in the text of a compound system."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Raster:
    """A north-up grid of elevations in a projected system in metres; row 0 is the northernmost.

    `read` may be asked for any window; `coarse_m` (R, C) is the whole grid thinned for planning,
    NaN where there is no data. remarks say what was or might be taken for no data though the file
    does not call it so, and that stored depths were turned over.
    """

    name: str
    path: Path | None
    crs_wkt: str
    transform: Affine
    rows: int
    columns: int
    coarse_m: NDArray[np.float32]
    positive_down: bool
    relief_m: NDArray[np.float32] | None = None
    remarks: tuple[str, ...] = ()

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
            values = _values(dataset, dataset.read(1, window=window, masked=True))
            return _elevations(values, self.positive_down)


def open_terrain(path: Path | None, relief_seed: int = 1) -> Raster:
    """Return the raster of a file, or the built-in relief when there is none.

    A grid whose median is above zero is taken to hold depths, positive down, and that is told.

    Raises
    ------
    ConfigError
        When the file is not a raster, has no projected system in metres, or holds no data, or
        what is no heights in metres; when it may hold depths as well as elevations of more land
        than sea.
    """
    if path is None:
        return _built_in(relief_seed)
    if not path.is_file():
        raise ConfigError(
            f"terrain {path} is not a file on disk; give a GeoTIFF, a BAG or another raster, or "
            "convert what it names to one with gdal_translate"
        )
    try:
        with rasterio.open(path) as dataset:
            _check_reference(path, dataset)
            _check_heights(path, dataset)
            step = max(1, int(np.ceil(np.sqrt(dataset.width * dataset.height / COARSE_CELLS))))
            shape = (max(1, dataset.height // step), max(1, dataset.width // step))
            stored = dataset.read(1, masked=True, out_shape=shape)
            values = _values(dataset, stored)
            positive_down = _holds_depths(path, values[np.abs(values) <= DEEPEST_M])
            elevation_m = _elevations(values, positive_down)
            known = np.isfinite(elevation_m)
            if not known.any():
                raise ConfigError(f"terrain {path} {_why_nothing(values)}")
            remarks = _remarks(path.name, stored, known, positive_down=positive_down)
            if dataset.nodata is None:
                remarks += _remark_on_zeros(path.name, known & (stored.data == 0))
            return Raster(
                name=path.name,
                path=path,
                crs_wkt=dataset.crs.to_wkt(),
                transform=dataset.transform,
                rows=dataset.height,
                columns=dataset.width,
                coarse_m=elevation_m,
                positive_down=positive_down,
                remarks=remarks,
            )
    except RasterioError as error:
        raise ConfigError(f"terrain {path} cannot be read as a raster: {error}") from error


def _check_reference(path: Path, dataset: DatasetReader) -> None:
    crs, transform = dataset.crs, dataset.transform
    wanted = "reproject it to a metric projection such as UTM (gdalwarp -t_srs EPSG:326xx)"
    if dataset.count < 1:
        raise ConfigError(f"terrain {path} has no raster band")
    if crs is None and dataset.gcps[0]:
        raise ConfigError(f"terrain {path} has ground control points, not a grid; {wanted}")
    if crs is None:
        raise ConfigError(
            f"terrain {path} has no coordinate reference system; assign the one its grid is in "
            "(gdal_edit.py -a_srs EPSG:326xx)"
        )
    if not crs.is_projected:
        raise ConfigError(f"terrain {path} is not in a projected system ({crs}); {wanted}")
    if abs(crs.linear_units_factor[1] - 1.0) > 1e-9:
        raise ConfigError(f"terrain {path} is in {crs.linear_units}, not in metres; {wanted}")
    if transform.b or transform.d or transform.a <= 0 or transform.e >= 0:
        raise ConfigError(f"terrain {path} is not a north-up grid; rotate it with gdalwarp")


def _check_heights(path: Path, dataset: DatasetReader) -> None:
    if dataset.dtypes[0] == "uint8" and dataset.colorinterp[0] in COLOURS:
        raise ConfigError(f"terrain {path} is a colour image; give the heights it was drawn from")
    if dataset.dtypes[0].startswith("complex"):
        raise ConfigError(f"terrain {path} holds complex numbers; give heights")
    told = "tell how many metres one is (gdal_edit.py -units m -scale 0.3048, if feet)"
    vertical = VERTICAL_UNIT.search(dataset.crs.to_wkt())
    if vertical and abs(float(vertical[2]) - 1.0) > 1e-9:
        raise ConfigError(
            f"terrain {path} is in a system with heights in {vertical[1]}, not in metres; "
            f"{told} and name its horizontal system alone (-a_srs EPSG:326xx)"
        )
    unit = dataset.units[0] or ""
    if OTHER_UNITS.match(unit.strip()):
        raise ConfigError(f"terrain {path} holds heights in {unit}, not in metres; {told}")


def _values(dataset: DatasetReader, stored: np.ma.MaskedArray) -> NDArray[np.float64]:
    """Return metres, scaled as the band says, NaN where it holds no data or a usual fill."""
    values: NDArray[np.float64] = np.ma.filled(stored.astype(np.float64), np.nan)
    if dataset.nodata is None or dataset.scales[0] == 1.0:  # in centimetres -9999 is a depth
        values[np.isin(values, FILLS)] = np.nan
    return values * float(dataset.scales[0]) + float(dataset.offsets[0])


def _elevations(values: NDArray[np.float64], positive_down: bool) -> NDArray[np.float32]:
    """Return elevations, up positive; NaN where no seabed can be: `DEEPEST_M`, `HIGHEST_M`."""
    elevation_m = (-values if positive_down else values).astype(np.float32)
    elevation_m[~((elevation_m >= -DEEPEST_M) & (elevation_m <= -HIGHEST_M))] = np.nan
    return elevation_m


def _holds_depths(path: Path, values: NDArray[np.float64]) -> bool:
    """Return whether believable values (N,) are depths, positive down: most lie above zero."""
    if values.size == 0 or np.median(values) <= 0.0:
        return False
    below = float(np.mean(values < 0.0))
    if below > LEAST_OTHER_SIGN_SHARE:
        raise ConfigError(
            f"terrain {path} holds {below:.0%} of its cells below zero, and most above: depths, or "
            "elevations of more land than sea? declare the land as no-data, or cut it off"
        )
    return True


def _why_nothing(values: NDArray[np.float64]) -> str:
    """Return why none of the values is known: nothing is there, or no seabed."""
    held = values[np.isfinite(values)]
    if held.size == 0:
        return "holds no data: every cell is no-data"
    return (
        f"holds values from {held.min():g} to {held.max():g}, none of which a seabed has "
        f"({-DEEPEST_M:g} to {-HIGHEST_M:g} m); are they in metres?"
    )


def _remarks(
    name: str, stored: np.ma.MaskedArray, known: NDArray[np.bool_], *, positive_down: bool
) -> tuple[str, ...]:
    """Return remarks on depths, and on cells that were taken for no data untold, if there are."""
    turned = f"terrain {name}: most cells lie above zero: they are read as depths, positive down"
    remarks = (turned,) if positive_down else ()
    untold = np.ma.filled(np.isfinite(stored), False) & ~known
    if not untold.any():
        return remarks
    low, high = stored.data[untold].min(), stored.data[untold].max()
    held = f"{low:g}" if low == high else f"{low:g} to {high:g}"
    return (
        *remarks,
        f"terrain {name}: {untold.mean():.1%} of its cells hold values ({held}) that no seabed "
        "has, and are taken as unknown; declare them as no-data (gdal_edit.py -a_nodata)",
    )


def _remark_on_zeros(name: str, is_zero: NDArray[np.bool_]) -> tuple[str, ...]:
    """Return a remark if more cells (R, C) than by chance are zero, where none is declared."""
    if is_zero.mean() <= MOST_ZEROS_SHARE:
        return ()
    return (
        f"terrain {name}: {is_zero.mean():.1%} of its cells are exactly 0; if nothing was measured "
        "there, declare it (gdal_edit.py -a_nodata 0)",
    )


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
        positive_down=False,
        relief_m=elevation_m,
    )
