"""A follower's boots as its leader tells them apart: restarts, late frames, jumps, clocks."""

import dataclasses
import itertools

import numpy as np
import pytest

from firmware.leader.composition import CompositionSettings
from firmware.leader.fleet import Fleet, FleetSettings
from firmware.leader.graph_settings import GraphSettings
from firmware.leader.ledger import TieRecord
from firmware.leader.pose_graph import PoseGraph
from firmware.leader.range_judge import RangeSettings
from firmware.leader.range_windows import RangeWindows
from firmware.submaps import Track
from protocol.codec import decode
from tests.leader.vessels import (
    changed,
    convoy,
    follower_of,
    sailed,
    sheets_of,
    trajectory,
    walked,
)


def test_restarted_follower_goes_on_as_a_new_chain_tied_loosely_to_the_old() -> None:
    one = convoy().run(0.0, 100.0)
    old, old_track = sheets_of(one.leader), one.leader.track(1)
    path = one.followers[1][1]  # dead reckoning begins anew, somewhere else
    begun_anew = follower_of(path, boot_epoch=1, at_s=110.0, off_m=(200.0, -500.0))
    one.followers[1] = (begun_anew, path)
    one.run(110.0, 210.0)
    sheets = sheets_of(one.leader)
    assert set(old) <= set(sheets)
    assert (1, 0) in sheets
    assert one.leader.vehicles() == [0, 1]
    assert len(one.leader.track(1).time_s) > len(old_track.time_s)
    assert one.leader.status()["restarts"] == 1
    link_m2 = one.leader.graph.covariance([one.leader.anchor(1, 120.0)])
    assert 3.0 < np.sqrt(link_m2[0, 0]) < 200.0
    here_m = one.leader.graph.position(one.leader.anchor(1, 120.0))
    was_m = one.leader.graph.position(one.leader.anchor(1, 80.0))
    assert np.hypot(*(here_m - was_m)) < 250.0


def test_restart_with_dead_reckoning_unbroken_keeps_a_tight_link() -> None:
    one = convoy().run(0.0, 100.0)
    path = one.followers[1][1]
    one.followers[1] = (follower_of(path, boot_epoch=1, at_s=110.0), path)
    one.run(110.0, 200.0)
    link_m2 = one.leader.graph.covariance([one.leader.anchor(1, 120.0)])
    assert np.sqrt(link_m2[0, 0]) < 30.0


@pytest.mark.parametrize("last_s", range(162, 182, 4))
def test_restart_is_tied_to_the_old_chain_whenever_it_comes(last_s: int) -> None:
    leader = sailed(100.0)
    for time_s in range(101, 400):
        leader.fleet.own.add(float(time_s), 2.0 * time_s, 0.0, 0.0)
    for boot, times_s in ((0, range(106, last_s, 4)), (1, range(last_s + 10, last_s + 70, 4))):
        for first_s in times_s:  # slices of four seconds, as the paper's frames carry them
            header = decode(trajectory(walked(4, 0.0), float(first_s))).header
            header = dataclasses.replace(header, boot_epoch=boot)
            states, now_s = walked(4, 2.0 * first_s), first_s + 44.0
            assert leader.fleet.admit(header, now_s)
            leader._arrivals._receive_states(header, float(first_s), states, now_s)
    assert leader.status()["restarts"] == 1
    newest, graph = leader.fleet.newest_chain(1), leader.graph
    (tie,) = [e.record for e in graph._ledger.values() if isinstance(e.record, TieRecord)]
    assert tie.target == graph._chains[newest].keys[0]
    assert tie.position_sigma_m < 10.0


def test_restarts_beyond_the_header_s_four_bits_are_still_told_apart() -> None:
    leader = sailed(40.0)
    for boot in range(20):
        frame = changed(
            trajectory(walked(20, 300.0 * (boot % 2)), 20.0 * boot), boot_epoch=boot % 16
        )
        leader.receive_frame(frame, None, 20.0 * boot + 20.0)
    assert leader.status()["restarts"] == 19
    assert len(leader.graph.chains()) == 21
    assert leader.vehicles() == [0, 1]


def test_two_senders_of_one_number_begin_no_boots_without_end() -> None:
    leader = sailed(40.0)
    for k in range(60):
        first_s, boot = 4.0 * k, (3, 5)[k % 2]
        frame = changed(trajectory(walked(4, 2.0 * first_s), first_s), boot_epoch=boot)
        leader.receive_frame(frame, None, first_s + 20.0)
    assert leader.status()["restarts"] == leader.status()["boots_refused"] == 20
    assert len(leader.graph.chains()) == 22
    assert len(leader.fleet.track(leader.fleet.newest_chain(1)).time_s) > 60
    frame = changed(trajectory(walked(4, 0.0), 3900.0), boot_epoch=5)
    leader.receive_frame(frame, None, 3920.0)
    assert leader.status()["restarts"] == 21


def test_two_senders_of_one_epoch_begin_no_boots_without_end() -> None:
    leader = sailed(40.0)
    for k in range(60):
        states = walked(20, 40.0 * k + 5000.0 * (k // 2 % 2))
        leader.receive_frame(trajectory(states, 20.0 * k), None, 20.0 * k + 20.0)
    assert leader.status()["lasting_jumps"] == 20
    assert leader.status()["boots_refused"] > 0
    assert len(leader.graph.chains()) == 22


def test_late_frame_of_an_earlier_boot_does_not_start_another() -> None:
    leader = sailed(40.0)
    for boot, first_s in ((0, 20.0), (1, 60.0), (0, 40.0), (1, 80.0)):
        leader.receive_frame(
            changed(trajectory(walked(20, 2.0 * first_s), first_s), boot_epoch=boot), None, 100.0
        )
    assert leader.status()["restarts"] == 1
    assert len(leader.track(1).time_s) == 80


@pytest.mark.parametrize("epoch", range(1, 16))
def test_late_frame_is_none_of_a_new_boot_however_far_epochs_lie_apart(epoch: int) -> None:
    """A life that no disk counts takes its epoch from the clock."""
    leader = sailed(40.0)
    for boot, first_s in ((0, 20.0), (epoch, 60.0), (0, 40.0), (epoch, 80.0)):
        leader.receive_frame(
            changed(trajectory(walked(20, 2.0 * first_s), first_s), boot_epoch=boot), None, 100.0
        )
    assert leader.status()["restarts"] == 1
    assert [len(leader.fleet.track(chain).time_s) for chain in leader.graph.chains()[1:]] == [
        40,
        40,
    ]


def test_restart_whose_epoch_was_used_long_ago_is_not_late_by_a_clock_set_back() -> None:
    leader = sailed(40.0)
    for boot in range(17):
        first_s = 20.0 * boot - 30.0 * (boot == 16)
        frame = changed(trajectory(walked(20, 300.0 * (boot % 2)), first_s), boot_epoch=boot % 16)
        leader.receive_frame(frame, None, 20.0 * boot + 20.0)
    assert leader.status()["restarts"] == 16


def test_late_frame_of_a_boot_never_heard_does_not_start_another() -> None:
    leader = sailed(40.0)
    for boot, first_s in ((1, 60.0), (0, 20.0), (1, 80.0)):
        leader.receive_frame(
            changed(trajectory(walked(20, 2.0 * first_s), first_s), boot_epoch=boot), None, 100.0
        )
    assert leader.status().get("restarts", 0) == 0
    assert len(leader.graph.chains()) == 3
    assert leader.track(1).time_s == pytest.approx([*range(20, 40), *range(60, 100)])


def test_late_frame_of_an_earlier_boot_is_known_after_a_lasting_jump() -> None:
    leader = sailed(40.0)
    for time_s in range(41, 400):
        leader.fleet.own.add(float(time_s), 2.0 * time_s, 0.0, 0.0)
    jumped = [(5, 140.0 + 20.0 * k, 5000.0 + 40.0 * k, 220.0) for k in range(3)]
    for boot, first_s, north_m, now_s in (
        *((4, 40.0, 80.0, 100.0), (4, 60.0, 120.0, 100.0)),
        *((5, 100.0, 200.0, 150.0), (5, 120.0, 240.0, 150.0)),
        *(*jumped, (4, 80.0, 160.0, 225.0)),
    ):
        frame = changed(trajectory(walked(20, north_m), first_s), boot_epoch=boot)
        leader.receive_frame(frame, None, now_s)
    assert leader.status()["lasting_jumps"] == 1
    assert len(leader.graph.chains()) == 4
    assert leader.fleet.track(leader.graph.chains()[1]).time_s == pytest.approx(np.arange(40, 100))


def test_late_frame_of_a_boot_never_heard_founds_none_among_many() -> None:
    leader = sailed(40.0)
    for time_s in range(41, 900):
        leader.fleet.own.add(float(time_s), 2.0 * time_s, 0.0, 0.0)
    boots = [*range(3, 19), 20]
    for k, boot in enumerate(boots):
        frame = changed(trajectory(walked(20, 800.0 * k), 40.0 * k), boot_epoch=boot % 16)
        leader.receive_frame(frame, None, 40.0 * k + 30.0)
    late = changed(trajectory(walked(20, 9000.0), 40.0 * 15 + 20.0), boot_epoch=19 % 16)
    leader.receive_frame(late, None, 700.0)
    frame = changed(trajectory(walked(20, 800.0 * 16 + 40.0), 660.0), boot_epoch=20 % 16)
    leader.receive_frame(frame, None, 700.0)
    assert leader.status()["restarts"] == len(boots) - 1


def test_trajectory_that_jumps_for_a_moment_loses_those_states_alone() -> None:
    leader = sailed()
    states = walked(20, 0.0)
    states[7:10, 0] += 5000.0
    leader.receive_frame(trajectory(states, 60.0), None, 100.0)
    assert leader.status()["states_that_jump"] == 3
    assert len(leader.track(1).time_s) == 17


def test_trajectory_that_jumps_for_good_goes_on_as_a_new_chain() -> None:
    leader = sailed()
    leader.receive_frame(trajectory(walked(20, 0.0), 20.0), None, 100.0)
    for k in range(3):
        leader.receive_frame(trajectory(walked(20, 5000.0 + 40.0 * k), 40.0 + 20 * k), None, 100.0)
    assert leader.status()["lasting_jumps"] == 1
    assert leader.track(1).north_m.max() > 5000.0
    assert leader.vehicles() == [0, 1]


def test_lasting_jump_is_found_in_packets_that_overlap() -> None:
    leader = sailed()
    for first_s in range(0, 80, 4):
        states = walked(20, 2.0 * first_s)
        states[np.arange(first_s, first_s + 20) >= 40, 0] += 500.0
        leader.receive_frame(trajectory(states, float(first_s)), None, 100.0)
    assert leader.status()["lasting_jumps"] == 1
    assert leader.track(1).north_m.max() > 500.0


def test_lasting_jump_at_the_end_of_a_packet_silences_nobody() -> None:
    leader = sailed()
    for first_s in (0.0, 20.0, 40.0):
        leader.receive_frame(trajectory(walked(20, 2.0 * first_s), first_s), None, 100.0)
    states = walked(40, 120.0)
    states[10:, 0] += 500.0
    header = decode(trajectory(walked(20, 0.0), 60.0)).header
    assert leader.fleet.admit(header, 104.0)
    leader._arrivals._receive_states(header, 60.0, states, 104.0)
    assert leader.status()["lasting_jumps"] == 1
    assert leader.poll(111.0) is not None


def test_follower_whose_clock_is_set_back_is_heard_again() -> None:
    leader = sailed()
    for now_s in range(20, 300, 20):
        theirs_s = now_s - (60.0 if now_s >= 100 else 20.0)
        leader.receive_frame(trajectory(walked(20, 2.0 * now_s), theirs_s), None, float(now_s))
    assert leader.track(1).time_s[-1] >= 239.0
    assert leader.vehicles() == [0, 1]


@pytest.mark.parametrize("jump_m", [0.0, 300.0])
def test_track_after_a_clock_was_set_back_is_where_it_was_or_the_tie_says_so(jump_m: float) -> None:
    leader = sailed()
    for time_s in range(101, 1000):
        leader.fleet.own.add(float(time_s), 2.0 * time_s, 0.0, 0.0)
    for first_s in range(0, 900, 20):
        theirs_s = first_s - 100.0 * (first_s >= 600)
        states = walked(20, 2.0 * first_s + jump_m * (first_s >= 600))
        leader.receive_frame(trajectory(states, theirs_s), None, first_s + 40.0)
    assert leader.status()["lasting_jumps"] == 1
    for whole in (leader.track(1), leader.trajectory(1)):
        assert np.all(np.diff(whole.time_s) > 0.0)
    newest, graph = leader.fleet.newest_chain(1), leader.graph
    track = leader.fleet.track(newest)
    begun_s, true_m = float(track.time_s[0]), np.array([track.north_m[0] - jump_m, 0.0])
    miss_m = graph.position(graph.anchor(newest, begun_s, track)) - true_m
    assert np.hypot(*miss_m) < 1.5 * jump_m + 5.0
    assert miss_m @ np.linalg.solve(graph.predicted_covariance(newest, begun_s), miss_m) < 3.0
    (tie,) = [e.record for e in graph._ledger.values() if isinstance(e.record, TieRecord)]
    miss_m = tie.moved_m - (true_m - [2.0 * 590.0, 0.0])  # from the last node before
    assert np.hypot(*miss_m) < 1.8 * tie.position_sigma_m


def fleet_of(boots: int, end_s: int = 1200) -> tuple[Fleet, PoseGraph]:
    """Return a leader and a follower that has booted so often, each boot going on at once."""
    graph = PoseGraph(GraphSettings())
    graph.add_chain(0, 0.0, np.zeros(2), np.zeros(2))
    settings = FleetSettings(oldest_state_s=float(end_s))
    fleet = Fleet(graph, RangeWindows(RangeSettings()), settings)
    for second in range(end_s + 1):
        fleet.own.add(float(second), 2.0 * second, 0.0, 0.0)
    begins_s = np.linspace(0, end_s, boots, endpoint=False).astype(int).tolist()
    for boot, (first_s, last_s) in enumerate(itertools.pairwise([*begins_s, end_s])):
        header = decode(trajectory(walked(4, 0.0), float(first_s))).header
        header = dataclasses.replace(header, boot_epoch=boot)
        states = walked(last_s - first_s, 2.0 * first_s)
        assert fleet.admit(header, float(end_s))
        kept = fleet.receive_states(header, float(first_s), states, float(end_s))
        assert kept is not None
        fleet.extend(kept[0])
    return fleet, graph


def test_dead_reckoning_alone_knows_a_new_boot_as_well_as_all_that_nothing_measured() -> None:
    fleet, graph = fleet_of(boots=2)
    chains = [0, fleet.newest_chain(1)]
    joint, reckoned = (graph.newest_covariance(chains, reckoned=r) for r in (False, True))
    np.testing.assert_allclose(reckoned, joint, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("boots", [2, 6])
def test_past_with_restarts_is_composed(boots: int) -> None:
    fleet, graph = fleet_of(boots, end_s=3600)
    for time_s in range(0, 3600, 400):
        for vehicle in (0, 1):
            chain = fleet.chain_at(vehicle, float(time_s))
            track = fleet.track(chain)
            anchor = graph.anchor(chain, float(time_s), track)
            graph.add_absolute(anchor, track.position_at(float(time_s)), 4.0 * np.eye(2))
    graph.compose(3600.0, CompositionSettings())
    assert graph.nodes < 0.6 * 720
    estimate = fleet.whole_trajectory(1)
    np.testing.assert_allclose(estimate.position_m, estimate.reckoned_m, atol=0.1)


def test_only_where_vehicles_are_now_and_their_parameters_are_eliminated_last() -> None:
    """However often they came back, and though a composed ledger tells of that first."""
    _, graph = fleet_of(boots=6, end_s=3600)
    graph.update()
    assert graph._solver._last.size() == 4
    graph.compose(3600.0, CompositionSettings())
    assert graph._solver._last.size() == 4


def test_dead_reckoning_alone_is_told_of_a_boot_after_hours_unheard() -> None:
    graph = PoseGraph(GraphSettings())
    time_s = np.arange(301.0)
    track = Track(time_s=time_s, north_m=2 * time_s, east_m=0 * time_s, yaw_rad=0 * time_s)
    graph.add_chain(0, 0.0, np.zeros(2), np.zeros(2))
    graph.extend(0, track)
    graph.add_boot(16, 7200.0, np.zeros(2), after=0, reached_m=np.zeros(2), sigma_m=2e4)
    later = dataclasses.replace(track, time_s=track.time_s + 7200.0)
    graph.extend(16, later)
    graph.add_absolute(graph.anchor(16, 7200.0, later), np.zeros(2), np.eye(2))
    reckoned = graph.newest_covariance([16], reckoned=True)
    assert graph.rebuilds == 0
    assert np.sqrt(reckoned[0, 0]) == pytest.approx(2e4, rel=0.01)


def test_restarts_tell_nothing_of_drift_compass_or_log() -> None:
    known = []
    for boots in (1, 10):
        fleet, graph = fleet_of(boots)
        newest = fleet.newest_chain(1)
        drift = graph.newest_covariance([0, newest], reckoned=False)[[2, 6], [2, 6]]
        parameters = graph._chains[newest].parameters
        known.append([*drift, *np.diag(graph._solver.covariance([parameters]))])
    assert np.all(np.array(known[1]) >= 0.999 * np.array(known[0]))
