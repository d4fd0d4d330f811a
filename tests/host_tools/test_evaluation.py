import dataclasses

import numpy as np
import pytest

from host_tools.evaluation import (
    draw_map,
    judge_closures,
    mean_nees,
    vehicle_errors,
)
from host_tools.mapping import DepthMap, displaced_sigma_m
from host_tools.registration import registration_error, tile_shifts
from host_tools.results import SoundingPatch, VehicleResult
from host_tools.simulator.placement import Window
from host_tools.simulator.vehicle import TrueTrack
from tests.host_tools.closures import closure


def straight_track(seconds: int = 101) -> TrueTrack:
    time_s = np.arange(float(seconds))
    zero = np.zeros(seconds)
    return TrueTrack(
        time_s=time_s,
        north_m=2.0 * time_s,
        east_m=zero,
        depth_m=zero + 10,
        roll_rad=zero,
        pitch_rad=zero,
        yaw_rad=zero,
    )


def vehicle_result(
    live_off_m: tuple[float, float], final_off_m: tuple[float, float], vehicle: int = 0
) -> VehicleResult:
    truth = straight_track()
    truth_m = truth.position_m
    return VehicleResult(
        vehicle=vehicle,
        truth=truth,
        dead_reckoning_m=truth_m + truth.time_s[:, None] * [0.3, 0.4],
        live_m=truth_m + live_off_m,
        final_m=truth_m + final_off_m,
        yaw_rad=truth.yaw_rad,
        final_covariance_m2=np.tile(np.eye(2) * 4.0, (101, 1, 1)),
    )


def test_errors_are_unaligned_metres_and_shares_of_dead_reckoning() -> None:
    errors = vehicle_errors(vehicle_result((3.0, 4.0), (0.0, 1.0)), 50.0)
    assert errors.distance_m == pytest.approx(200.0)
    assert errors.dead_reckoning.mean_m == pytest.approx(25.0)
    assert errors.dead_reckoning.end_m == pytest.approx(50.0)
    assert errors.live.mean_m == errors.live.rmse_m == errors.live.max_m == pytest.approx(5.0)
    assert errors.live.share_of_dead_reckoning == pytest.approx(0.2)
    assert errors.live.percent_of_distance == pytest.approx(2.5)
    assert errors.live_during_survey.share_of_dead_reckoning == pytest.approx(0.4)
    assert errors.final.nees == pytest.approx(0.25)
    assert errors.live.nees is None


def test_errors_of_the_survey_are_relative_to_the_distance_of_the_survey() -> None:
    errors = vehicle_errors(vehicle_result((3.0, 4.0), (0.0, 1.0)), survey_s=50.0)
    assert errors.distance_m == pytest.approx(200.0)
    assert errors.live_during_survey.percent_of_distance == pytest.approx(5.0)


def test_nees_of_honest_covariances_is_two() -> None:
    rng = np.random.default_rng(1)
    covariance_m2 = np.array([[4.0, 1.0], [1.0, 2.0]])
    error_m = rng.multivariate_normal([0, 0], covariance_m2, 20_000)
    many = np.tile(covariance_m2, (20_000, 1, 1))
    assert mean_nees(error_m, many) == pytest.approx(2.0, abs=0.05)
    many[::2] = np.nan
    assert mean_nees(error_m, many) == pytest.approx(2.0, abs=0.07)
    assert mean_nees(error_m, np.full_like(many, np.nan)) is None


def test_closure_is_judged_against_the_true_displacement() -> None:
    vehicles = [vehicle_result((0, 0), (0, 0))]
    two_axis, north_axis, wrong = judge_closures(
        [closure(), closure(axis_deg=0.0), closure(measured_north_m=90.0)], vehicles
    )
    assert (two_axis.true_north_m, two_axis.true_east_m) == (100.0, 0.0)
    assert two_axis.error_m == pytest.approx(5.0)
    assert two_axis.is_valid
    assert north_axis.error_m == pytest.approx(3.0)
    assert not wrong.is_valid


def small_window(rows: int = 80, columns: int = 80, cell_m: float = 5.0) -> Window:
    return Window(
        top_row=0,
        left_column=0,
        rows=rows,
        columns=columns,
        north0_m=0.0,
        east0_m=0.0,
        cell_north_m=cell_m,
        cell_east_m=cell_m,
    )


def test_map_averages_soundings_by_weight_and_leaves_the_rest_empty() -> None:
    canvas = DepthMap(small_window())
    canvas.add(np.array([[10.0, 20.0, 40.0], [11.0, 21.0, 44.0]]), np.array([1.0, 3.0]))
    canvas.add(np.array([[-900.0, 0.0, 1.0], [0.0, 0.0, np.nan]]))
    depth_m, sigma_m = canvas.grids()
    assert depth_m[2, 4] == pytest.approx(41.0, abs=0.01)
    assert sigma_m[2, 4] > 0.8
    assert np.isfinite(depth_m).sum() == 1


def test_holes_of_a_grid_finer_than_its_soundings_are_filled_near_soundings_only() -> None:
    canvas = DepthMap(small_window(cell_m=0.5))
    north_m, east_m = np.meshgrid(np.arange(5.0, 20, 2), np.arange(5.0, 20, 2))
    canvas.add(np.stack([north_m.ravel(), east_m.ravel(), 30 + north_m.ravel()], 1), 0.01)
    sparse_m, _ = canvas.grids()
    depth_m, _ = canvas.grids(1.5)
    assert np.isfinite(sparse_m[10:38, 10:38]).mean() < 0.1
    assert np.isfinite(depth_m[10:38, 10:38]).all()
    assert np.isnan(depth_m[50:, 50:]).all()
    np.testing.assert_allclose(depth_m[20, 20], 40.0, atol=1.1)


def test_a_map_is_as_unsure_as_its_slopes_make_of_where_it_lies() -> None:
    window = dataclasses.replace(small_window(6, 8, 2.0), cell_east_m=5.0)
    plane_m = 40.0 + 0.1 * 2.0 * np.arange(6)[:, None] + np.zeros(8)
    plane_m[0, 0] = np.nan
    sigma_m = displaced_sigma_m(plane_m, np.full((6, 8), 0.04), np.diag([9.0, 100.0]), window)
    assert sigma_m[3, 4] == pytest.approx(np.hypot(0.04, 0.3))
    assert sigma_m[1, 0] == pytest.approx(0.04)


def test_patches_move_with_the_final_trajectory_at_the_time_they_were_measured() -> None:
    vehicle = vehicle_result((0, 0), (0, 0))
    time_s = np.array([20.0, 80.0])
    truth_north_m = np.array([50.0, 300.0])
    patch = SoundingPatch(
        vehicle=0,
        north_m=truth_north_m + 0.3 * time_s,
        east_m=100.0 + 0.4 * time_s,
        depth_m=np.array([33.0, 44.0]),
        variance_m2=np.array([0.01, 0.01]),
        time_s=time_s,
    )
    depth_m, _ = draw_map([patch], [vehicle], DepthMap(small_window())).grids()
    rows, columns = np.nonzero(np.isfinite(depth_m))
    found = dict(zip(rows.tolist(), depth_m[rows, columns].tolist(), strict=True))
    assert found == pytest.approx({10: 33.0, 60: 44.0}, abs=0.01)
    assert columns.tolist() == [20, 20]


def relief(rows: int = 120, columns: int = 120, north_m: float = 0.0) -> np.ndarray:
    n, e = np.meshgrid(np.arange(rows) * 5.0 - north_m, np.arange(columns) * 5.0, indexing="ij")
    depth_m: np.ndarray = 50 + 2 * np.sin(n / 17) * np.cos(e / 23) + np.sin((n + e) / 31)
    return depth_m


def test_tile_shift_finds_how_far_a_map_is_off() -> None:
    tiles = tile_shifts(relief(north_m=4.0) + 0.5, relief(), 5.0, 5.0)
    assert tiles.tiles == 36
    assert tiles.median_m == pytest.approx(4.0, abs=0.4)
    assert tiles.far_tiles == 0
    same = tile_shifts(relief(), relief(), 5.0, 5.0)
    assert same.p95_m == 0.0


def test_tiles_farther_off_than_is_searched_are_counted_apart() -> None:
    tiles = tile_shifts(relief(north_m=28.0), relief(), 5.0, 5.0)
    assert (tiles.tiles, tiles.far_tiles) == (0, 36)
    assert np.isnan(tiles.median_m)


def test_tiles_that_lie_beside_the_truth_map_are_far_off_not_flat() -> None:
    truth_m, depth_m = relief(), relief()
    truth_m[60:], depth_m[:60] = np.nan, np.nan
    tiles = tile_shifts(depth_m, truth_m, 5.0, 5.0)
    assert (tiles.tiles, tiles.flat_tiles, tiles.far_tiles) == (0, 0, 18)


def test_tiles_of_a_flat_or_tilted_plane_do_not_claim_a_shift() -> None:
    plane_m = 50 + 0.05 * np.add.outer(np.arange(100.0), np.arange(100.0))
    tiles = tile_shifts(plane_m, plane_m, 5.0, 5.0)
    assert (tiles.tiles, tiles.flat_tiles) == (0, 25)


def test_registration_error_counts_cells_that_both_maps_hold() -> None:
    truth_m = np.full((10, 10), 40.0)
    depth_m = truth_m + np.linspace(0, 1.98, 100).reshape(10, 10)
    depth_m[0] = np.nan
    error = registration_error(depth_m, truth_m)
    assert error.cells == 90
    assert error.mapped_share == 0.9
    assert error.share_under_1m == pytest.approx(40 / 90, abs=0.02)
