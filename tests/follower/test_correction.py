"""What answers teach a follower, and what they must not."""

import numpy as np
import pytest

from firmware.follower.correction import CorrectionSettings, DriftCorrection

BIAS_MPS = np.array([0.1, -0.07])


def drift_m(time_s: float) -> np.ndarray:
    return BIAS_MPS * time_s


def taught(until_s: float = 600.0) -> DriftCorrection:
    correction = DriftCorrection(0.0, CorrectionSettings())
    for time_s in np.arange(80.0, until_s + 1, 40.0):
        correction.receive_answer(float(time_s), drift_m(time_s), np.zeros(2))
    return correction


def test_old_answers_correct_the_present_by_the_drift_they_taught() -> None:
    position_m, covariance_m2 = taught().corrected(720.0, drift_m(720.0))
    assert position_m == pytest.approx([0.0, 0.0], abs=2.0)
    assert 1.0 < np.sqrt(covariance_m2[0, 0]) < 10.0


def test_single_wrong_answer_cannot_throw_the_follower_off() -> None:
    correction = taught()
    assert not correction.receive_answer(640.0, drift_m(640.0), np.array([300.0, 0.0]))
    position_m, _ = correction.corrected(660.0, drift_m(660.0))
    assert position_m == pytest.approx([0.0, 0.0], abs=2.0)
    assert correction.gated == 1


def test_leader_that_changes_its_mind_twice_alike_is_believed() -> None:
    correction = DriftCorrection(0.0, CorrectionSettings())
    for time_s in (80.0, 120.0, 160.0, 200.0):
        correction.receive_answer(time_s, drift_m(time_s), np.array([-25.0, 20.0]) * time_s / 200)
    for time_s in (240.0, 280.0, 320.0):
        correction.receive_answer(time_s, drift_m(time_s), np.zeros(2))
    position_m, _ = correction.corrected(400.0, drift_m(400.0))
    assert position_m == pytest.approx([0.0, 0.0], abs=4.0)


def test_repeated_answer_is_not_counted_as_new_evidence() -> None:
    once, often = taught(), taught()
    for correction, times in ((once, 1), (often, 20)):
        for _ in range(times):
            correction.receive_answer(640.0, drift_m(640.0), np.array([2.0, 2.0]))
    for part in (0, 1):
        known = once.corrected(700.0, np.zeros(2))[part]
        assert often.corrected(700.0, np.zeros(2))[part] == pytest.approx(known)


def test_answer_older_than_all_that_is_kept_changes_nothing() -> None:
    correction = taught(5000.0)
    before_m = correction.corrected(5100.0, np.zeros(2))[0]
    assert not correction.receive_answer(100.0, drift_m(100.0), np.zeros(2))
    assert correction.corrected(5100.0, np.zeros(2))[0] == pytest.approx(before_m)
    assert correction.stale == 1


def test_answers_that_come_out_of_order_teach_the_same() -> None:
    times_s = np.arange(80.0, 1000.0, 40.0)
    forward, shuffled = (DriftCorrection(0.0, CorrectionSettings()) for _ in range(2))
    for correction, order in ((forward, times_s), (shuffled, np.roll(times_s, 3))):
        for time_s in order:
            assert correction.receive_answer(float(time_s), drift_m(time_s), np.zeros(2), 3.0)
    for a, b in zip(
        forward.corrected(1000.0, np.zeros(2)), shuffled.corrected(1000.0, np.zeros(2)), strict=True
    ):
        assert a == pytest.approx(b)


def test_answers_that_only_echo_dead_reckoning_do_not_make_a_follower_sure() -> None:
    correction = DriftCorrection(0.0, CorrectionSettings())
    for time_s in np.arange(20.0, 300.0, 10.0):
        correction.receive_answer(float(time_s), np.ones(2), np.zeros(2))
    _, covariance_m2 = correction.corrected(300.0, np.zeros(2))
    assert np.sqrt(covariance_m2[0, 0]) > 15.0


def test_many_answers_with_one_lasting_error_do_not_average_it_away() -> None:
    correction = DriftCorrection(0.0, CorrectionSettings())
    for time_s in np.arange(80.0, 1000.0, 10.0):
        correction.receive_answer(float(time_s), drift_m(time_s), np.array([2.0, 0.0]), 2.0)
    _, covariance_m2 = correction.corrected(1000.0, drift_m(1000.0))
    assert 1.0 < np.sqrt(covariance_m2[0, 0]) < 3.0


def test_ranges_to_the_leader_correct_along_their_direction() -> None:
    correction = DriftCorrection(0.0, CorrectionSettings())
    for time_s in np.arange(100.0, 200.0, 10.0):
        leader_m = np.array([400.0, 3.0 * (time_s - 150.0)])
        range_m = float(np.hypot(*leader_m))
        assert correction.receive_range(float(time_s), drift_m(time_s), leader_m, 1.0, range_m, 0.0)
    position_m, covariance_m2 = correction.corrected(200.0, drift_m(200.0))
    assert position_m[0] == pytest.approx(0.0, abs=2.5)
    assert covariance_m2[0, 0] < covariance_m2[1, 1]


def test_stretched_range_is_gated() -> None:
    correction = taught()
    leader_m = np.array([800.0, 0.0])
    at_m = drift_m(610.0)
    assert not correction.receive_range(610.0, at_m, leader_m, 1.0, 880.0, 0.0)
    assert correction.ranges_gated == 1


@pytest.mark.parametrize("bad_m", [0.0, -5.0, np.nan, np.inf, 100_000.0])
def test_range_that_cannot_be_is_dropped(bad_m: float) -> None:
    correction = taught()
    leader_m = np.array([9.0, 500.0])
    assert not correction.receive_range(610.0, np.zeros(2), leader_m, 1.0, bad_m, 0.0)


def test_range_counts_as_far_as_it_goes_across_and_less_the_steeper() -> None:
    at_m, leader_m = drift_m(610.0), np.array([400.0, 0.0])
    sigmas_m = []
    for apart_m in (0.0, 300.0, 800.0):
        correction = taught()
        slant_m = float(np.hypot(400.0, apart_m))
        assert correction.receive_range(610.0, at_m, leader_m, 1.0, slant_m, apart_m)
        position_m, covariance_m2 = correction.corrected(610.0, at_m)
        assert position_m[0] == pytest.approx(0.0, abs=2.5)
        sigmas_m.append(float(np.sqrt(covariance_m2[0, 0])))
    assert sigmas_m == sorted(sigmas_m)
    assert sigmas_m[2] > 1.1 * sigmas_m[0]


def test_range_shorter_than_depths_are_apart_is_dropped() -> None:
    correction = taught()
    leader_m = np.array([30.0, 0.0])
    assert not correction.receive_range(610.0, drift_m(610.0), leader_m, 1.0, 30.0, 31.0)
    assert correction.ranges_gated == 1


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_answer_that_is_no_position_is_dropped(bad: float) -> None:
    correction = taught()
    assert not correction.receive_answer(640.0, np.zeros(2), np.array([bad, 0.0]))
    assert np.isfinite(correction.corrected(700.0, np.zeros(2))[0]).all()
