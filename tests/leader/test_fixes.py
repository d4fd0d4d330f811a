"""Absolute positions: used where they fit, refused where not, late ones waited for."""

import dataclasses
from collections import Counter

import numpy as np
import pytest

from firmware.inputs import from_odometry, to_odometry
from firmware.leader.core import LeaderCore
from firmware.leader.fixes import Fixes, FixSettings
from firmware.leader.fleet import Fleet, FleetSettings
from firmware.leader.graph_settings import GraphSettings
from firmware.leader.pose_graph import PoseGraph
from firmware.leader.range_judge import RangeSettings
from firmware.leader.range_windows import RangeWindows
from firmware.soundings import Fix, Odometry
from host_tools.mission import local_nodes, run, simulated_vehicles, water_between
from host_tools.mission_settings import MissionSettings, changed
from host_tools.simulator.placement import place_survey
from host_tools.simulator.terrain import open_terrain
from tests.leader.vessels import convoy, leader_of, line, sail


def sailed(seconds: int, fix: Fix | None = None) -> LeaderCore:
    """Return a leader that sailed north, and was told a fix at the last instant."""
    leader = leader_of(line(0.0, 0.0))
    for quarter in range(1, 4 * seconds + 1):
        sail(leader, line(0.0, 0.0), quarter / 4.0, sonar_on=False)
        leader.tick(quarter / 4.0)
    if fix is not None:
        tell(leader, fix, seconds + 0.25)
    return leader


def sample(at_s: float, fix: Fix) -> Odometry:
    return Odometry(
        time_s=at_s,
        velocity_north_mps=2.0,
        velocity_east_mps=0.0,
        yaw_rad=0.0,
        depth_m=10.0,
        fix=fix,
    )


def tell(leader: LeaderCore, fix: Fix, at_s: float) -> None:
    leader.receive_odometry(sample(at_s, fix))
    sail(leader, line(0.0, 0.0), at_s + 1.75, sonar_on=False)
    leader.tick(at_s + 1.75)


def northbound() -> tuple[Fleet, PoseGraph]:
    """Return a leader's fleet and graph after ten minutes to the north at 2 m/s."""
    graph = PoseGraph(GraphSettings())
    fleet = Fleet(graph, RangeWindows(RangeSettings()), FleetSettings())
    for second in range(601):
        fleet.own.add(float(second), 2.0 * second, 0.0, 0.0)
    graph.add_chain(0, 0.0, np.zeros(2), np.zeros(2))
    fleet.extend(0)
    return fleet, graph


def told_off(off_sigmas: float) -> tuple[Counter[str], float, float]:
    """Return what became of a fix so far off to the north, with a sigma of 20 m and a floor of 10.

    And by which shares of innovation and variance it changed the estimate.
    """
    fleet, graph = northbound()
    anchor = graph.anchor(0, 300.0, fleet.track(0))
    known_m2 = graph.covariance([anchor])[0, 0]
    off_m = off_sigmas * np.sqrt(known_m2 + 20.0**2 + 10.0**2)
    fixes = Fixes(FixSettings(sigma_floor_m=10.0), followers=0)
    fixes.hold(300.0, Fix(north_m=600.0 + off_m, east_m=0.0, sigma_m=20.0))
    fixes.use(fleet, graph, 600.0)
    share = (known_m2 + 20.0**2 + 10.0**2) / known_m2  # the inverse of a Kalman gain
    moved = share * (graph.position(anchor)[0] - 600.0) / off_m
    return fixes.counters, moved, share * (1.0 - graph.covariance([anchor])[0, 0] / known_m2)


def test_fix_counts_by_its_sigma_and_a_floor() -> None:
    _, moved, narrowed = told_off(1.0)
    assert (moved, narrowed) == pytest.approx((1.0, 1.0), abs=0.03)


@pytest.mark.parametrize("off_sigmas", [3.6, -3.6, 3.8, -3.8])
def test_fix_is_gated_by_what_is_known_and_its_own_sigma(off_sigmas: float) -> None:
    counters, *_ = told_off(off_sigmas)  # 13.8 is 3.71 squared
    assert counters == {"fixes_used" if abs(off_sigmas) < 3.7 else "fixes_rejected": 1}


@pytest.mark.parametrize(
    ("later_s", "off_m", "sigma_m", "alike"),
    [
        (59.0, 0.0, 2.0, True),
        (-59.0, 0.0, 2.0, True),
        (61.0, 0.0, 2.0, False),
        (-61.0, 0.0, 2.0, False),
        (1.0, 0.0, 1.01, True),
        (1.0, 0.0, 0.99, False),
        (1.0, 16.9, 2.0, True),  # 3 (2 + 2) + 5 * 1
        (1.0, 17.1, 2.0, False),
        (-30.0, 161.0, 2.0, True),  # it may have sailed so far
        (30.0, 163.0, 2.0, False),
    ],
)
@pytest.mark.parametrize("first_is_used", [False, True])
def test_fixes_are_alike_where_one_vehicle_may_be_at_both_within_a_minute(
    later_s: float, off_m: float, sigma_m: float, *, alike: bool, first_is_used: bool
) -> None:
    fixes = Fixes(FixSettings(), followers=0)
    fixes.hold(300.0, Fix(north_m=600.0, east_m=7.0, sigma_m=2.0))
    if first_is_used:
        fixes.use(*northbound(), 600.0)
        assert fixes.counters["fixes_used"] == 1
    fix = Fix(north_m=600.0 + 0.6 * off_m, east_m=7.0 + 0.8 * off_m, sigma_m=sigma_m)
    fixes.hold(300.0 + later_s, fix)
    assert fixes.counters["fixes_alike"] == alike


def test_fixes_that_wait_too_long_find_no_room_or_no_node_are_counted() -> None:
    fleet, graph = northbound()
    fixes = Fixes(FixSettings(held=2), followers=1)
    for time_s in (-300.0, 700.0, 800.0):  # before the first node, and twice yet to come
        overwritten = fixes.counters["fixes_overwritten"]
        fixes.hold(time_s, Fix(north_m=2.0 * time_s, east_m=0.0, sigma_m=2.0))
    assert (overwritten, fixes.counters["fixes_overwritten"]) == (0, 1)
    fixes.use(fleet, graph, 1600.0)
    assert fixes.counters["fixes_too_late"] == 0
    fixes.use(fleet, graph, 1601.0)
    assert fixes.counters["fixes_too_late"] == 1
    fixes.hold(-300.0, Fix(north_m=-600.0, east_m=0.0, sigma_m=2.0))
    fixes.use(fleet, graph, 1601.0)
    assert fixes.counters["fixes_unplaceable"] == 1


def test_fix_moves_the_estimate_and_narrows_it() -> None:
    fix = Fix(north_m=1210.0, east_m=20.0, sigma_m=2.0)
    before, after = sailed(600).belief(), sailed(600, fix).belief()
    assert np.hypot(*(after.position_m - [1213.5, 20.0])) < 3.0
    assert np.trace(after.covariance_m2) < 0.05 * np.trace(before.covariance_m2)


def test_fix_that_the_estimate_finds_impossible_is_counted_and_dropped() -> None:
    leader = sailed(60, Fix(north_m=5000.0, east_m=0.0, sigma_m=2.0))
    assert leader.status()["fixes_rejected"] == 1
    assert leader.belief().position_m[0] == pytest.approx(123.5, abs=3.0)


def test_fixes_in_quick_succession_tell_no_more_than_one() -> None:
    leader = sailed(600)
    for second in range(1, 51):  # all of them 3 m off
        fix = Fix(north_m=1203.5 + 2.0 * second, east_m=0.0, sigma_m=3.0)
        leader.receive_odometry(sample(600.25 + second, fix))
        leader.tick(600.25 + second)
    status, belief = leader.status(), leader.belief()
    assert (status["fixes_used"], status["fixes_alike"]) == (1, 49)
    assert belief.covariance_m2[0, 0] > 2.0**2
    surer = Fix(north_m=belief.position_m[0], east_m=0.0, sigma_m=1.0)
    tell(leader, surer, 650.5)
    assert leader.status()["fixes_used"] == 2


@pytest.mark.parametrize(
    ("north_m", "sigma_m"),
    [(np.nan, 2.0), (120.0, 0.0), (120.0, np.nan), (120.0, np.inf), (120.0, 1e200)],
)
def test_fix_without_numbers_is_counted(north_m: float, sigma_m: float) -> None:
    fix = Fix(north_m=north_m, east_m=0.0, sigma_m=sigma_m)
    assert sailed(60, fix).status()["fixes_bad"] == 1


def test_fix_of_a_follower_waits_for_its_track() -> None:
    sea = convoy().run(0.0, 30.0)
    true_m = (-30.0 + 2.0 * 30.25, 60.0)
    tell(sea.leader, Fix(vehicle=1, north_m=true_m[0], east_m=true_m[1], sigma_m=1.0), 30.25)
    assert "fixes_used" not in sea.leader.status()
    sea.run(32.0, 100.0)
    assert sea.leader.status()["fixes_used"] == 1


def test_fix_of_a_vehicle_that_says_nothing_is_given_up() -> None:
    leader = sailed(60, Fix(vehicle=1, north_m=0.0, east_m=0.0, sigma_m=1.0))
    leader.tick(1200.0)
    assert leader.status()["fixes_too_late"] == 1


@pytest.mark.parametrize("vehicle", [-1, 2])
def test_fix_of_an_unknown_vehicle_is_counted_and_dropped(vehicle: int) -> None:
    leader = sailed(60, Fix(vehicle=vehicle, north_m=0.0, east_m=0.0, sigma_m=1.0))
    assert leader.status()["fixes_of_unknown_vehicles"] == 1


def test_fixes_of_a_follower_leave_room_for_those_of_another() -> None:
    sea = convoy(2).run(0.0, 30.0)
    tell(sea.leader, Fix(vehicle=1, north_m=30.5, east_m=60.0, sigma_m=1.0), 30.25)
    for at_s in np.linspace(32.0, 32.25, 100):
        fix = Fix(vehicle=2, north_m=-60.0 + 2.0 * at_s, east_m=120.0, sigma_m=1.0)
        sea.leader.receive_odometry(sample(at_s, fix))
    status = sea.run(32.25, 100.0).leader.status()
    assert (status["fixes_used"], status["fixes_alike"]) == (2, 99)


def test_a_wild_fix_that_waits_leaves_good_ones_after_it_their_turn() -> None:
    sea = convoy().run(0.0, 30.0)
    for second in range(6):
        at_s = 30.25 + second
        off_m = 2000.0 if second == 0 else 0.0
        fix = Fix(vehicle=1, north_m=-30.0 + 2.0 * at_s + off_m, east_m=60.0, sigma_m=1.0)
        sea.leader.receive_odometry(sample(at_s, fix))
    status = sea.run(36.25, 100.0).leader.status()
    counts = [status[f"fixes_{fate}"] for fate in ("rejected", "used", "alike")]
    assert counts == [1, 1, 4]


def test_odometry_with_a_fix_reads_back_exactly() -> None:
    fix = Fix(vehicle=2, north_m=1 / 3, east_m=-7.0, sigma_m=0.1)
    sample = Odometry(
        time_s=1.0, velocity_north_mps=2.0, velocity_east_mps=0.0, yaw_rad=0.1, depth_m=9.0, fix=fix
    )
    assert to_odometry(from_odometry(sample)) == sample
    assert to_odometry(from_odometry(dataclasses.replace(sample, fix=None))).fix is None


def test_uncertain_start_is_found_by_fixes() -> None:
    misses_m = {}
    for every_min in (0.0, 1.0):
        settings = changed(
            MissionSettings(),
            {
                "duration_min": 5.2,
                "follower_duration_min": 5.0,
                "leg_m": 60.0,
                "beams": 16,
                "followers": 0,
                "start_error_m": 40.0,
                "gnss_fix_every_min": every_min,
            },
        )
        assert settings.leader.graph.start_sigma_m == 40.0
        told = changed(settings, {"leader.graph.start_sigma_m": 1.0})
        assert told.leader.graph.start_sigma_m == 1.0
        site = place_survey(open_terrain(None, 1), settings.scenario, 2)
        vehicles = simulated_vehicles(settings, site, 2)
        leader, _ = local_nodes(settings, vehicles)
        water = water_between(settings, vehicles, 2)
        run({0: leader}, water, duration_s=312.0, tick_s=0.25, record=lambda _: None)
        true_m = vehicles[0].true_position(312.0)[:2]
        misses_m[every_min] = float(np.hypot(*(leader.core.belief().position_m - true_m)))
    assert misses_m[0.0] > 20.0
    assert misses_m[1.0] < 8.0
