"""Where on a terrain the survey lies, and how the datum is shifted under it.

The rule, in this order: the survey box (all tracks and half a swath around them) holds the largest
share of data, to two per cent; the altitude can be held without a larger shift; the box is nearest
to the centre of the data. Relief is never looked for. `survey_north_m` and `survey_east_m`
overrule.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from firmware.geometry import Array
from host_tools.scenario import ScenarioSettings
from host_tools.simulator.lawnmower import Lawnmower
from host_tools.simulator.roughness import roughen
from host_tools.simulator.seabed import Datum, Seabed
from host_tools.simulator.terrain import Raster
from protocol.errors import ConfigError

LEAST_DATA_SHARE = 0.5
PLAN_STEP_S = 5.0
# Rays that leave the survey box still hit seabed this many altitudes away.
MARGIN_ALTITUDES = 6.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Box:
    """A box of NED, relative to the leader's first corner."""

    south_m: float
    north_m: float
    west_m: float
    east_m: float

    def grown(self, margin_m: float) -> "Box":
        """Return the box with a margin on all four sides."""
        return Box(
            south_m=self.south_m - margin_m,
            north_m=self.north_m + margin_m,
            west_m=self.west_m - margin_m,
            east_m=self.east_m + margin_m,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """The part of the terrain's grid under the survey and around it.

    Its cell (0, 0) is the south-western one, with centre (north0_m, east0_m) in NED; top_row and
    left_column say where its north-western cell lies in the file.
    """

    top_row: int
    left_column: int
    rows: int
    columns: int
    north0_m: float
    east0_m: float
    cell_north_m: float
    cell_east_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Site:
    """A seabed to survey, where it lies, and what the placement found."""

    seabed: Seabed
    datum: Datum
    raster: Raster
    window: Window
    data_share: float
    mean_altitude_m: float
    minimum_altitude_m: float
    tracks: Box
    footprint: Box
    remarks: tuple[str, ...] = ()


def place_survey(raster: Raster, scenario: ScenarioSettings, seed: int) -> Site:
    """Return the seabed under the survey in mission NED, with its datum.

    The mean altitude over the survey box is scenario.altitude_m, or as much more as keeps every
    cell of it scenario.minimum_altitude_m below the vehicles.

    Raises
    ------
    ConfigError
        When the terrain is too small for the scenario, or holds too little data under it.
    """
    scenario.check()
    tracks = planned_box(scenario)
    half_swath_m = scenario.altitude_m * math.tan(math.radians(scenario.swath_deg / 2.0))
    footprint = tracks.grown(half_swath_m)
    _check_size(raster, scenario, tracks)
    if scenario.survey_north_m is not None and scenario.survey_east_m is not None:
        corner = (scenario.survey_north_m, scenario.survey_east_m)
    else:
        corner = _best_corner(raster, scenario, tracks, footprint)
    elevation_m = _read(raster, _window(raster, corner, footprint))
    share = float(np.isfinite(elevation_m).mean()) * _inside_share(raster, corner, footprint)
    if not share >= LEAST_DATA_SHARE:
        raise ConfigError(
            f"terrain {raster.name} holds data under {share:.0%} of the survey at northing "
            f"{corner[0]:.0f}, easting {corner[1]:.0f}; {LEAST_DATA_SHARE:.0%} is needed: "
            "move it with --set survey_north_m, survey_east_m, or shorten it with leg_m, "
            "duration_min or follower_duration_min"
        )
    mean_m, shallowest_m = -float(np.nanmean(elevation_m)), -float(np.nanmax(elevation_m))
    shift_m = scenario.vehicle_depth_m + max(
        scenario.altitude_m - mean_m, scenario.minimum_altitude_m - shallowest_m
    )
    mean_altitude_m = mean_m + shift_m - scenario.vehicle_depth_m
    window = _window(raster, corner, footprint.grown(MARGIN_ALTITUDES * scenario.altitude_m))
    seabed = Seabed(
        shift_m - _read(raster, window),
        window.north0_m,
        window.east0_m,
        window.cell_north_m,
        window.cell_east_m,
    )
    if scenario.roughness:
        seabed = roughen(seabed, np.random.default_rng([seed, 0x20C4]))
    return Site(
        seabed=seabed,
        datum=Datum(
            crs_wkt=raster.crs_wkt,
            origin_north_m=corner[0],
            origin_east_m=corner[1],
            depth_shift_m=shift_m,
        ),
        raster=raster,
        window=window,
        data_share=share,
        mean_altitude_m=mean_altitude_m,
        minimum_altitude_m=shallowest_m + shift_m - scenario.vehicle_depth_m,
        tracks=tracks,
        footprint=footprint,
        remarks=(*raster.remarks, *_altitude_remarks(scenario, mean_altitude_m)),
    )


def _altitude_remarks(scenario: ScenarioSettings, mean_m: float) -> tuple[str, ...]:
    """Return one remark where the lowest altitude decides, rather than the mean."""
    if mean_m < scenario.altitude_m + 0.05:
        return ()
    return (
        f"altitude_m is {scenario.altitude_m:g} m, but the survey is {mean_m:.1f} m above the "
        f"seabed in the mean: minimum_altitude_m={scenario.minimum_altitude_m:g} decides",
    )


def planned_box(scenario: ScenarioSettings) -> Box:
    """Return the box that holds the surveyed tracks of all vehicles."""
    rng = np.random.default_rng(0)
    corners: list[tuple[float, float, float, float]] = []
    for vehicle in range(scenario.followers + 1):
        time_s = np.arange(0.0, scenario.survey_s(vehicle) + PLAN_STEP_S, PLAN_STEP_S)
        path = Lawnmower(scenario, vehicle, rng).at(np.minimum(time_s, scenario.survey_s(vehicle)))
        north_m, east_m = path.north_m, path.east_m
        corners.append((north_m.min(), north_m.max(), east_m.min(), east_m.max()))
    south, north, west, east = np.array(corners).T
    return Box(
        south_m=float(south.min()),
        north_m=float(north.max()),
        west_m=float(west.min()),
        east_m=float(east.max()),
    )


def _check_size(raster: Raster, scenario: ScenarioSettings, tracks: Box) -> None:
    have = (raster.rows * raster.cell_north_m, raster.columns * raster.cell_east_m)
    need = (tracks.north_m - tracks.south_m, tracks.east_m - tracks.west_m)
    if have[0] < need[0] or have[1] < need[1]:
        raise ConfigError(
            f"terrain {raster.name} is {have[0]:.0f} x {have[1]:.0f} m (north x east); scenario "
            f"{scenario.name} needs {need[0]:.0f} x {need[1]:.0f} m: shorten it with "
            "--set leg_m, line_spacing_m, duration_min or follower_duration_min"
        )


def _best_corner(
    raster: Raster, scenario: ScenarioSettings, tracks: Box, footprint: Box
) -> tuple[float, float]:
    """Return northing and easting of the leader's first corner by the rule of this module."""
    step_n = raster.cell_north_m * raster.rows / raster.coarse_m.shape[0]
    step_e = raster.cell_east_m * raster.columns / raster.coarse_m.shape[1]
    elevation_m = raster.coarse_m[::-1]  # row 0 southernmost
    size = (
        max(1, round((footprint.north_m - footprint.south_m) / step_n)),
        max(1, round((footprint.east_m - footprint.west_m) / step_e)),
    )
    # Half a swath may hang over the terrain's edge, the tracks may not.
    hang = (
        int((tracks.south_m - footprint.south_m) / step_n),
        int((tracks.west_m - footprint.west_m) / step_e),
    )
    padded = np.pad(elevation_m, ((hang[0],) * 2, (hang[1],) * 2), constant_values=np.nan)
    known = np.isfinite(padded)
    size = (min(size[0], padded.shape[0]), min(size[1], padded.shape[1]))
    share = _box_sums(known.astype(np.float64), size) / (size[0] * size[1])
    depth_m = np.where(known, -padded, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean_m = _box_sums(depth_m.astype(np.float64), size) / (share * size[0] * size[1])
    shallowest_m = _box_minima(np.where(known, -padded, np.inf), size)
    room_m = scenario.altitude_m - scenario.minimum_altitude_m
    level = np.nan_to_num(mean_m - shallowest_m, nan=np.inf) <= room_m
    weight = known.sum()
    centre = (np.arange(known.shape[0]) @ known.sum(1), np.arange(known.shape[1]) @ known.sum(0))
    i, j = np.indices(share.shape)
    distance = np.hypot(
        (i + size[0] / 2 - centre[0] / weight) * step_n,
        (j + size[1] / 2 - centre[1] / weight) * step_e,
    )
    best_share = np.floor(share / 0.02)
    order = np.lexsort((distance.ravel(), ~level.ravel(), -best_share.ravel()))
    row, column = np.unravel_index(order[0], share.shape)
    south_m = raster.transform.f - raster.rows * raster.cell_north_m
    return (
        float(south_m + (int(row) - hang[0]) * step_n - footprint.south_m),
        float(raster.transform.c + (int(column) - hang[1]) * step_e - footprint.west_m),
    )


def _box_sums(values: Array, size: tuple[int, int]) -> Array:
    """Return the sum over every box of the size that fits; entry (i, j) starts at cell (i, j)."""
    table = np.pad(values.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    rows, columns = size
    sums: Array = (
        table[rows:, columns:] - table[:-rows, columns:] - table[rows:, :-columns]
    ) + table[:-rows, :-columns]
    return sums


def _box_minima(values: Array, size: tuple[int, int]) -> Array:
    """Return the least value of every box of the size that fits."""
    origin = (-(size[0] // 2), -(size[1] // 2))
    minima: Array = ndimage.minimum_filter(values, size=size, mode="nearest", origin=origin)
    return minima[: values.shape[0] - size[0] + 1, : values.shape[1] - size[1] + 1]


def _window(raster: Raster, corner: tuple[float, float], box: Box) -> Window:
    """Return the terrain's cells within the box, cut at the terrain's edge."""
    west_m, top_m = raster.transform.c, raster.transform.f
    left = math.floor((corner[1] + box.west_m - west_m) / raster.cell_east_m)
    right = math.ceil((corner[1] + box.east_m - west_m) / raster.cell_east_m)
    top = math.floor((top_m - corner[0] - box.north_m) / raster.cell_north_m)
    bottom = math.ceil((top_m - corner[0] - box.south_m) / raster.cell_north_m)
    if min(bottom - top, raster.rows) < 2 or min(right - left, raster.columns) < 2:
        raise ConfigError(
            f"terrain {raster.name}: cells of {raster.cell_north_m:g} x {raster.cell_east_m:g} m "
            f"are too coarse for a survey of {box.north_m - box.south_m:.0f} x "
            f"{box.east_m - box.west_m:.0f} m (north x east)"
        )
    top, left = max(top, 0), max(left, 0)
    bottom, right = min(bottom, raster.rows), min(right, raster.columns)
    if bottom - top < 2 or right - left < 2:
        raise ConfigError(
            f"the survey at northing {corner[0]:.0f}, easting {corner[1]:.0f} lies outside terrain "
            f"{raster.name}; choose survey_north_m and survey_east_m within it"
        )
    return Window(
        top_row=top,
        left_column=left,
        rows=bottom - top,
        columns=right - left,
        north0_m=top_m - (bottom - 0.5) * raster.cell_north_m - corner[0],
        east0_m=west_m + (left + 0.5) * raster.cell_east_m - corner[1],
        cell_north_m=raster.cell_north_m,
        cell_east_m=raster.cell_east_m,
    )


def _read(raster: Raster, window: Window) -> Array:
    """Return the elevations of the window, row 0 southernmost."""
    elevation_m = raster.read(window.top_row, window.left_column, window.rows, window.columns)
    return elevation_m[::-1].astype(np.float64)


def _inside_share(raster: Raster, corner: tuple[float, float], box: Box) -> float:
    """Return the share of the box that lies on the raster."""
    top_m, west_m = raster.transform.f, raster.transform.c
    south_m = top_m - raster.rows * raster.cell_north_m
    east_m = west_m + raster.columns * raster.cell_east_m
    high = min(top_m, corner[0] + box.north_m) - max(south_m, corner[0] + box.south_m)
    wide = min(east_m, corner[1] + box.east_m) - max(west_m, corner[1] + box.west_m)
    area = (box.north_m - box.south_m) * (box.east_m - box.west_m)
    return min(1.0, max(0.0, high) * max(0.0, wide) / area)
