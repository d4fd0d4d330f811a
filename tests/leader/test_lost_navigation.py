"""Navigation that is away for a minute: what nobody measured is doubted, not believed."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from firmware.belief import Belief
from firmware.dead_reckoning import LOST_SIGMA_MPS
from firmware.follower.core import FollowerCore
from firmware.leader.atlas import SheetId
from firmware.leader.chains import Chain
from firmware.leader.composition import CompositionSettings
from firmware.leader.core import LeaderCore
from firmware.leader.judgement import JudgementSettings, _Odometry
from firmware.soundings import Fix, Odometry, Ping
from firmware.submaps import Track
from tests.leader.vessels import ANGLES_RAD, SHORT, Convoy, follower_of, leader_of, line, sail

LOST_S = (200.0, 260.0)


def corner(time_s: float) -> tuple[float, float]:
    """Return a way north that turns east while navigation is lost."""
    return (2.0 * time_s, 60.0) if time_s < 220.0 else (440.0, 60.0 + 2.0 * (time_s - 220.0))


def steer(core: FollowerCore | LeaderCore, time_s: float, how: str, fix: Fix | None = None) -> None:
    """Feed navigation around the corner: there, without velocities or with marks, or not at all."""
    is_lost = LOST_S[0] <= time_s < LOST_S[1]
    if is_lost and how == "away":
        return
    velocity_mps = np.subtract(corner(time_s), corner(time_s - 0.25)) * 4.0
    if is_lost and how == "without bottom":
        velocity_mps = np.full(2, np.nan)
    if is_lost and how == "marked":
        velocity_mps = np.full(2, -32.768)
    core.receive_odometry(
        Odometry(
            time_s=time_s,
            velocity_north_mps=float(velocity_mps[0]),
            velocity_east_mps=float(velocity_mps[1]),
            yaw_rad=0.0 if time_s < 220.0 else np.pi / 2,
            depth_m=10.0,
            fix=fix,
        )
    )


def ping_at(time_s: float) -> Ping:
    """Return a ping of a level seabed 40 m below."""
    return Ping(
        time_s=time_s,
        slant_ranges_m=40.0 / np.cos(ANGLES_RAD),
        beam_angles_rad=ANGLES_RAD,
        roll_rad=0.0,
        pitch_rad=0.0,
        yaw_rad=0.0,
        depth_m=10.0,
    )


def chi_square(belief: Belief) -> float:
    error_m = belief.position_m - corner(belief.time_s)
    return float(error_m @ np.linalg.solve(belief.covariance_m2, error_m))


@pytest.mark.parametrize("how", ["away", "without bottom", "marked"])
def test_a_leader_doubts_where_it_is_and_believes_the_next_fix(how: str) -> None:
    leader = leader_of(corner)
    for quarter in range(1, 4 * 420 + 1):
        now_s = quarter / 4.0
        has_fix = now_s % 20.0 == 0.0 and not LOST_S[0] <= now_s <= 360.0
        north_m, east_m = corner(now_s)
        fix = Fix(vehicle=0, north_m=north_m, east_m=east_m, sigma_m=3.0) if has_fix else None
        steer(leader, now_s, how, fix)
        leader.tick(now_s)
        if now_s in (270.0, 350.0):
            assert np.hypot(*(leader.belief().position_m - corner(now_s))) > 50.0
            assert chi_square(leader.belief()) < 6.0
    assert "fixes_rejected" not in leader.status()
    assert leader.belief().position_m == pytest.approx(corner(420.0), abs=10.0)
    assert chi_square(leader.belief()) < 6.0


def test_a_fix_while_navigation_is_lost_is_used() -> None:
    leader = leader_of(corner)
    for quarter in range(1, 4 * 270 + 1):
        now_s = quarter / 4.0
        fix = Fix(vehicle=0, north_m=440.0, east_m=120.0, sigma_m=3.0) if now_s == 250.0 else None
        steer(leader, now_s, "without bottom", fix)
        leader.tick(now_s)
    assert leader.status()["fixes_used"] == 1
    sigma_m = np.sqrt(leader.belief().covariance_m2[0, 0])
    assert chi_square(leader.belief()) < 6.0
    assert sigma_m < 120.0


def test_a_fix_is_no_surer_of_a_node_than_the_way_there_that_nobody_measured() -> None:
    leader = leader_of(corner)
    for quarter in range(1, 4 * 320 + 1):
        now_s = quarter / 4.0
        north_m, east_m = corner(now_s)
        fix = Fix(vehicle=0, north_m=north_m, east_m=east_m, sigma_m=1.0)
        is_up = now_s == 248.0  # some seconds after a node
        steer(leader, now_s, "without bottom", fix if is_up else None)
        leader.tick(now_s)
    assert leader.status()["fixes_used"] == 1
    chain = leader.graph._chains[0]
    node = chain.nearest(240.0)
    error_m = leader.trajectory(0).position_m[node] - corner(240.0)
    known_m2 = leader.graph._solver.covariance([chain.keys[node]])[:2, :2]
    assert error_m @ np.linalg.solve(known_m2, error_m) < 9.0


def test_closures_before_and_after_navigation_was_lost_do_not_contradict_each_other() -> None:
    graph = leader_of(corner).graph
    ends_s = [(100.0, 150.0), (180.0, 260.0)]
    closures: list[Any] = [
        SimpleNamespace(
            origin=SheetId(vehicle=0, boot_epoch=0, submap=1),
            target=SheetId(vehicle=0, boot_epoch=0, submap=2),
            origin_anchor=SimpleNamespace(time_s=begin_s),
            target_anchor=SimpleNamespace(time_s=end_s),
            origin_reckoned_m=np.zeros(2),
            target_reckoned_m=np.zeros(2),
        )
        for begin_s, end_s in ends_s
    ]
    ways = np.array([1, 2]), np.array([3, 3])  # from 150 and 180 s to 260 s
    _, before_m2 = _Odometry(closures, graph, JudgementSettings())(*ways)
    graph.lose(0, 160.0, 240.0)
    _, doubted_m2 = _Odometry(closures, graph, JudgementSettings())(*ways)
    added_m2 = doubted_m2 - before_m2
    assert added_m2[0] == pytest.approx(LOST_SIGMA_MPS**2 * 80.0**2 * np.eye(2))
    assert added_m2[1] == pytest.approx(LOST_SIGMA_MPS**2 * (80.0**2 - 20.0**2) * np.eye(2))


@pytest.mark.parametrize("how", ["away", "without bottom"])
def test_a_follower_doubts_where_it_is_and_the_leader_does_too(how: str) -> None:
    path = line(0.0, 0.0)
    leader, follower = leader_of(path), follower_of(corner)
    crew = Convoy(leader=leader, leader_path=path, followers={})
    for quarter in range(1, 4 * 400 + 1):
        now_s = quarter / 4.0
        if LOST_S[0] <= now_s < LOST_S[1] or now_s > 265.0:
            steer(follower, now_s, how)  # and no sonar: nothing but the way tells of the corner
        else:
            sail(follower, corner, now_s)
        crew.run(now_s - 0.25, now_s)
        follower.tick(now_s)
        frame = follower.poll(now_s)
        if frame is not None:
            leader.receive_frame(frame, None, now_s + 1.0)
    assert follower.status()["navigation_lost"] == 1
    assert np.hypot(*(follower.belief().position_m - corner(400.0))) > 50.0
    assert chi_square(follower.belief()) < 6.0
    assert leader.status()["restarts"] == 1
    newest = leader.fleet.newest_chain(1)
    track = leader.fleet.track(newest)
    at_s = float(track.time_s[-1])
    assert at_s > 300.0
    believed = Belief(
        time_s=at_s,
        position_m=leader.graph.position(leader.graph.anchor(newest, at_s, track)),
        covariance_m2=leader.graph.predicted_covariance(newest, at_s),
    )
    assert np.hypot(*(believed.position_m - corner(at_s))) > 50.0
    assert chi_square(believed) < 6.0


def test_nothing_that_is_seen_while_navigation_is_lost_is_mapped() -> None:
    """The sonar goes on, but nobody knows where it looks; what was seen before stands by itself."""
    follower, leader = follower_of(corner), leader_of(corner)
    for core in (follower, leader):
        for quarter in range(1, 4 * 300 + 1):
            now_s = quarter / 4.0
            if LOST_S[0] <= now_s < LOST_S[1]:
                steer(core, now_s, "without bottom")
                core.receive_ping(ping_at(now_s))
            else:
                sail(core, corner, now_s)
            core.tick(now_s)
    times_s = [sheet.grid.time_s[np.isfinite(sheet.grid.depth_m)] for sheet in leader.atlas]
    assert all(seen_s.max() <= 211.0 or seen_s.min() >= 259.0 for seen_s in times_s)
    assert any(205.0 <= seen_s.max() <= 211.0 for seen_s in times_s)
    assert any(seen_s.min() >= 259.0 for seen_s in times_s)
    for core in (follower, leader):
        assert core.status()["bad_pings"] == 4 * 50


def test_one_loss_is_one_boot_whatever_stamps_come_in_it() -> None:
    follower = follower_of(corner)
    for quarter in range(1, 4 * 280 + 1):
        now_s = quarter / 4.0
        steer(follower, now_s, "without bottom")
        if LOST_S[0] < now_s < LOST_S[1] and now_s % 5.0 == 0.0:
            for bad_s in (np.nan, 100.0, now_s):
                follower.receive_odometry(
                    Odometry(
                        time_s=bad_s,
                        velocity_north_mps=np.nan if bad_s == now_s else 2.0,
                        velocity_east_mps=0.0,
                        yaw_rad=0.0,
                        depth_m=10.0,
                    )
                )
    assert follower.status()["navigation_lost"] == 1


def test_a_bottom_that_comes_and_goes_begins_no_boots_and_ends_no_sub_maps() -> None:
    """One velocity in six seconds, around a circle: the way is known, and doubted."""

    def circle(time_s: float) -> tuple[float, float]:
        angle = time_s / 60.0
        return 120.0 * float(np.sin(angle)), 120.0 * (1.0 - float(np.cos(angle)))

    beliefs = []
    for every in (1, 24):
        follower = follower_of(circle)
        for quarter in range(1, 4 * 600 + 1):
            now_s = quarter / 4.0
            velocity_mps = np.subtract(circle(now_s), circle(now_s - 0.25)) * 4.0
            if quarter > 1 and quarter % every:
                velocity_mps = np.full(2, np.nan)
            follower.receive_odometry(
                Odometry(
                    time_s=now_s,
                    velocity_north_mps=float(velocity_mps[0]),
                    velocity_east_mps=float(velocity_mps[1]),
                    yaw_rad=float(np.angle(np.exp(1j * now_s / 60.0))),
                    depth_m=10.0,
                )
            )
            follower.receive_ping(ping_at(now_s))
            follower.tick(now_s)
            follower.poll(now_s)
        beliefs.append(follower.belief())
        assert follower.status().get("navigation_lost", 0) == 0
        assert follower._builder._index == 600 // SHORT.duration_s
    assert beliefs[1].position_m == pytest.approx(beliefs[0].position_m, abs=0.5)
    assert beliefs[1].covariance_m2[0, 0] > beliefs[0].covariance_m2[0, 0] + 100.0


def test_a_short_loss_costs_no_more_doubt_than_it_is_long() -> None:
    """What was measured before it is sent by itself: the leader's gap is the loss, no more."""
    path = line(0.0, 60.0)
    leader, follower = leader_of(line(0.0, 0.0)), follower_of(path)
    crew = Convoy(leader=leader, leader_path=line(0.0, 0.0), followers={})
    for quarter in range(1, 4 * 200 + 1):
        now_s = quarter / 4.0
        crew.run(now_s - 0.25, now_s)
        if not 110.0 <= now_s < 122.0:
            sail(follower, path, now_s)
        follower.tick(now_s)
        frame = follower.poll(now_s)
        if frame is not None:
            leader.receive_frame(frame, None, now_s + 1.0)
    before, after = sorted(leader.graph.chains())[1:]
    gap_s = leader.fleet.track(after).time_s[0] - leader.fleet.track(before).time_s[-1]
    assert 10.0 < gap_s < 17.0


def test_a_clock_that_was_ahead_and_is_set_right_leaves_an_honest_sigma() -> None:
    """A fix while it was ahead has a node there; what is believed of now hangs on those before."""
    leader = leader_of(corner)
    for quarter in range(1, 4 * 150):
        now_s = quarter / 4.0
        is_ahead = 100.0 < now_s <= 120.0
        north_m, east_m = corner(now_s)
        fix = Fix(vehicle=0, north_m=north_m, east_m=east_m, sigma_m=2.0) if is_ahead else None
        steer(leader, now_s + 1000.0 * is_ahead, "there", fix)
        leader.tick(now_s + 1000.0 * is_ahead)
    assert leader.belief().time_s == 149.75
    assert (np.linalg.eigvalsh(leader.belief().covariance_m2) > 0.0).all()
    assert chi_square(leader.belief()) < 6.0


def test_spans_told_by_a_clock_that_was_set_back_are_all_doubted() -> None:
    graph = leader_of(corner).graph
    for begin_s, end_s in ((100.0, 150.0), (50.0, 55.0), (55.0, 60.0)):
        graph.lose(0, begin_s, end_s)
    assert graph._chains[0].lost == [(100.0, 150.0), (50.0, 60.0)]


def test_span_that_is_told_late_takes_no_doubt_from_another() -> None:
    """A clock was set back: what is lost then comes before what was doubted."""
    chain = Chain(number=0, parameters=0)
    chain.lose(900.0, 1200.0)
    chain.lose(600.0, 1300.0)
    assert chain.lost_m2(600.0, 900.0) > 0.0
    for k in range(1100):
        chain.lose(2000.0 + 10.0 * k, 2001.0 + 10.0 * k)
    chain.lose(20_000.0, 20_300.0)
    ends_s = np.arange(20_010.0, 20_310.0, 10.0)
    doubted_m2 = [chain.lost_m2(20_000.0, end_s) for end_s in ends_s]
    for k in range(30):
        chain.lose(19_703.0 + 10.0 * k, 19_704.0 + 10.0 * k)
    chain.lose(20_100.0, 20_101.0)
    assert len(chain.lost) <= 1024
    assert all(begin_s < end_s for begin_s, end_s in chain.lost)
    for end_s, before_m2 in zip(ends_s, doubted_m2, strict=True):
        assert chain.lost_m2(20_000.0, end_s) >= before_m2


def test_the_composed_past_doubts_ways_that_nobody_measured_as_well() -> None:
    graph = leader_of(corner).graph
    times_s = np.arange(3001.0)
    track = Track(time_s=times_s, north_m=times_s, east_m=0 * times_s, yaw_rad=0 * times_s)
    graph.lose(0, 1204.75, 1259.75)
    graph.extend(0, track)
    before_m2 = graph.anchor(0, 1236.0, track).apart_m2
    graph.compose(3000.0, CompositionSettings())
    assert before_m2[0, 0] > 40.0**2
    assert graph.anchor(0, 1236.0, track).apart_m2[0, 0] >= before_m2[0, 0]
