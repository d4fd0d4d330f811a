"""The follower's core: what it sends in which slots, and what the water may do to it."""

import copy
import dataclasses
import functools
from typing import Any

import numpy as np
import pytest

from firmware.follower.core import FollowerCore
from firmware.follower.correction import CorrectionSettings, DriftCorrection
from firmware.sound_speed import SoundProfile
from firmware.soundings import Odometry
from protocol.codec import decode, encode
from protocol.errors import EstimationError
from protocol.packets import (
    Answer,
    ExtendedAnswer,
    Header,
    Packet,
    Profile,
    SubmapFragment,
    SubmapPacket,
    TrajectoryPacket,
    answer_count,
)
from protocol.schedule import Slots
from tests.leader.vessels import follower_of, line, sail, slots_of

PATH = line(0.0, 0.0)


def sent(
    core: FollowerCore, until_s: float, begin_s: float = 0.0, sonar_until_s: float = np.inf
) -> list[Packet]:
    """Sail on and return what was transmitted."""
    packets = []
    for quarter in range(round(4 * begin_s) + 1, round(4 * until_s) + 1):
        now_s = quarter / 4.0
        sail(core, PATH, now_s, sonar_on=now_s <= sonar_until_s)
        core.tick(now_s)
        frame = core.poll(now_s)
        if frame is not None:
            assert now_s == round(now_s)
            packets.append(decode(frame))
    return packets


def answer_of(time_s: float, north_m: float, east_m: float, **changes: object) -> bytes:
    header = Header(
        profile=Profile.ANSWER,
        vehicle=0,
        boot_epoch=0,
        submap=1,
        fragment=1,
        fragment_count=0,
        tx_second=0,
        time_quarters=round(4 * time_s) % (1 << 20),
    )
    header = dataclasses.replace(header, **changes)  # type: ignore[arg-type]
    return encode(Answer(header=header, submap=0, north_m=north_m, east_m=east_m))


def extended_of(answer: bytes, **changes: object) -> bytes:
    plain = decode(answer)
    assert isinstance(plain, Answer)
    values: dict[str, object] = {
        "header": dataclasses.replace(plain.header, profile=Profile.ANSWER_EXTENDED),
        "submap": plain.submap,
        "north_m": plain.north_m,
        "east_m": plain.east_m,
        "variance_m2": 4.0,
        "leader_north_m": 150.0,
        "leader_east_m": 600.0,
        "leader_variance_m2": 1.0,
        "repeat_submap": 0,
        "missing_fragments": 0,
    }
    return encode(ExtendedAnswer(**{**values, **changes}))  # type: ignore[arg-type]


@pytest.mark.parametrize(("followers", "frames"), [(1, 10), (2, 5), (3, 3), (4, 2)], ids=str)
def test_lattice_takes_as_many_frames_as_the_air_has(followers: int, frames: int) -> None:
    core = follower_of(PATH, slots=slots_of(followers), profile="lattice")
    fragments = [p for p in sent(core, 60.0) if isinstance(p, SubmapFragment)]
    assert {p.header.fragment_count for p in fragments} == {frames}
    assert not core.status().get("submaps_without_air")


def test_number_of_frames_can_be_set() -> None:
    core = follower_of(PATH, profile="lattice", frames_per_submap=4)
    fragments = [p for p in sent(core, 60.0) if isinstance(p, SubmapFragment)]
    assert {p.header.fragment_count for p in fragments} == {4}


def test_auto_sends_each_submap_in_no_more_frames_than_it_is_worth() -> None:
    fragments = [p for p in sent(follower_of(PATH, profile="auto"), 100.0) if p.header.submap < 2]
    counts = {p.header.submap: p.header.fragment_count for p in fragments}
    assert set(counts) == {0, 1}
    assert all(isinstance(p, SubmapFragment) for p in fragments)
    assert all(2 <= count < 10 for count in counts.values())


def test_a_fit_that_cannot_go_on_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise EstimationError("singular")

    monkeypatch.setattr("firmware.compression.weights.factorised", refuse)
    core = follower_of(PATH, profile="paper")
    assert sent(core, 60.0)
    assert core.status()["fits_stopped_early"] >= 1


def test_a_survey_beyond_what_frames_can_tell_is_counted_and_goes_on() -> None:
    """Northings of a projection instead of metres from the datum: no cell is usable."""
    far = line(4.6e6, 0.0)
    core = follower_of(far)
    for quarter in range(1, 240):
        sail(core, far, quarter / 4.0)
        core.tick(quarter / 4.0)
    assert core.status()["submaps_unfit"] >= 1


SMALL: dict[str, Any] = {"profile": "lattice", "compression.small_frames": True}


def test_a_thin_submap_leaves_the_fit_before_it_alone() -> None:
    core = follower_of(PATH, **SMALL)
    sent(core, 12.0)
    for quarter in range(4 * 12 + 1, 4 * 40):  # over a bottom that the log has lost
        core.receive_odometry(
            Odometry(
                time_s=quarter / 4.0,
                velocity_north_mps=np.nan,
                velocity_east_mps=np.nan,
                yaw_rad=0.0,
                depth_m=10.0,
            )
        )
        core.tick(quarter / 4.0)
    assert core.status()["submaps_too_thin"] == 1
    assert core.status()["submaps_sent"] == 1
    assert not core.counters["fits_cut_short"]


def test_a_fit_cut_short_sends_no_frame_larger_than_the_modem_carries() -> None:
    core = follower_of(PATH, **SMALL, steps_per_tick=1)
    for quarter in range(1, 4 * 45):
        sail(core, PATH, quarter / 4.0)
        if quarter % 4 == 0:
            core.tick(quarter / 4.0)
    frames = [encode(packet) for packet in sent(core, 80.0, 45.0)]
    assert core.status()["fits_cut_short"] >= 1
    assert core.status()["submaps_unfit"] >= 1
    assert {len(frame) for frame in frames} == {62}


def test_paper_profile_in_shared_air_leaves_whole_submaps_out() -> None:
    core = follower_of(PATH, slots=slots_of(2), profile="paper")
    packets = [p for p in sent(core, 200.0) if isinstance(p, SubmapPacket)]
    whole = {p.header.submap for p in packets}
    assert core.status()["submaps_without_air"] >= 3
    for submap in sorted(whole)[:-1]:
        fragments = [p.header.fragment for p in packets if p.header.submap == submap]
        assert fragments == list(range(10))


def test_after_the_survey_the_trajectory_goes_out_alone() -> None:
    packets = sent(follower_of(PATH), 150.0, sonar_until_s=40.0)
    last = packets[-1]
    assert isinstance(last, TrajectoryPacket)
    assert np.isfinite(last.states).all()
    assert last.header.time_quarters / 4.0 + 19.0 == pytest.approx(150.0, abs=2.1)


def test_small_frames_have_small_trajectories() -> None:
    small: dict[str, Any] = {"compression.small_frames": True}
    core = follower_of(PATH, profile="lattice", **small)
    packets = sent(core, 150.0, sonar_until_s=40.0)
    assert {len(encode(p)) for p in packets} == {62}
    assert isinstance(packets[-1], TrajectoryPacket)


def test_repeats_take_only_slots_that_fresh_fragments_leave() -> None:
    core = follower_of(PATH, profile="lattice", frames_per_submap=6)
    first = sent(core, 40.0)
    core.receive_frame(
        extended_of(answer_of(20.0, 40.0, 0.0), missing_fragments=0b111111), None, 48.0
    )
    later = sent(core, 100.0, begin_s=40.0)
    repeated = [p.header.fragment for p in later if p.header.submap == 0]
    assert len(first) == 6 or len(repeated) >= 6
    assert core.status()["fragments_repeated"] == 6
    for submap in (1, 2, 3):
        fresh = [p for p in later if p.header.submap == submap]
        assert sorted(p.header.fragment for p in fresh) == list(range(6))


def test_full_air_repeats_nothing() -> None:
    core = follower_of(PATH, slots=Slots(slots_of().settings), profile="lattice")
    sent(core, 50.0)
    packets = []
    for now_s in range(50, 130, 10):
        core.receive_frame(
            extended_of(answer_of(20.0, 40.0, 0.0), missing_fragments=0b11), None, float(now_s)
        )
        packets += sent(core, now_s + 10.0, begin_s=float(now_s))
    for submap in (2, 3, 4):
        assert sum(p.header.submap == submap for p in packets) == 10
    assert not core.status().get("submaps_without_air")


@functools.cache
def survey() -> FollowerCore:
    core = follower_of(PATH)
    sent(core, 99.0)
    return core


def surveyed() -> FollowerCore:
    """Return a follower that has surveyed for 99 s, alone with whoever asks."""
    return copy.deepcopy(survey())


def test_answer_corrects_the_belief() -> None:
    core = surveyed()
    for time_s in (60.0, 70.0, 80.0):
        core.receive_frame(answer_of(time_s, 2 * time_s + 15.0, 0.0), None, 100.0)
    assert core.belief().position_m[0] == pytest.approx(198.0 + 17.0, abs=8.0)
    assert core.reckoned.north_m == pytest.approx(198.0)


def test_told_variance_is_used() -> None:
    spreads_m2 = []
    for variance_m2 in (1.0, 100.0):
        core = surveyed()
        frame = extended_of(answer_of(90.0, 185.0, 3.0), variance_m2=variance_m2)
        core.receive_frame(frame, None, 100.0)
        spreads_m2.append(core.belief().covariance_m2[0, 0])
    assert spreads_m2[0] < spreads_m2[1]


def test_sigma_in_a_plain_answer_is_used() -> None:
    spreads_m2 = []
    for sigma_m in (1.0, 10.0):
        core = surveyed()
        frame = answer_of(90.0, 185.0, 3.0, submap=answer_count(sigma_m, 1))
        core.receive_frame(frame, None, 100.0)
        spreads_m2.append(core.belief().covariance_m2[0, 0])
    assert spreads_m2[0] < spreads_m2[1]


def test_extended_answer_to_another_follower_ranges_too() -> None:
    core = surveyed()
    frame = extended_of(answer_of(90.0, 0.0, 0.0, fragment=2, tx_second=99 % 16))
    travel_s = float(np.hypot(600.0, 150.0 - 198.0)) / 1500.0
    core.receive_frame(frame, 99.0 + travel_s, 100.0)
    assert core.status()["ranges_used"] == 1
    assert core.status()["answers_to_others"] == 1
    assert core.status()["answers_used"] == 0


def test_range_to_a_leader_far_below_teaches_what_a_level_one_does() -> None:
    """Between our 10 m and the leader's 130 m sound makes 1450 m/s on one half, then 1550."""
    frame = extended_of(answer_of(90.0, 0.0, 0.0, fragment=2, tx_second=99 % 16))
    across_m = float(np.hypot(600.0, 150.0 - 198.0)) + 2.0
    slant_s = float(np.hypot(across_m, 120.0)) * 0.5 * (1.0 / 1450.0 + 1.0 / 1550.0)
    step = (0.0, 1450.0, 70.0, 1450.0, 70.000001, 1550.0)
    by_depth = CorrectionSettings(sound_profile=SoundProfile(points=step), leader_depth_m=130.0)
    believed_m = []
    for settings, travel_s in (
        (CorrectionSettings(), across_m / 1500.0),
        (by_depth, slant_s),
        (CorrectionSettings(), slant_s),
    ):
        core = surveyed()
        core._settings = dataclasses.replace(core._settings, correction=settings)
        core._correction = DriftCorrection(0.0, settings)
        core.receive_frame(frame, 99.0 + travel_s, 100.0)
        assert core.status()["ranges_used"] == 1
        believed_m.append(core.belief().position_m)
    assert believed_m[1] == pytest.approx(believed_m[0], abs=0.1)
    assert np.hypot(*(believed_m[2] - believed_m[0])) > 5.0


@pytest.mark.parametrize("toa_s", [99.0, 99.0 + 100_000.0 / 1500.0, -50.0, 1e9, np.nan, np.inf])
def test_absurd_range_is_a_counted_drop(toa_s: float) -> None:
    core = surveyed()
    before_m = core.belief().position_m
    frame = extended_of(answer_of(90.0, 0.0, 0.0, fragment=2, tx_second=99 % 16))
    core.receive_frame(frame, toa_s, 100.0)
    status = core.status()
    assert status["ranges_gated"] + status.get("ranges_unplaceable", 0) == 1
    assert core.belief().position_m == pytest.approx(before_m)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_answer_that_is_no_position_or_variance_is_dropped(bad: float) -> None:
    core = surveyed()
    core.receive_frame(answer_of(90.0, bad, 0.0), None, 100.0)
    core.receive_frame(extended_of(answer_of(90.0, 180.0, 0.0), variance_m2=bad), 99.5, 100.0)
    core.receive_frame(extended_of(answer_of(90.0, 180.0, 0.0), variance_m2=-1.0), None, 100.0)
    core.receive_frame(extended_of(answer_of(90.0, 180.0, 0.0), leader_north_m=bad), 99.5, 100.0)
    assert np.isfinite(core.belief().position_m).all()
    status = core.status()
    dropped = status.get("frames_rejected", 0) + status["answers_gated"]
    assert dropped >= 3
    assert status["answers_used"] <= 1


@pytest.mark.parametrize("time_s", [200.0, 5000.0, -400.0])
def test_answer_about_the_future_or_long_ago_is_counted(time_s: float) -> None:
    core = surveyed()
    core.receive_frame(answer_of(time_s, 0.0, 0.0), None, 100.0)
    assert core.status()["answers_unplaceable"] == 1


def test_answer_to_an_earlier_boot_teaches_nothing() -> None:
    core = follower_of(PATH, boot_epoch=1)
    sent(core, 40.0)
    core.receive_frame(answer_of(20.0, 500.0, 500.0), None, 40.0)
    assert core.status()["answers_to_others"] == 1
    assert core.status()["answers_used"] == 0


def test_reflected_and_damaged_frames_are_counted() -> None:
    core = follower_of(PATH)
    own = [encode(p) for p in sent(core, 60.0)]
    core.receive_frame(own[0], None, 60.0)
    core.receive_frame(answer_of(20.0, 0.0, 0.0, vehicle=3), None, 60.0)
    core.receive_frame(own[0][:-1] + b"\0", None, 60.0)
    assert core.status()["frames_not_for_us"] == 2
    assert core.status()["frames_rejected"] == 1


def test_clock_that_is_set_back_does_not_silence_the_follower() -> None:
    core = surveyed()
    core.poll(5000.0)
    assert sent(core, 130.0, begin_s=99.0)


def test_track_that_is_told_after_a_clock_was_set_back_is_in_order() -> None:
    core, path = follower_of(line(0.0, 0.0)), line(0.0, 0.0)
    for time_s in (*np.arange(0.25, 300.0, 0.25), *np.arange(200.0, 210.0, 0.25)):
        sail(core, path, float(time_s), sonar_on=False)
    told_s = [state.time_s for state in core._idle_states()]
    assert told_s == sorted(told_s)
    assert 208.0 < told_s[-1] < 210.0
    assert core.poll(210.0) is not None
    assert core.status()["odometry_set_back"] == 1


def test_a_clock_that_leaps_ahead_and_comes_back_leaves_an_honest_belief() -> None:
    """What was doubted of the hour that never was is doubted of now: answers end it."""
    core, drift_mps, last_m = follower_of(line(0.0, 0.0)), 0.1, np.nan
    for time_s in np.arange(0.25, 800.0, 0.25):
        shown_s = time_s + (3600.0 if 600.0 <= time_s < 603.0 else 0.0)
        core.receive_odometry(
            Odometry(
                time_s=shown_s,
                velocity_north_mps=2.0,
                velocity_east_mps=0.0,
                yaw_rad=0.0,
                depth_m=10.0,
            )
        )
        last_m = core.reckoned.north_m - drift_mps * time_s
        if time_s % 20.0 == 0.0 and time_s >= 100.0:
            said_m = last_m - (2.0 - drift_mps) * 40.0
            answer = answer_of(
                time_s - 40.0,
                said_m,
                0.0,
                fragment_count=core.boot_epoch,
                submap=answer_count(1.5, round(time_s)),
            )
            if not 600.0 <= time_s < 640.0:
                core.receive_frame(answer, None, time_s)
    belief = core.belief()
    assert belief.position_m[0] == pytest.approx(last_m, abs=3.0)
    assert np.sqrt(belief.covariance_m2[0, 0]) < 10.0


def test_navigation_that_fails_for_a_while_is_counted_and_goes_on() -> None:
    core = surveyed()
    core.receive_odometry(
        Odometry(
            time_s=99.25,
            velocity_north_mps=np.nan,
            velocity_east_mps=np.inf,
            yaw_rad=np.nan,
            depth_m=np.nan,
        )
    )
    packets = sent(core, 130.0, begin_s=99.25)
    assert core.status()["bad_odometry"] == 1
    assert packets
    assert np.isfinite(core.belief().position_m).all()
