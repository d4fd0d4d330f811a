"""The leader's core, driven by followers' cores and by everything that goes wrong."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from firmware.leader.core import LeaderCore
from firmware.leader.settings import LeaderSettings, reassembly_of
from protocol.codec import decode, encode
from protocol.packets import (
    Answer,
    ExtendedAnswer,
    Header,
    Packet,
    Profile,
    SubmapPacket,
    TrajectoryPacket,
)
from protocol.schedule import Slots, SlotSettings
from tests.leader.vessels import Convoy, convoy, follower_of, leader_of, line, sail, slots_of


def frames_of(**changes: Any) -> list[tuple[bytes, float]]:
    """Return what a follower transmits in 100 s, and when."""
    one = convoy(lose=lambda *_: True, **changes).run(0.0, 100.0)
    return [(encode(packet), sent_s) for packet, sent_s in one.up]


FRAMES = frames_of(profile="paper")


def sailed(until_s: float = 100.0) -> LeaderCore:
    """Return a leader that has surveyed alone."""
    return alone(until_s).leader


def alone(until_s: float) -> Convoy:
    path = line(0.0, 0.0)
    return Convoy(leader=leader_of(path), leader_path=path, followers={}).run(0.0, until_s)


def hear(leader: LeaderCore, frames: list[bytes], now_s: float = 100.0) -> LeaderCore:
    for frame in frames:
        leader.receive_frame(frame, None, now_s)
    leader.tick(now_s)
    leader.tick(now_s + 300.0)  # whatever is still open is closed by its deadline
    return leader


def sheets_of(leader: LeaderCore, vehicle: int = 1) -> list[tuple[int, int]]:
    return sorted((s.id.boot_epoch, s.id.submap) for s in leader.atlas if s.id.vehicle == vehicle)


def changed(frame: bytes, **changes: object) -> bytes:
    packet = decode(frame)
    header = dataclasses.replace(packet.header, **changes)  # type: ignore[arg-type]
    return encode(dataclasses.replace(packet, header=header))


def trajectory(states: np.ndarray, first_s: float, *, vehicle: int = 1) -> bytes:
    header = Header(
        profile=Profile.TRAJECTORY,
        vehicle=vehicle,
        boot_epoch=0,
        submap=1,
        fragment=0,
        fragment_count=1,
        tx_second=0,
        time_quarters=round(4 * first_s) % (1 << 20),
    )
    rows = np.full((20, 3), np.nan, dtype=np.float32)
    rows[: len(states)] = states
    return encode(TrajectoryPacket(header=header, states=rows))


@pytest.mark.parametrize("answers", ["paper", "extended"])
@pytest.mark.parametrize("profile", ["paper", "dense", "lattice", "auto"])
def test_every_profile_is_carried_from_sonar_to_answer(profile: str, answers: str) -> None:
    one = convoy(answers=answers, profile=profile).run(0.0, 100.0)
    assert len(sheets_of(one.leader)) >= 2
    kind = ExtendedAnswer if answers == "extended" else Answer
    assert one.down
    assert all(isinstance(packet, kind) for packet, _ in one.down)
    follower, _ = one.followers[1]
    status = follower.status()
    assert status["answers_used"] + status["answers_without_news"] >= 3
    assert not status.get("submaps_unfit")


def test_four_followers_have_each_a_chain_and_a_turn() -> None:
    four = convoy(4, profile="lattice").run(0.0, 200.0)
    assert four.leader.vehicles() == [0, 1, 2, 3, 4]
    turns = [packet.header.fragment for packet, _ in four.down]
    assert {turns.count(v) for v in (1, 2, 3, 4)} <= {
        min(turns.count(v) for v in (1, 2, 3, 4)) + k for k in (0, 1, 2)
    }
    for vehicle in (1, 2, 3, 4):
        assert sheets_of(four.leader, vehicle)
        assert four.followers[vehicle][0].status()["answers_used"] >= 2


def test_fourteen_followers_have_room_and_time_for_their_sub_maps() -> None:
    slots = Slots(SlotSettings(followers=14, follower_slot_s=4))
    sized = reassembly_of(LeaderSettings(), slots)
    assert sized.slots >= 28
    assert sized.oldest_s >= 10 * 14 * 4.0
    assert reassembly_of(LeaderSettings(), slots_of()) == LeaderSettings().reassembly


def test_answer_speaks_of_the_newest_state_known() -> None:
    one = convoy().run(0.0, 90.0)
    packet, sent_s = one.down[-1]
    assert sent_s - packet.header.time_quarters / 4.0 < 45.0
    one.sonar_until_s = 90.0
    one.run(90.0, 180.0)
    packet, sent_s = one.down[-1]
    assert sent_s - packet.header.time_quarters / 4.0 < 10.0


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
            leader._arrivals._receive_states(
                dataclasses.replace(header, boot_epoch=boot),
                float(first_s),
                walked(4, 2.0 * first_s),
                first_s + 44.0,
            )
    assert leader.status()["restarts"] == 1
    assert leader.status().get("restarts_untied", 0) == 0


def test_restarts_beyond_the_header_s_four_bits_are_still_told_apart() -> None:
    leader = sailed(40.0)
    for boot in range(20):
        frame = changed(
            trajectory(walked(20, 300.0 * (boot % 2)), 20.0 * boot), boot_epoch=boot % 16
        )
        leader.receive_frame(frame, None, 20.0 * boot + 20.0)
    assert leader.status()["restarts"] == 19
    assert len(leader.graph.vehicles()) == 21
    assert leader.vehicles() == [0, 1]


def test_late_frame_of_an_earlier_boot_does_not_start_another() -> None:
    leader = sailed(40.0)
    for boot, first_s in ((0, 20.0), (1, 60.0), (0, 40.0), (1, 80.0)):
        leader.receive_frame(
            changed(trajectory(walked(20, 2.0 * first_s), first_s), boot_epoch=boot), None, 100.0
        )
    assert leader.status()["restarts"] == 1
    assert len(leader.track(1).time_s) == 80


def test_late_frame_of_a_boot_never_heard_does_not_start_another() -> None:
    leader = sailed(40.0)
    for boot, first_s in ((1, 60.0), (0, 20.0), (1, 80.0)):
        leader.receive_frame(
            changed(trajectory(walked(20, 2.0 * first_s), first_s), boot_epoch=boot), None, 100.0
        )
    assert leader.status().get("restarts", 0) == 0
    assert len(leader.graph.vehicles()) == 3
    assert leader.track(1).time_s == pytest.approx([*range(20, 40), *range(60, 100)])


def test_fragments_out_of_order_and_twice_make_the_same_sheets() -> None:
    frames = [frame for frame, _ in FRAMES]
    in_order = hear(sailed(), frames)
    middle = [k for k, f in enumerate(frames) if decode(f).header.submap in (1, 2)]
    order = np.arange(len(frames))
    order[middle] = np.random.default_rng(3).permutation(middle)
    mixed = hear(sailed(), [frames[k] for k in order])
    twice = hear(sailed(), [frame for frame in frames for _ in range(2)])
    assert sheets_of(in_order)
    assert sheets_of(mixed) == sheets_of(twice) == sheets_of(in_order)
    assert twice.status()["reassembly_duplicates"] + twice.status()["reassembly_late"] > 0


def test_half_a_submap_is_still_a_sheet() -> None:
    frames = [frame for frame, _ in FRAMES if decode(frame).header.fragment % 2]
    assert sheets_of(hear(sailed(), frames))


def test_frames_of_unknown_vehicles_are_counted_and_dropped() -> None:
    leader = hear(sailed(), [changed(frame, vehicle=9) for frame, _ in FRAMES])
    assert leader.vehicles() == [0]
    assert leader.status()["frames_of_unknown_vehicles"] == len(FRAMES)


def test_submap_from_the_future_is_counted_and_dropped() -> None:
    frames = [
        changed(frame, time_quarters=(decode(frame).header.time_quarters + 4 * 5000) % (1 << 20))
        for frame, _ in FRAMES
    ]
    leader = hear(sailed(), frames, 60.0)
    assert sheets_of(leader) == []
    assert leader.status()["states_from_the_future"] > 0
    assert leader.status()["submaps_off_track"] > 0


def test_states_of_long_ago_are_counted_and_dropped() -> None:
    leader = sailed()
    leader.receive_frame(trajectory(np.ones((20, 3)), -5000.0), None, 100.0)
    assert leader.status()["states_too_old"] == 20
    assert leader.vehicles() == [0]


def walked(count: int, north_m: float) -> np.ndarray:
    return np.column_stack([north_m + 2.0 * np.arange(count), np.zeros(count), np.zeros(count)])


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


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e30])
def test_states_that_are_no_positions_are_passed_over(bad: float) -> None:
    leader = sailed()
    states = walked(20, 0.0)
    states[3] = bad
    leader.receive_frame(trajectory(states, 60.0), None, 100.0)
    assert len(leader.track(1).time_s) == 19
    assert np.isfinite(leader.belief().position_m).all()


def with_points(packet: Packet, value: float) -> bytes:
    assert isinstance(packet, SubmapPacket)
    points = np.full_like(packet.points_ned_m, value)
    return encode(dataclasses.replace(packet, points_ned_m=points))


@pytest.mark.parametrize("value", [np.nan, 0.0, 1e30])
def test_submap_without_usable_points_is_counted(value: float) -> None:
    frames = [
        with_points(decode(frame), value)
        for frame, _ in FRAMES
        if isinstance(decode(frame), SubmapPacket)
    ]
    leader = hear(sailed(), frames)
    assert sheets_of(leader) == []
    assert leader.status()["submaps_not_rebuilt"] > 0


@pytest.mark.parametrize("range_m", [0.0, 100_000.0, -1.0])
def test_absurd_ranges_move_nothing(range_m: float) -> None:
    leaders = [sailed(150.0), sailed(150.0)]
    for leader, toa in zip(leaders, (False, True), strict=True):
        for frame, sent_s in FRAMES:
            leader.receive_frame(frame, sent_s + range_m / 1500.0 if toa else None, 150.0)
        leader.tick(150.0)
        leader.tick(400.0)
    without, absurd = (leader.trajectory(1).position_m for leader in leaders)
    assert absurd == pytest.approx(without, abs=1.5)


def test_clock_that_is_set_back_does_not_silence_the_leader() -> None:
    one = convoy().run(0.0, 100.0)
    later = one.leader.poll(5003.0)
    assert later is not None
    assert any(one.leader.poll(103.0 + k) for k in range(20))


def test_follower_whose_clock_is_set_back_is_heard_again() -> None:
    leader = sailed()
    for now_s in range(20, 300, 20):
        theirs_s = now_s - (60.0 if now_s >= 100 else 20.0)
        leader.receive_frame(trajectory(walked(20, 2.0 * now_s), theirs_s), None, float(now_s))
    assert leader.track(1).time_s[-1] >= 239.0
    assert leader.vehicles() == [0, 1]


def test_navigation_between_whole_seconds_is_tracked_as_well() -> None:
    path = line(0.0, 0.0)
    leader = leader_of(path)
    for k in range(400):
        sail(leader, path, 0.003 + 0.25 * k)
    assert len(leader.track(0).time_s) == 100
    assert leader.graph.nodes >= 6  # of sub-maps that end every twenty seconds


def test_own_sub_map_does_not_reach_over_a_gap_in_navigation() -> None:
    path = line(0.0, 0.0)
    leader = leader_of(path, hop_s=10.0)
    for begin_s in (0.0, 400.0):
        for k in range(400):
            sail(leader, path, begin_s + 0.25 * k)
    spans_s = [np.ptp(sheet.track.time_s) for sheet in leader.atlas]
    assert len(spans_s) > 10
    assert max(spans_s) <= 20.0


@pytest.mark.parametrize("toa_s", [np.nan, np.inf, -np.inf, 5000.0])
def test_arrival_at_no_time_is_no_range(toa_s: float) -> None:
    leader = sailed()
    for frame, _ in FRAMES:
        leader.receive_frame(frame, toa_s, 100.0)
    leader.tick(100.0)
    assert leader.status()["arrivals_impossible"] == len(FRAMES)
    assert leader.status()["frames_received"] == len(FRAMES)
    assert len(leader.track(1).time_s) > 20


def test_lasting_jump_at_the_end_of_a_packet_silences_nobody() -> None:
    leader = sailed()
    for first_s in (0.0, 20.0, 40.0):
        leader.receive_frame(trajectory(walked(20, 2.0 * first_s), first_s), None, 100.0)
    states = walked(40, 120.0)
    states[10:, 0] += 500.0
    header = decode(trajectory(walked(20, 0.0), 60.0)).header
    leader._arrivals._receive_states(header, 60.0, states, 104.0)
    assert leader.status()["lasting_jumps"] == 1
    assert leader.poll(111.0) is not None


def test_no_bytes_whatever_raise() -> None:
    rng, leader = np.random.default_rng(1), sailed(40.0)
    for frame, _ in FRAMES[:20]:
        damaged = bytearray(frame)
        damaged[int(rng.integers(len(frame)))] ^= 1 + int(rng.integers(255))
        leader.receive_frame(bytes(damaged), 50.0, 50.0)
        leader.receive_frame(rng.bytes(256), None, 50.0)
    leader.tick(50.0)
    assert leader.status()["frames_rejected"] == 40


def test_lost_fragments_are_asked_for_and_repeated_where_the_air_has_room() -> None:
    slots = slots_of()
    assert slots.frames_per_submap(20.0) == 10

    def lose_some(packet: Packet, time_s: float) -> bool:
        """Lose two of three frames, one too many, but none of the repeats between."""
        header = packet.header
        return (
            header.profile is Profile.SUBMAP_DENSE and header.fragment < 2 and time_s % 20.0 < 9.0
        )

    changes: dict[str, Any] = {"profile": "dense", "frames_per_submap": 3}
    plain = convoy(answers="paper", lose=lose_some, **changes).run(0.0, 200.0)
    repeated = convoy(answers="extended", lose=lose_some, **changes).run(0.0, 200.0)
    assert repeated.leader.status()["repeats_asked"] > 0
    assert repeated.followers[1][0].status()["fragments_repeated"] > 0
    assert (
        repeated.leader.status()["reassembly_complete"]
        > plain.leader.status()["reassembly_complete"]
    )
    sent = [packet for packet, _ in repeated.up]
    assert len(sent) <= len(plain.up) * 5 / 3  # the two that were lost of each sub-map
