"""From pings and odometry to states, soundings and sub-maps."""

import dataclasses

import numpy as np
import pytest

from firmware.compression.settings import BinningSettings
from firmware.dead_reckoning import DeadReckoning, ReckonedState
from firmware.soundings import Odometry, Ping, SonarSettings, soundings_from_ping
from firmware.submap_builder import SubmapBuilder, SubmapSettings

START = ReckonedState(time_s=0.0, north_m=5.0, east_m=-3.0, yaw_rad=0.0, depth_m=10.0)


def ping(**changes: object) -> Ping:
    angles_rad = np.radians([-60.0, 0.0, 60.0])
    level = Ping(
        time_s=0.0,
        slant_ranges_m=40.0 / np.cos(angles_rad),
        beam_angles_rad=angles_rad,
        roll_rad=0.0,
        pitch_rad=0.0,
        yaw_rad=0.0,
        depth_m=10.0,
    )
    return dataclasses.replace(level, **changes)  # type: ignore[arg-type]


def odometry(time_s: float, north_mps: float = 2.0) -> Odometry:
    return Odometry(
        time_s=time_s,
        velocity_north_mps=north_mps,
        velocity_east_mps=0.0,
        yaw_rad=0.0,
        depth_m=10.0,
    )


def test_level_ping_heading_north_spreads_east_and_west_at_seabed_depth() -> None:
    soundings_m, bad = soundings_from_ping(ping(), 100.0, 200.0, SonarSettings())
    reach_m = 40.0 * np.tan(np.radians(60.0))
    expected_m = [[100, 200 - reach_m, 50], [100, 200, 50], [100, 200 + reach_m, 50]]
    assert soundings_m == pytest.approx(np.array(expected_m))
    assert bad == 0


def test_roll_to_starboard_turns_the_port_beams_up_and_lever_arm_follows_heading() -> None:
    rolled, _ = soundings_from_ping(ping(roll_rad=0.1), 0.0, 0.0, SonarSettings())
    assert rolled[2, 2] > 50.0 > rolled[0, 2]
    assert rolled[1, 1] == pytest.approx(-40.0 * np.sin(0.1))
    levered = SonarSettings(lever_forward_m=2.0)
    east, _ = soundings_from_ping(ping(yaw_rad=np.pi / 2), 0.0, 0.0, levered)
    assert east[1, :2] == pytest.approx([0.0, 2.0], abs=1e-9)


@pytest.mark.parametrize("bad_m", [np.nan, np.inf, -5.0, 0.0, 1e9])
def test_beam_that_no_echo_can_make_is_left_out_and_counted(bad_m: float) -> None:
    soundings_m, bad = soundings_from_ping(
        ping(slant_ranges_m=np.array([60.0, bad_m, 60.0])), 0.0, 0.0, SonarSettings()
    )
    assert len(soundings_m) == 2
    assert bad == 1


@pytest.mark.parametrize(
    "change", [{"roll_rad": np.nan}, {"depth_m": 1e6}, {"depth_m": -1e4}, {"depth_m": np.inf}]
)
def test_ping_without_attitude_or_at_no_depth_gives_no_soundings(change: dict[str, float]) -> None:
    soundings_m, bad = soundings_from_ping(ping(**change), 0.0, 0.0, SonarSettings())
    assert soundings_m.shape == (0, 3)
    assert bad == 3


@pytest.mark.parametrize("bad_mps", [np.nan, -32.768, 1e308])
def test_dead_reckoning_keeps_the_last_velocity_through_bad_samples(bad_mps: float) -> None:
    reckoning = DeadReckoning(START)
    for time_s, speed_mps in ((1.0, 2.0), (2.0, bad_mps), (3.0, 2.0)):
        reckoning.receive_odometry(odometry(time_s, speed_mps))
    assert reckoning.state.north_m == pytest.approx(START.north_m + 6.0)
    assert reckoning.bad_samples == 1


@pytest.mark.parametrize("time_s", [-1.0, np.nan, np.inf])
def test_dead_reckoning_drops_samples_from_no_possible_time(time_s: float) -> None:
    reckoning = DeadReckoning(START)
    assert reckoning.receive_odometry(odometry(time_s)) == START
    assert reckoning.bad_samples == 1


@pytest.mark.parametrize("back_s", [3.0, 100.0, 1e5])
def test_dead_reckoning_goes_on_when_its_clock_was_set_back(back_s: float) -> None:
    reckoning = DeadReckoning(dataclasses.replace(START, time_s=back_s))
    for k in range(1, 41):
        reckoning.receive_odometry(odometry(0.25 * k))
    assert reckoning.state.time_s == 10.0
    assert reckoning.state.north_m - START.north_m == pytest.approx(20.0, abs=3.0)
    assert (reckoning.set_back, reckoning.bad_samples) == (1, 5)


@pytest.mark.parametrize("back_s", [0.0, 300.0])
def test_a_clock_set_back_while_there_is_no_bottom_lock_leaves_the_way_unknown(
    back_s: float,
) -> None:
    reckoning = DeadReckoning(dataclasses.replace(START, time_s=399.0))
    for k in range(4):
        reckoning.receive_odometry(odometry(399.25 + 0.25 * k))
    here_m, lost_s = reckoning.state.north_m, 0.0
    for k in range(1, 401):
        reckoning.receive_odometry(odometry(400.0 - back_s + 0.25 * k, np.nan))
        lost_s += reckoning.lost_s
    assert lost_s == pytest.approx(95.0, abs=2.0)
    assert reckoning.state.north_m - here_m <= 20.0
    assert reckoning.state.velocity_mps == (0.0, 0.0)


def test_dead_reckoning_takes_single_late_samples_for_no_clock_set_back() -> None:
    reckoning = DeadReckoning(START)
    for k in range(1, 101):
        for late_s in (0.0, 7.0, 7.0):
            reckoning.receive_odometry(odometry(k - late_s))
    assert reckoning.state.time_s == 100.0
    assert reckoning.set_back == 0


def test_builder_closes_a_submap_when_time_goes_back_within_its_window() -> None:
    builder = SubmapBuilder(
        1, 0, settings=SubmapSettings(), sonar=SonarSettings(), binning=BinningSettings()
    )
    tracks_s = []
    for time_s in (*range(30), *range(10, 45)):
        builder.receive_state(dataclasses.replace(START, time_s=float(time_s)))
        submap = builder.take()
        tracks_s += [] if submap is None else [submap.track.time_s.tolist()]
    assert tracks_s == [list(range(30)), list(range(10, 40))]


def test_builder_closes_a_submap_at_the_end_of_its_window_and_numbers_wrap() -> None:
    builder = SubmapBuilder(
        1,
        3,
        settings=SubmapSettings(duration_s=8.0),
        sonar=SonarSettings(),
        binning=BinningSettings(),
    )
    builder._index = 65535
    reckoning, submaps = DeadReckoning(START), []
    for time_s in np.arange(0.0, 24.25, 0.25):
        state = reckoning.receive_odometry(odometry(float(time_s)))
        builder.receive_state(state)
        submap = builder.take()
        submaps += [submap] if submap else []
        builder.receive_ping(ping(time_s=float(time_s)), state)
    assert [(s.index, s.boot_epoch) for s in submaps] == [(65535, 3), (0, 3), (1, 3)]
    assert submaps[1].track.time_s.tolist() == list(np.arange(8.0, 16.0))
    assert (submaps[1].bins.time_s >= 8.0).all()
    assert (submaps[1].bins.time_s < 16.0).all()


@pytest.mark.parametrize("late_s", [-0.5, 0.0, 0.75])
def test_a_ping_between_two_states_is_placed_where_the_vehicle_was(late_s: float) -> None:
    builder = SubmapBuilder(
        1, 0, settings=SubmapSettings(), sonar=SonarSettings(), binning=BinningSettings()
    )
    state = DeadReckoning(START).receive_odometry(odometry(1.0))
    builder.receive_state(state)
    builder.receive_ping(ping(time_s=1.0 + late_s), state)
    builder.receive_state(dataclasses.replace(state, time_s=41.0))
    submap = builder.take()
    assert submap is not None
    assert submap.bins.north_m == pytest.approx(START.north_m + 2.0 * (1.0 + late_s))


@pytest.mark.parametrize("time_s", [4.25, 1.7e9, -1e7, np.nan])
def test_a_ping_of_another_time_than_navigation_has_no_place(time_s: float) -> None:
    builder = SubmapBuilder(
        1, 0, settings=SubmapSettings(), sonar=SonarSettings(), binning=BinningSettings()
    )
    state = DeadReckoning(START).receive_odometry(odometry(1.0))
    for at_s in (1.0, time_s):
        builder.receive_state(state)
        builder.receive_ping(ping(time_s=at_s), state)
    builder.receive_state(dataclasses.replace(state, time_s=41.0))
    submap = builder.take()
    assert submap is not None
    assert (submap.bins.time_s == 1.0).all()
    assert builder.bad_pings == 1
