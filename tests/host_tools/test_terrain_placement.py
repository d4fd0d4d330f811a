import os
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine
from rasterio.control import GroundControlPoint
from rasterio.crs import CRS
from rasterio.enums import ColorInterp

from host_tools.scenario import named_scenario
from host_tools.simulator.placement import place_survey
from host_tools.simulator.roughness import roughen
from host_tools.simulator.seabed import Seabed
from host_tools.simulator.terrain import open_terrain
from protocol.errors import ConfigError
from protocol.settings import replace

PAPER = named_scenario("paper-1")


def write_raster(
    path: Path,
    elevation_m: np.ndarray,
    cell_m: float = 5.0,
    crs: str | None = "EPSG:32619",
    nodata: float | None = -9999.0,
    dtype: str = "float32",
) -> Path:
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=elevation_m.shape[0],
        width=elevation_m.shape[1],
        count=1,
        dtype=dtype,
        crs=crs,
        transform=Affine(cell_m, 0.0, 350_000.0, 0.0, -cell_m, 4_680_000.0),
        nodata=nodata,
    ) as dataset:
        dataset.write(elevation_m.astype(dtype), 1)
    return path


def slope(rows: int = 300, columns: int = 300) -> np.ndarray:
    return -20.0 - 0.02 * np.add.outer(np.arange(rows), np.arange(columns))


def test_mission_depth_is_shift_minus_elevation_at_the_same_place(tmp_path: Path) -> None:
    path = write_raster(tmp_path / "slope.tif", slope())
    site = place_survey(open_terrain(path), PAPER, 1)
    with rasterio.open(path) as dataset:
        east_m, north_m = 350_000.0 + 130.5 * 5.0, 4_680_000.0 - 150.5 * 5.0
        expected = site.datum.depth_shift_m - dataset.read(1)[150, 130]
    depth = site.seabed.depth_at(
        np.array([north_m - site.datum.origin_north_m]),
        np.array([east_m - site.datum.origin_east_m]),
    )
    assert depth[0] == pytest.approx(expected, abs=1e-3)


def test_mean_altitude_is_forty_metres(tmp_path: Path) -> None:
    site = place_survey(open_terrain(write_raster(tmp_path / "a.tif", slope())), PAPER, 1)
    box = site.footprint
    north_m, east_m = np.meshgrid(
        np.arange(box.south_m, box.north_m, 5), np.arange(box.west_m, box.east_m, 5)
    )
    altitude_m = site.seabed.depth_at(north_m.ravel(), east_m.ravel()) - PAPER.vehicle_depth_m
    assert np.nanmean(altitude_m) == pytest.approx(40.0, abs=0.2)
    assert site.remarks == ()


def test_a_pinnacle_raises_the_mean_so_that_no_altitude_is_under_fifteen(tmp_path: Path) -> None:
    elevation_m = slope()
    elevation_m[148:152, 148:152] = 20.0
    chosen = replace(PAPER, {"survey_north_m": 4_678_900, "survey_east_m": 350_400})
    site = place_survey(open_terrain(write_raster(tmp_path / "a.tif", elevation_m)), chosen, 1)
    assert site.minimum_altitude_m == pytest.approx(15.0)
    assert site.mean_altitude_m > 40.0
    (remark,) = site.remarks
    assert (
        f"{site.mean_altitude_m:.1f} m above the seabed in the mean: minimum_altitude_m" in remark
    )


def test_survey_lies_where_the_settings_say(tmp_path: Path) -> None:
    chosen = replace(PAPER, {"survey_north_m": 4_678_900, "survey_east_m": 350_200})
    site = place_survey(open_terrain(write_raster(tmp_path / "a.tif", slope())), chosen, 1)
    assert (site.datum.origin_north_m, site.datum.origin_east_m) == (4_678_900, 350_200)


def test_survey_avoids_the_part_without_data(tmp_path: Path) -> None:
    elevation_m = slope(400, 400)
    elevation_m[:, :180] = -9999.0
    site = place_survey(open_terrain(write_raster(tmp_path / "a.tif", elevation_m)), PAPER, 1)
    assert site.data_share > 0.98
    assert site.datum.origin_east_m + site.footprint.west_m > 350_000 + 5 * 180 - 25


def test_depths_stored_positive_down_are_turned_over(tmp_path: Path) -> None:
    up = place_survey(open_terrain(write_raster(tmp_path / "u.tif", slope())), PAPER, 1)
    down = place_survey(open_terrain(write_raster(tmp_path / "d.tif", -slope())), PAPER, 1)
    np.testing.assert_array_equal(up.seabed.depth_m, down.seabed.depth_m)
    assert up.raster.remarks == ()
    assert "d.tif: most cells lie above zero: they are read as depths" in down.raster.remarks[0]


def test_elevations_of_more_land_than_sea_are_refused_rather_than_turned_over(
    tmp_path: Path,
) -> None:
    elevation_m = slope() + 28.0  # from 8 m above the sea to 4 m under it
    assert 0.1 < (elevation_m < 0.0).mean() < 0.5
    path = write_raster(tmp_path / "a.tif", elevation_m)
    with pytest.raises(ConfigError, match=r"a.tif holds 22% of its cells below zero, and most"):
        open_terrain(path)


@pytest.mark.parametrize("up", [1.0, -1.0])
def test_scale_and_offset_of_the_band_make_metres(tmp_path: Path, up: float) -> None:
    whole = np.round(slope())
    metres = open_terrain(write_raster(tmp_path / "m.tif", up * whole))
    path = write_raster(
        tmp_path / "cm.tif", up * (100.0 * whole - 700.0), nodata=-32768, dtype="int16"
    )
    with rasterio.open(path, "r+") as dataset:
        dataset.scales, dataset.offsets = (0.01,), (up * 7.0,)
    scaled = open_terrain(path)
    np.testing.assert_allclose(scaled.coarse_m, metres.coarse_m, atol=1e-4)
    np.testing.assert_allclose(scaled.read(10, 20, 30, 40), metres.read(10, 20, 30, 40), atol=1e-4)
    assert len(scaled.remarks) == (0 if up > 0.0 else 1)


@pytest.mark.parametrize("up", [1.0, -1.0])
@pytest.mark.parametrize("declared", [None, -12345.0])
@pytest.mark.parametrize("fill", [-9999.0, 9999.0, -32768.0, -32767.0, -99999.0, 1e20, "land"])
def test_a_fill_that_is_not_declared_is_no_seabed_and_is_told(
    tmp_path: Path, fill: float | str, up: float, declared: float | None
) -> None:
    elevation_m = slope()
    elevation_m[40:60] = np.nan
    stored = up * elevation_m
    stored[150:180, 100:] = fill = up * 250.0 if isinstance(fill, str) else fill
    terrain = open_terrain(write_raster(tmp_path / "a.tif", stored, nodata=declared))
    elevation_m[150:180, 100:] = np.nan
    np.testing.assert_array_equal(terrain.coarse_m, elevation_m.astype(np.float32))
    np.testing.assert_array_equal(terrain.read(0, 0, 300, 300), elevation_m.astype(np.float32))
    remark = terrain.remarks[-1]
    assert len(terrain.remarks) == (1 if up > 0.0 else 2)
    assert f"a.tif: 6.7% of its cells hold values ({fill:g}" in remark


def test_a_fill_stored_in_other_units_is_no_seabed_either(tmp_path: Path) -> None:
    stored = 100.0 * slope()
    stored[150:200] = -32768
    path = write_raster(tmp_path / "cm.tif", stored, nodata=None, dtype="int16")
    with rasterio.open(path, "r+") as dataset:
        dataset.scales = (0.01,)
    assert np.isnan(open_terrain(path).read(150, 0, 50, 300)).all()


@pytest.mark.parametrize(
    ("rows", "nodata", "remarks"), [(30, None, 1), (2, None, 0), (30, -9999.0, 0), (30, 0.0, 0)]
)
def test_many_zeros_are_told_where_no_data_is_undeclared(
    tmp_path: Path, rows: int, nodata: float | None, remarks: int
) -> None:
    elevation_m = slope()
    elevation_m[:rows] = 0.0
    terrain = open_terrain(write_raster(tmp_path / "a.tif", elevation_m, nodata=nodata))
    assert len(terrain.remarks) == remarks
    for remark in terrain.remarks:
        assert "a.tif: 10.0% of its cells are exactly 0; if nothing was measured" in remark


def test_declared_no_data_is_no_remark(tmp_path: Path) -> None:
    elevation_m = slope()
    elevation_m[150:200] = -9999.0
    assert open_terrain(write_raster(tmp_path / "a.tif", elevation_m)).remarks == ()


def test_not_a_raster_is_a_clear_error(tmp_path: Path) -> None:
    path = tmp_path / "notes.tif"
    path.write_text("soundings to follow")
    with pytest.raises(ConfigError, match="cannot be read as a raster"):
        open_terrain(path)
    with pytest.raises(ConfigError, match=r"is not a file on disk; .* with gdal_translate"):
        open_terrain(Path(f"/vsizip/{tmp_path}/a.zip/a.tif"))


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.parametrize(
    ("crs", "said"),
    [
        (None, r"no coordinate reference system; assign the one .*gdal_edit.py -a_srs"),
        ("EPSG:4326", r"not in a projected system .*; reproject it .*gdalwarp"),
    ],
)
def test_terrain_without_projected_system_is_a_clear_error(
    tmp_path: Path, crs: str | None, said: str
) -> None:
    path = write_raster(tmp_path / "a.tif", slope(), crs=crs)
    with pytest.raises(ConfigError, match=said):
        open_terrain(path)


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_terrain_with_ground_control_points_is_to_be_warped(tmp_path: Path) -> None:
    path = write_raster(tmp_path / "a.tif", slope(), crs=None)
    with rasterio.open(path, "r+") as dataset:
        corners = [(0, 0), (300, 0), (0, 300)]
        points = [GroundControlPoint(r, c, 350_000 + 5 * c, 4_680_000 - 5 * r) for r, c in corners]
        dataset.gcps = (points, CRS.from_epsg(32619))
    with pytest.raises(ConfigError, match=r"has ground control points, not a grid; .*gdalwarp"):
        open_terrain(path)


def test_terrain_in_feet_is_a_clear_error(tmp_path: Path) -> None:
    path = write_raster(tmp_path / "a.tif", slope(), crs="EPSG:2263")
    with pytest.raises(ConfigError, match="not in metres"):
        open_terrain(path)


@pytest.mark.parametrize("unit", ["ft", "cm", "US survey foot", "us-ft", "US_survey_foot"])
def test_heights_in_another_unit_are_a_clear_error_until_their_scale_is_told(
    tmp_path: Path, unit: str
) -> None:
    path = write_raster(tmp_path / "a.tif", slope())
    with rasterio.open(path, "r+") as dataset:
        dataset.units = (unit,)
    with pytest.raises(ConfigError, match=f"holds heights in {unit}, not in metres; tell how"):
        open_terrain(path)
    with rasterio.open(path, "r+") as dataset:
        dataset.units, dataset.scales = ("Meters above MLLW",), (0.3048,)
    np.testing.assert_allclose(open_terrain(path).coarse_m, 0.3048 * slope(), rtol=1e-6)


def test_a_vertical_system_in_feet_is_a_clear_error_whatever_the_band_says(tmp_path: Path) -> None:
    path = write_raster(tmp_path / "a.tif", slope(), crs="EPSG:32619+6360")
    for unit in (None, "m"):
        if unit:
            with rasterio.open(path, "r+") as dataset:
                dataset.units = (unit,)
        with pytest.raises(ConfigError, match="a system with heights in US survey foot, not in"):
            open_terrain(path)
    metres = write_raster(tmp_path / "b.tif", slope(), crs="EPSG:32619+5703")
    assert open_terrain(metres).remarks == ()


@pytest.mark.parametrize("colour", [ColorInterp.red, ColorInterp.palette])
def test_a_colour_image_is_a_clear_error(tmp_path: Path, colour: ColorInterp) -> None:
    path = write_raster(tmp_path / "a.tif", -slope(), dtype="uint8", nodata=None)
    with rasterio.open(path, "r+") as dataset:
        dataset.colorinterp = (colour,)
    with pytest.raises(ConfigError, match="is a colour image; give the heights"):
        open_terrain(path)


def test_complex_numbers_are_a_clear_error(tmp_path: Path) -> None:
    path = write_raster(tmp_path / "a.tif", slope(), dtype="complex64", nodata=None)
    with pytest.raises(ConfigError, match="holds complex numbers"):
        open_terrain(path)


def test_terrain_of_no_data_is_a_clear_error(tmp_path: Path) -> None:
    path = write_raster(tmp_path / "a.tif", np.full((200, 200), -9999.0))
    with pytest.raises(ConfigError, match="every cell is no-data"):
        open_terrain(path)


def test_heights_in_millimetres_are_told_by_their_values(tmp_path: Path) -> None:
    path = write_raster(tmp_path / "mm.tif", 1000.0 * slope(), dtype="int32", nodata=None)
    said = r"holds values from -31960 to -20000, none .* \(-12000 to 100 m\); are they in metres"
    with pytest.raises(ConfigError, match=said):
        open_terrain(path)


def test_terrain_too_small_names_both_sizes(tmp_path: Path) -> None:
    path = write_raster(tmp_path / "a.tif", slope(60, 60))
    with pytest.raises(ConfigError, match=r"300 x 300 m .* needs 700 x 700 m"):
        place_survey(open_terrain(path), PAPER, 1)


def test_cells_as_large_as_the_survey_are_told_as_such(tmp_path: Path) -> None:
    path = write_raster(tmp_path / "a.tif", slope(4, 4), cell_m=2000.0)
    with pytest.raises(ConfigError, match=r"cells of 2000 x 2000 m are too coarse for a survey of"):
        place_survey(open_terrain(path), PAPER, 1)


def test_survey_off_the_terrain_is_a_clear_error(tmp_path: Path) -> None:
    chosen = replace(PAPER, {"survey_north_m": 0, "survey_east_m": 0})
    with pytest.raises(ConfigError, match="outside terrain"):
        place_survey(open_terrain(write_raster(tmp_path / "a.tif", slope())), chosen, 1)


def test_roughness_keeps_the_terrain_and_adds_only_short_waves() -> None:
    rng = np.random.default_rng(3)
    size = 128
    wave = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None, :])
    wave[0, 0] = np.inf
    depth_m = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((size, size))) * wave**-1.5)
    depth_m = 50 + 3 * depth_m / depth_m.std()
    coarse = Seabed(depth_m, 0.0, 0.0, 5.0, 5.0)
    fine = roughen(coarse, np.random.default_rng(1))
    again = roughen(coarse, np.random.default_rng(1))
    assert fine.cell_north_m == 1.0
    np.testing.assert_array_equal(fine.depth_m, again.depth_m)
    north_m, east_m = np.meshgrid(np.arange(50.0, 550.0), np.arange(50.0, 550.0), indexing="ij")
    added_m = fine.depth_at(north_m, east_m) - coarse.depth_at(north_m, east_m)
    assert 0.01 < added_m.std() < 0.5
    smooth_m = added_m.reshape(25, 20, 25, 20).mean(axis=(1, 3))
    assert smooth_m.std() < 0.15 * added_m.std()


@pytest.mark.parametrize(
    "name",
    [
        "massbay_west_5m.tif",
        "medes_islands_10m.tif",
        "flat_shelf_2m.bag",
        "portsmouth_ripples_50cm.bag",
    ],
)
def test_real_terrain_holds_a_survey(name: str) -> None:
    folder = os.environ.get("FATHOMLINK_DATA")
    if not folder:
        pytest.skip("FATHOMLINK_DATA is not set")
    changes = {"leg_m": 200, "line_spacing_m": 60} if "ripples" in name else {}
    site = place_survey(open_terrain(Path(folder) / "terrain" / name), replace(PAPER, changes), 1)
    assert site.data_share > 0.7
    assert site.minimum_altitude_m >= 15.0 - 1e-6
