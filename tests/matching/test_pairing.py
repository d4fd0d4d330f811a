"""What sonars' errors make of a pair of sub-maps, and which pairs teach them."""

import dataclasses
import itertools
from unittest.mock import MagicMock

import numpy as np
import pytest

from firmware.geometry import Array
from firmware.leader.atlas import SheetId, sheet_of
from firmware.leader.matches import MatchingSettings
from firmware.leader.pairing import Calibrations, Side
from firmware.leader.swath import levelled, swath_of
from firmware.submaps import Track
from tests.matching.scenes import CELL_M, Scene

STILL = np.zeros(2)
ERRORS = np.array([0.0035, 0.0023]), np.array([-0.003, 0.001])  # roll in rad and smile
SETTINGS = MatchingSettings()


def side(
    vehicle: int = 0, heading_deg: float = 0.0, east_m: float = 0.0, time_s: float = 0.0
) -> Side:
    """Return a side with a half width of 60 m, of which only the geometry is known."""
    yaw_rad = np.radians(heading_deg)
    return Side(
        sheet=MagicMock(id=SheetId(vehicle=vehicle, boot_epoch=0, submap=0), time_s=time_s),
        grid=MagicMock(),
        drift_mps=STILL,
        swath=MagicMock(half_width_m=60.0),
        starboard=np.array([-np.sin(yaw_rad), np.cos(yaw_rad)]),
        track_m=np.array([10.0, east_m]),
    )


def difference_m(sides: tuple[Side, Side], shift_m: Array, errors: Array, place_m: Array) -> Array:
    """Return how much deeper the first says places (2, ...) are by errors of both (4,)."""
    depths_m = []
    for one, moved_m, (roll, smile) in zip(
        sides, (STILL, shift_m), np.split(errors, 2), strict=True
    ):
        across_m = np.tensordot(one.starboard, place_m, axes=1)
        across_m = across_m - one.starboard @ (one.track_m + moved_m)
        depths_m.append(roll * across_m + smile * across_m**2 / one.swath.half_width_m)
    return np.asarray(depths_m[0] - depths_m[1])


@pytest.mark.parametrize("heading_deg", [0.0, 45.0, 90.0, 180.0])
@pytest.mark.parametrize("vehicle", [0, 1])
def test_tilt_and_bend_are_what_errors_make_of_the_difference_of_two_swaths(
    heading_deg: float, vehicle: int
) -> None:
    """Half way between the tracks; two vehicles err each on their own."""
    sides, shift_m = (side(), side(vehicle, heading_deg, 50.0)), np.array([12.0, -8.0])
    known = [np.diag([0.002, 0.003]) ** 2, np.diag([0.001, 0.003]) ** 2]
    calibrations = Calibrations(SETTINGS)
    for number, covariance in enumerate(known):
        calibrations._vehicles[number] = MagicMock(covariance=covariance)
    middle_m = (sides[0].track_m + sides[1].track_m + shift_m) / 2.0
    turns = np.linspace(0.0, np.pi, 181)
    ways_m = np.array([np.cos(turns), np.sin(turns)])
    roots = [np.sqrt(np.diag(covariance)) for covariance in known]
    units = (
        [np.tile(unit, 2) for unit in np.diag(roots[0])]
        if vehicle == 0
        else list(np.diag(np.concatenate(roots)))
    )
    tilt_2, bend_2 = np.zeros(181), np.zeros(181)
    for errors in units:
        ahead_m, here_m, behind_m = (
            difference_m(sides, shift_m, errors, middle_m[:, None] + sign * ways_m)
            for sign in (1.0, 0.0, -1.0)
        )
        tilt_2 += ((ahead_m - behind_m) / 2.0) ** 2
        bend_2 += ((ahead_m + behind_m) / 2.0 - here_m) ** 2
    found = calibrations.sigmas_of(*sides, shift_m)
    assert found.tilt == pytest.approx(np.hypot(np.sqrt(tilt_2.max()), 5e-4), rel=1e-3)
    bend_per_m = np.hypot(np.sqrt(bend_2.max()), 3e-6)
    assert bend_per_m * 0.999 < found.bend_per_m < 1.03 * bend_per_m


def test_beyond_its_edge_a_swath_is_no_steeper() -> None:
    calibrations = Calibrations(SETTINGS)
    edge, beyond = (
        calibrations.sigmas_of(side(), side(0, 180.0, east_m), np.array([0.0, 0.0]))
        for east_m in (120.0, 200.0)
    )
    assert edge == beyond


@pytest.mark.parametrize(
    ("vehicle", "apart_s", "wandered_m"),
    [(0, 0.0, 0.0), (0, 600.0, 0.3 * np.sqrt(1.0 - np.exp(-0.5))), (0, 1e5, 0.3), (1, 0.0, 0.3)],
)
def test_tide_and_depth_sensor_wander_between_passes(
    vehicle: int, apart_s: float, wandered_m: float
) -> None:
    sides = side(time_s=100.0), side(vehicle, time_s=100.0 + apart_s)
    for pair in (sides, sides[::-1]):
        found = Calibrations(SETTINGS).sigmas_of(*pair, STILL)
        assert found.offset_m == pytest.approx(np.hypot(wandered_m, 0.02))


def test_a_swath_tells_how_far_above_the_seabed_it_was_seen_from() -> None:
    look = Calibrations(SETTINGS).look_of(side(1, 90.0))
    assert look.altitude_m == pytest.approx(60.0 / np.sqrt(3.0))  # 60 degrees to each side
    assert (look.vehicle, look.half_width_m) == (1, 60.0)
    assert look.starboard == pytest.approx([-1.0, 0.0])


def line(scene: Scene, vehicle: int, east_m: float, *, northward: bool) -> Side:
    """Return 80 m of a line along north, seen with its vehicle's errors."""
    grid, rows_s = scene.submap(300.0, east_m - 62.0, (41, 63)), np.arange(41.0)
    track = Track(
        time_s=rows_s,
        north_m=(300.0 + CELL_M * rows_s)[:: 1 if northward else -1],
        east_m=np.full(41, east_m),
        yaw_rad=np.full(41, 0.0 if northward else np.pi),
    )
    times_s = rows_s[:: 1 if northward else -1, None] * np.ones((1, 63))
    grid = dataclasses.replace(grid, time_s=times_s)
    swath = swath_of(grid, track, STILL, 20.0)
    grid = levelled(grid, swath, -ERRORS[vehicle])
    sheet = sheet_of(SheetId(vehicle=vehicle, boot_epoch=0, submap=0), track, grid)
    assert sheet is not None
    return Side(
        sheet=sheet,
        grid=grid,
        drift_mps=STILL,
        swath=swath,
        starboard=np.array([0.0, 1.0 if northward else -1.0]),
        track_m=sheet.reckoned_at(20.0),
    )


def test_a_vehicle_whose_errors_are_known_teaches_another_its_own(scene: Scene) -> None:
    calibrations = Calibrations(SETTINGS)

    def learn(first: int, second: int, apart_m: float) -> None:
        sides = (
            line(scene, first, 300.0, northward=True),
            line(scene, second, 300.0 + apart_m, northward=False),
        )
        calibrations.learn(*sides, STILL, 9.0 * np.eye(2))

    unknown = calibrations.of(1).covariance
    for vehicles in ((0, 1), (1, 0)):
        learn(*vehicles, 60.0)
    assert all(np.array_equal(calibrations.of(k).covariance, unknown) for k in (0, 1))
    for apart_m in (80.0, -80.0, 60.0, -60.0, 40.0, -40.0):
        learn(0, 0, apart_m)
    assert np.array_equal(calibrations.of(1).covariance, unknown)
    known = calibrations.of(0).covariance
    learn(0, 1, 80.0)
    assert np.array_equal(calibrations.of(0).covariance, known)
    for vehicles, apart_m in itertools.product(((0, 1), (1, 0)), (80.0, -80.0, 60.0, -60.0)):
        learn(*vehicles, apart_m)
    for k in (0, 1):
        assert calibrations.of(k).errors == pytest.approx(ERRORS[k], abs=0.001)
        one = line(scene, k, 300.0, northward=True)
        level_m = levelled(one.grid, one.swath, ERRORS[k]).depth_m
        assert calibrations.level(one).depth_m == pytest.approx(level_m, abs=0.1)
