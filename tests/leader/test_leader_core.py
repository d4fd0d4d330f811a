"""The leader's core, driven by followers' cores and by everything that goes wrong."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from firmware.belief import Belief
from firmware.leader.core import LeaderCore
from firmware.leader.ledger import OdometryRecord
from firmware.leader.settings import LeaderSettings, reassembly_of
from protocol.codec import decode, encode
from protocol.errors import ConfigError, EstimationError
from protocol.packets import (
    Answer,
    ExtendedAnswer,
    Packet,
    Profile,
    SubmapPacket,
)
from protocol.schedule import Slots, SlotSettings
from tests.leader.vessels import (
    changed,
    convoy,
    leader_of,
    line,
    sail,
    sailed,
    sheets_of,
    slots_of,
    trajectory,
    walked,
)


def frames_of(**changes: Any) -> list[tuple[bytes, float]]:
    """Return what a follower transmits in 100 s, and when."""
    one = convoy(lose=lambda *_: True, **changes).run(0.0, 100.0)
    return [(encode(packet), sent_s) for packet, sent_s in one.up]


FRAMES = frames_of(profile="paper")


def hear(leader: LeaderCore, frames: list[bytes], now_s: float = 100.0) -> LeaderCore:
    for frame in frames:
        leader.receive_frame(frame, None, now_s)
    leader.tick(now_s)
    leader.tick(now_s + 300.0)  # whatever is still open is closed by its deadline
    return leader


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


def test_followers_that_have_fallen_silent_cost_the_others_no_turn() -> None:
    leader = leader_of(line(0.0, 0.0), slots=slots_of(2))
    told = []
    for quarter in range(1, 4001):
        now_s = quarter / 4.0
        sail(leader, line(0.0, 0.0), now_s, sonar_on=False)
        for vehicle in {21.0: (1, 2), 921.0: (1,)}.get(now_s, ()):
            states = trajectory(walked(20, 2.0 * now_s), now_s - 21.0, vehicle=vehicle)
            leader.receive_frame(states, None, now_s)
        if (frame := leader.poll(now_s)) is not None:
            told.append((now_s, decode(frame).header.fragment))
    assert {vehicle for now_s, vehicle in told if now_s < 900.0} == {1, 2}
    assert {vehicle for now_s, vehicle in told if now_s > 925.0} == {1}


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


def test_clock_that_leaps_ahead_neither_stops_composition_nor_coarsens_the_present() -> None:
    path = line(0.0, 0.0)
    leader = leader_of(path)
    composed_s = []
    for second in range(1, 1900):
        sail(leader, path, float(second), sonar_on=False)
        leader.tick(float(second))
        if second == 1000:
            before = leader.graph.nodes
            leader.tick(1000.0 + 7 * 3600.0)
            assert leader.graph.nodes == before
        if leader.composed_s not in composed_s:
            composed_s.append(leader.composed_s)
    assert composed_s == [0.0, 300.0, 600.0, 900.0, 1200.0, 1500.0, 1800.0]
    assert len(leader.graph.trajectory(0).time_s) > leader.graph.nodes > 1200 / 10


def test_whole_clock_that_leaps_for_a_moment_does_not_coarsen_the_past() -> None:
    path = line(0.0, 0.0)
    leader, composed_s = leader_of(path), []
    for second in range(1, 2000):
        ahead_s = 3600.0 if 1300 < second <= 1312 else 0.0
        sail(leader, lambda t, a=ahead_s: path(t - a), second + ahead_s, sonar_on=False)  # type: ignore[misc]
        if second % 20 == 0 and second > 40 and not ahead_s:
            states = walked(20, 2.0 * (second - 40))
            leader.receive_frame(trajectory(states, second - 40.0), None, float(second))
        leader.poll(second + ahead_s)
        leader.tick(second + ahead_s)
        composed_s += [] if leader.composed_s in composed_s else [leader.composed_s]
    assert composed_s[:5] == [0.0, 300.0, 600.0, 900.0, 1200.0]
    assert np.diff(composed_s[4:]) == pytest.approx(300.0, abs=30.0)
    assert composed_s[-1] > 1600.0
    assert sum(time_s < 1300.0 for time_s in leader.graph._chains[0].times_s) > 80


@pytest.mark.parametrize(("answers", "asked"), [("paper", 0), ("extended", 1)])
def test_only_an_answer_that_tells_of_the_leader_asks_where_it_is(
    answers: str, asked: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    leader = convoy(answers=answers).leader
    leader.receive_frame(trajectory(walked(20, 0.0), 60.0), None, 100.0)
    beliefs, belief = [], leader.belief

    def counted() -> Belief:
        beliefs.append(belief())
        return beliefs[-1]

    monkeypatch.setattr(leader, "belief", counted)
    assert leader.poll(111.0) is not None
    assert len(beliefs) == asked


def test_hop_longer_than_a_sub_map_may_last_is_refused_under_its_own_name() -> None:
    with pytest.raises(ConfigError, match="hop_s"):
        LeaderSettings(hop_s=60.0)


def test_composition_that_fails_is_tried_again_an_interval_later(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = line(0.0, 0.0)
    leader = leader_of(path)

    def fails(*_: object) -> None:
        raise EstimationError("singular")

    monkeypatch.setattr(leader.graph, "compose", fails)
    for second in range(1, 700):
        sail(leader, path, float(second), sonar_on=False)
        leader.tick(float(second))
        if second == 400:
            assert leader.status()["compositions_failed"] == 1
            assert leader.composed_s == 0.0
            monkeypatch.undo()
    assert leader.status()["compositions_failed"] == 1
    assert leader.composed_s == 600.0


def test_navigation_between_whole_seconds_is_tracked_as_well() -> None:
    path = line(0.0, 0.0)
    leader = leader_of(path)
    for k in range(400):
        sail(leader, path, 0.003 + 0.25 * k)
    assert len(leader.track(0).time_s) == 100
    assert leader.graph.nodes >= 6  # of sub-maps that end every twenty seconds


def test_own_track_goes_on_after_stamps_from_the_future() -> None:
    path = line(0.0, 0.0)
    leader = leader_of(path)
    for k in range(4 * 200):
        ahead_s = 3000.0 if 400 <= k < 404 else 0.0
        sail(leader, line(-2.0 * ahead_s, 0.0), 0.25 * k + ahead_s, sonar_on=False)
    assert leader.reckoned.time_s == 199.75
    assert np.hypot(*(leader.belief().position_m - path(199.75))) < 6.0
    track = leader.track(0)
    assert (np.diff(track.time_s) > 0.0).all()
    assert np.isin(np.arange(105.0, 199.0), np.round(track.time_s)).all()
    assert leader.status()["odometry_set_back"] == 1


def test_own_sub_map_does_not_reach_over_a_gap_in_navigation() -> None:
    path = line(0.0, 0.0)
    leader = leader_of(path, hop_s=10.0)
    for begin_s in (0.0, 400.0):
        for k in range(400):
            sail(leader, path, begin_s + 0.25 * k)
    spans_s = [np.ptp(sheet.track.time_s) for sheet in leader.atlas]
    assert len(spans_s) > 10
    assert max(spans_s) <= 20.0


@pytest.mark.parametrize("back_s", [7.0, 30.0])
def test_own_sub_map_does_not_reach_over_a_clock_that_is_set_back(back_s: float) -> None:
    path = line(0.0, 0.0)
    leader = leader_of(path, hop_s=10.0)
    for k in range(800):
        sail(leader, path, 0.25 * k - back_s * (k >= 440))
    assert leader.status()["odometry_set_back"] == 1
    sheets = list(leader.atlas)
    assert len(sheets) > 5
    assert all((np.diff(sheet.track.time_s) > 0.0).all() for sheet in sheets)


def test_own_track_is_right_after_a_clock_that_was_ahead() -> None:
    """Nodes of a minute lie ahead; the way on from them is as unsure as the time till then."""
    path = line(0.0, 0.0)
    leader = leader_of(path)
    for k in range(1, 4 * 700):
        now_s = 0.25 * k
        if now_s % 10.0 == 0.0:
            leader.fleet.extend(0)
        sail(leader, path, now_s + 300.0 * (300.0 <= now_s < 360.0), sonar_on=False)
    track, graph = leader.track(0), leader.graph
    assert leader.status()["odometry_set_back"] == 1
    times_s = np.arange(370.0, 699.0)
    assert track.position_at(times_s) == pytest.approx(
        np.array([path(t) for t in times_s]), abs=6.0
    )
    (across,) = [
        entry.record
        for entry in graph._ledger.values()
        if isinstance(entry.record, OdometryRecord) and entry.record.moved_m[0] > 100.0
    ]
    assert across.interval_s == 10.0
    assert across.position_sigma_m > 20.0


@pytest.mark.parametrize("toa_s", [np.nan, np.inf, -np.inf, 5000.0, 30.0])
def test_arrival_at_no_time_is_no_range(toa_s: float) -> None:
    leader = sailed()
    for frame, _ in FRAMES:
        leader.receive_frame(frame, toa_s, 100.0)
    leader.tick(100.0)
    assert leader.status()["arrivals_impossible"] == len(FRAMES)
    assert leader.status()["frames_received"] == len(FRAMES)
    assert len(leader.track(1).time_s) > 20


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


def test_a_follower_is_heard_before_the_leader_has_navigation() -> None:
    """A leader whose navigation starts late, or never, loses none of its sub-maps."""
    leader = leader_of(line(0.0, 0.0))
    for frame, sent_s in FRAMES:
        leader.receive_frame(frame, sent_s + 0.04, sent_s + 1.0)
        leader.tick(sent_s + 1.0)
        leader.poll(sent_s + 1.0)
    leader.tick(400.0)
    assert len(sheets_of(leader)) == len({decode(frame).header.submap for frame, _ in FRAMES})


def test_a_leader_that_never_has_navigation_composes_and_tells_what_it_heard() -> None:
    leader = leader_of(line(0.0, 0.0))
    for first_s in range(0, 1400, 20):
        frame = trajectory(walked(20, 2.0 * first_s), float(first_s))
        leader.receive_frame(frame, None, first_s + 20.0)
        leader.tick(first_s + 20.0)
    assert leader.composed_s > 0.0
    assert leader.outlook.observe(1400.0) is not None
    assert leader.trajectory(1).time_s[-1] >= 1380.0
    assert leader.track(0).time_s.size == 1
