from collections.abc import Callable

import numpy as np
import pytest

from firmware.soundings import SonarSettings, soundings_from_ping
from host_tools.scenario import ScenarioSettings, named_scenario
from host_tools.simulator.lawnmower import Lawnmower
from host_tools.simulator.multibeam import Poses, cast_rays
from host_tools.simulator.placement import place_survey
from host_tools.simulator.seabed import Seabed
from host_tools.simulator.terrain import open_terrain
from host_tools.simulator.vehicle import SimulatedVehicle
from protocol.settings import replace

QUIET = {
    "sounding_sigma_m": 0,
    "sounding_sigma_share": 0,
    "heading_noise_deg": 0,
    "attitude_noise_deg": 0,
    "drift_mean_mps": 0,
    "drift_variance": 0,
}


def hilly_seabed() -> Seabed:
    north_m, east_m = np.meshgrid(
        np.arange(-400, 405, 5.0), np.arange(-400, 405, 5.0), indexing="ij"
    )
    depth_m = 50 + 8 * np.sin(north_m / 25) * np.cos(east_m / 18)
    return Seabed(depth_m, -400.0, -400.0, 5.0, 5.0)


def first_crossing(seabed: Seabed, origin: np.ndarray, direction: np.ndarray) -> float:
    along_m = np.arange(0.0, 400.0, 0.005)
    points = origin[:, None] + direction[:, None] * along_m
    below = points[2] >= seabed.depth_at(points[0], points[1])
    return float(along_m[np.argmax(below)])


def walled_seabed() -> Seabed:
    depth_m = np.full((601, 601), 50.0)
    depth_m[320:] = 20.0
    return Seabed(depth_m, -300.0, -300.0, 1.0, 1.0)


@pytest.mark.parametrize("made", [hilly_seabed, walled_seabed])
def test_ray_stops_at_the_first_surface_even_behind_steep_hills(made: Callable[[], Seabed]) -> None:
    seabed = made()
    rng = np.random.default_rng(1)
    angles = rng.uniform(0.8, 1.25, 60)
    bearing = rng.uniform(0, 2 * np.pi, 60)
    directions = np.stack(
        [np.sin(angles) * np.cos(bearing), np.sin(angles) * np.sin(bearing), np.cos(angles)]
    )[:, None, :]
    zero = np.zeros(1)
    poses = Poses(
        north_m=zero, east_m=zero, depth_m=zero + 10, roll_rad=zero, pitch_rad=zero, yaw_rad=zero
    )
    ranges_m = cast_rays(seabed, poses, directions)[0]
    expected = [
        first_crossing(seabed, np.array([0.0, 0.0, 10.0]), directions[:, 0, k]) for k in range(60)
    ]
    np.testing.assert_allclose(ranges_m, expected, atol=0.05)


def test_beam_that_ends_on_no_data_is_lost_and_one_that_only_passes_over_it_is_not() -> None:
    depth_m = np.full((81, 81), 40.0)
    depth_m[:, 44:48] = np.nan
    seabed = Seabed(depth_m, -200.0, -200.0, 5.0, 5.0)
    zero = np.zeros(1)
    poses = Poses(
        north_m=zero, east_m=zero, depth_m=zero, roll_rad=zero, pitch_rad=zero, yaw_rad=zero
    )
    across = np.arctan2([0.0, 28.0, 60.0], 40.0)
    directions = np.stack([0 * across, np.sin(across), np.cos(across)])[:, None, :]
    ranges_m = cast_rays(seabed, poses, directions)[0]
    assert np.isnan(ranges_m).tolist() == [False, True, False]
    assert ranges_m[2] == pytest.approx(np.hypot(40, 60), abs=1e-3)


def test_depth_is_bilinear_between_cells_and_nan_outside() -> None:
    seabed = Seabed(np.array([[1.0, 2.0], [3.0, 5.0]]), 0.0, 0.0, 10.0, 10.0)
    north_m, east_m = np.array([0.0, 5.0, 9.9999, 30.0]), np.array([0.0, 5.0, 9.9999, 0.0])
    depth_m = seabed.depth_at(north_m, east_m)
    np.testing.assert_allclose(depth_m[:3], [1.0, 2.75, 5.0], atol=1e-3)
    assert np.isnan(depth_m[3])


def test_noise_free_soundings_lie_on_the_seabed() -> None:
    scenario = replace(named_scenario("paper-1"), {"duration_min": 1, **QUIET})
    site = place_survey(open_terrain(None), scenario, 1)
    vehicle = SimulatedVehicle(scenario, site.seabed, 0, 7)
    for odometry, ping in vehicle.steps():
        assert ping is not None
        north_m, east_m, _ = vehicle.true_position(odometry.time_s)
        points_m, bad = soundings_from_ping(ping, north_m, east_m, SonarSettings())
        assert bad == 0
        expected_m = site.seabed.depth_at(points_m[:, 0], points_m[:, 1])
        np.testing.assert_allclose(points_m[:, 2], expected_m, atol=0.01)


def test_the_truth_map_has_none_of_the_errors_of_navigation() -> None:
    errors = {"heading_bias_deg": 5, "depth_wander_m": 3, "sounding_sigma_m": 0}
    changes = {"duration_min": 1, **errors, "sounding_sigma_share": 0}
    scenario = replace(named_scenario("paper-1"), changes)
    site = place_survey(open_terrain(None), scenario, 1)
    truth_m: list[np.ndarray] = []
    list(SimulatedVehicle(scenario, site.seabed, 0, 7, truth_m.append).steps())
    points_m = np.concatenate(truth_m)
    expected_m = site.seabed.depth_at(points_m[:, 0], points_m[:, 1])
    np.testing.assert_allclose(points_m[:, 2], expected_m, atol=0.01)


def test_noise_free_odometry_sums_to_the_true_track_through_turns() -> None:
    scenario = replace(named_scenario("paper-1"), {"duration_min": 12, **QUIET})
    site = place_survey(open_terrain(None), scenario, 1)
    vehicle = SimulatedVehicle(scenario, site.seabed, 0, 7)
    position_m = np.array(vehicle.true_position(0.0)[:2])
    for odometry, _ in vehicle.steps():
        position_m += (
            np.array([odometry.velocity_north_mps, odometry.velocity_east_mps]) / scenario.ping_hz
        )
        truth = vehicle.true_position(odometry.time_s)[:2]
        assert np.hypot(*(position_m - truth)) < 1e-6


@pytest.mark.parametrize(
    ("ping_hz", "tick_hz"), [(4, 4), (0.5, 1), (1.5, 3), (2.5, 5), (3.7, 37), (19.3, 40), (20, 20)]
)
def test_pings_come_at_their_rate_and_navigation_on_whole_seconds_too(
    ping_hz: float, tick_hz: int
) -> None:
    scenario = replace(
        named_scenario("paper-1"), {"duration_min": 0.9, "beams": 2, "ping_hz": ping_hz}
    )
    seabed = Seabed(np.full((8, 8), 50.0), -2000.0, -2000.0, 700.0, 700.0)
    steps = list(SimulatedVehicle(scenario, seabed, 0, 1).steps())
    assert scenario.tick_hz == tick_hz
    assert {float(t) for t in range(55)} <= {odometry.time_s for odometry, _ in steps}
    pings_s = np.array([ping.time_s for _, ping in steps if ping is not None])
    due_s = np.arange(len(pings_s)) / ping_hz
    assert len(pings_s) == int(54 * ping_hz) + 1
    assert np.all((pings_s > due_s - 1e-6) & (pings_s < due_s + scenario.tick_s))
    if tick_hz < 40:
        np.testing.assert_allclose(pings_s, due_s, atol=1e-6)


@pytest.mark.parametrize(
    ("every_min", "times_s"),
    [(4.0, [240.0, 480.0]), (4.1, [246.0, 492.0]), (3.99, [239.5, 479.0]), (0.0, [])],
)
def test_fixes_come_at_the_first_tick_that_they_are_due(
    every_min: float, times_s: list[float]
) -> None:
    scenario = replace(
        named_scenario("paper-1"),
        {"gnss_fix_every_min": every_min, "duration_min": 10, "beams": 2, "ping_hz": 2},
    )
    vehicle = SimulatedVehicle(scenario, hilly_seabed(), 0, 1)
    assert [step.time_s for step, _ in vehicle.steps() if step.fix is not None] == times_s


def test_eq_12_has_the_stated_mean_and_variance_once_a_second() -> None:
    scenario = replace(
        named_scenario("paper-1"), {"duration_min": 60, "follower_duration_min": 0.5, "beams": 2}
    )
    seabed = Seabed(np.full((8, 8), 50.0), -2000.0, -2000.0, 700.0, 700.0)
    errors = []
    for seed in range(4):
        vehicle = SimulatedVehicle(scenario, seabed, 1, seed)
        track = vehicle.true_track()
        steps = [(o.velocity_north_mps, o.velocity_east_mps) for o, _ in vehicle.steps()]
        reckoned = np.cumsum(np.array(steps), axis=0)[::4] / 4
        truth = np.stack([track.north_m, track.east_m], 1)
        errors.append(np.diff(reckoned - truth + truth[0], axis=0))
    drawn = np.concatenate(errors).ravel()
    assert drawn.mean() == pytest.approx(0.1, abs=0.01)
    assert drawn.var() == pytest.approx(0.04, rel=0.05)


def test_same_seed_repeats_and_another_seed_differs() -> None:
    scenario = replace(named_scenario("field-1"), {"duration_min": 1})
    site = place_survey(open_terrain(None), scenario, 1)

    def ranges(seed: int, index: int) -> np.ndarray:
        vehicle = SimulatedVehicle(scenario, site.seabed, index, seed)
        return np.array([p.slant_ranges_m for _, p in vehicle.steps() if p is not None])

    np.testing.assert_array_equal(ranges(3, 0), ranges(3, 0))
    assert not np.array_equal(ranges(3, 0), ranges(4, 0))
    assert not np.array_equal(ranges(3, 0)[:10], ranges(3, 1)[:10])


def test_sonar_is_off_after_the_survey_and_the_follower_stays_about_its_end() -> None:
    scenario = replace(named_scenario("paper-1"), {"duration_min": 4, "follower_duration_min": 2})
    site = place_survey(open_terrain(None), scenario, 1)
    vehicle = SimulatedVehicle(scenario, site.seabed, 1, 1)
    off = [odometry.time_s for odometry, ping in vehicle.steps() if ping is None]
    assert min(off) == pytest.approx(120.25)
    assert max(off) == pytest.approx(240.0)
    end = vehicle.true_position(120.0)
    far = [np.hypot(*np.subtract(vehicle.true_position(t)[:2], end[:2])) for t in range(120, 240)]
    assert 0.5 < max(far) <= 2 * scenario.wander_m


@pytest.mark.parametrize("name", ["paper-1", "paper-2", "day-1"])
def test_tracks_keep_speed_turn_rate_and_block(name: str) -> None:
    scenario = replace(
        named_scenario(name), {"followers": 4, "duration_min": 200, "follower_duration_min": 200}
    )
    starts = set()
    for vehicle in range(5):
        path = Lawnmower(scenario, vehicle, np.random.default_rng(0)).at(np.arange(0, 12000, 0.25))
        speed_mps = np.hypot(np.diff(path.north_m), np.diff(path.east_m)) / 0.25
        np.testing.assert_allclose(speed_mps, scenario.speed_mps, rtol=2e-3)
        turn_dps = np.degrees(np.abs(np.diff(np.unwrap(path.yaw_rad)))) / 0.25
        assert turn_dps.max() <= scenario.turn_rate_dps + 1e-6
        course_rad = np.arctan2(np.diff(path.east_m), np.diff(path.north_m))
        assert np.abs(np.sin(course_rad - path.yaw_rad[:-1])).max() < 0.03
        assert max(np.abs(path.north_m).max(), np.abs(path.east_m).max()) < scenario.leg_m + 210
        starts.add((path.north_m[0], path.east_m[0]))
    assert len(starts) == 5


def test_follower_of_the_paper_starts_at_the_corner_offset_and_crosses_the_leader() -> None:
    path = Lawnmower(ScenarioSettings(), 1, np.random.default_rng(0)).at(np.array([0.0, 10.0]))
    assert (path.north_m[0], path.east_m[0]) == (50.0, 50.0)
    assert path.east_m[1] > 60
    assert path.yaw_rad[0] == pytest.approx(np.pi / 2)


def test_roll_bias_and_sound_speed_error_bend_the_swath() -> None:
    flat = Seabed(np.full((60, 60), 50.0), -300.0, -300.0, 10.0, 10.0)
    base = {"duration_min": 0.5, "roll_amplitude_deg": 0, "pitch_amplitude_deg": 0, **QUIET}

    def first_swath(**changes: float) -> np.ndarray:
        scenario = replace(named_scenario("paper-1"), {**base, **changes})
        _, ping = next(SimulatedVehicle(scenario, flat, 0, 1).steps())
        assert ping is not None
        points_m, _ = soundings_from_ping(ping, 0.0, 0.0, SonarSettings())
        return points_m[:, 2] - 50.0

    rolled = first_swath(roll_bias_deg=0.2)
    assert np.sign(rolled[0]) == -np.sign(rolled[-1])
    assert abs(rolled[0]) == pytest.approx(69.28 * np.radians(0.2), rel=0.1)
    smile = first_swath(sound_speed_error_mps=2.0)
    assert smile[0] == pytest.approx(smile[-1])
    assert 0.05 < smile[0] - smile[96] < 0.3
    assert np.abs(first_swath()).max() < 1e-3
