"""What a follower makes of navigation that was lost, and of a clock that is set back."""

import numpy as np
import pytest

from firmware.dead_reckoning import LOST_SIGMA_MPS
from firmware.follower.correction import CorrectionSettings, DriftCorrection
from tests.follower.test_correction import BIAS_MPS, alone_sigma_m, assert_alike, drift_m, taught


def test_a_range_heard_while_navigation_is_lost_is_held_against_the_doubt_so_far() -> None:
    correction = taught(400.0)
    lost_m = np.array([60.0, 0.0])  # how far the vehicle goes unseen by the middle of the loss
    for quarter in range(4 * 400, 4 * 500):
        correction.lose(quarter / 4.0, (quarter + 1) / 4.0)
        if quarter == 4 * 450:
            leader_m = np.array([600.0, 0.0])
            range_m = float(np.hypot(*(leader_m - lost_m)))
            correction.receive_range(450.0, drift_m(400.0), leader_m, 1.0, range_m, 0.0)
    state = correction._seen[-1].state
    mean, covariance = state.blended()
    assert correction.ranges_accepted == 1
    assert np.abs(mean[2:4] - BIAS_MPS).max() < 3.0 * np.sqrt(covariance[2, 2])
    assert covariance[0, 0] > 250.0**2 * 0.5


def test_a_loss_told_in_parts_is_one_loss() -> None:
    whole, parts = taught(), taught()
    whole.lose(610.0, 630.0)
    for time_s in np.arange(610.0, 630.0, 0.25):
        parts.lose(float(time_s), float(time_s) + 0.25)
    assert len(parts._seen) == len(whole._seen)
    assert_alike(whole, parts, 640.0)
    before_m2, lost_m2 = (c.corrected(640.0, np.zeros(2))[1][0, 0] for c in (taught(), whole))
    assert lost_m2 - before_m2 == pytest.approx((20.0 * LOST_SIGMA_MPS) ** 2)


@pytest.mark.parametrize("losses", [1, 300])
def test_what_was_lost_makes_less_sure_answers_news(losses: int) -> None:
    correction = DriftCorrection(0.0, CorrectionSettings())
    before_m2 = correction.corrected(2000.0, np.zeros(2))[1][0, 0]
    for k in range(losses):
        correction.lose(500.0 + 5.0 * k, 502.0 + 5.0 * k)
    alone_m2 = correction.corrected(2000.0, np.zeros(2))[1][0, 0]
    assert alone_m2 - before_m2 == pytest.approx(losses * (2.0 * LOST_SIGMA_MPS) ** 2)
    for share, told in ((0.97, False), (0.93, True)):
        sigma_m = float(np.sqrt(share * alone_m2))
        assert correction.receive_answer(2000.0, np.zeros(2), np.zeros(2), sigma_m) is told
    assert correction.empty == 1
    assert len(correction._lost) <= 96


def test_what_is_lost_later_makes_no_answer_news() -> None:
    correction = DriftCorrection(0.0, CorrectionSettings())
    sigma_m = 0.98 * alone_sigma_m(correction, 400.0)
    correction.lose(500.0, 520.0)
    assert not correction.receive_answer(400.0, np.zeros(2), np.zeros(2), sigma_m)
    assert correction.empty == 1


def test_what_was_learned_by_a_clock_that_was_ahead_stays_when_it_is_set_right() -> None:
    correction = taught(1200.0)
    correction.set_back(1260.0, 260.0)
    ran_away_m = drift_m(1260.0)  # and the tide turns
    position_m, covariance_m2 = correction.corrected(260.0, ran_away_m)
    assert np.abs(position_m).max() < 3.0 * np.sqrt(covariance_m2[0, 0])
    for time_s in np.arange(280.0, 880.0, 40.0):
        ran_away_m = ran_away_m - 40.0 * BIAS_MPS
        assert correction.receive_answer(float(time_s), ran_away_m, np.zeros(2))
    assert correction.corrected(840.0, ran_away_m)[0] == pytest.approx([0.0, 0.0], abs=3.0)


def test_a_clock_set_back_by_less_than_answers_are_old_leaves_them_their_times() -> None:
    """Even where a range was heard in the last quarter of a second before."""
    correction = taught(600.0)
    leader_m = np.array([500.0, 0.0])
    assert correction.receive_range(699.9, drift_m(699.9), leader_m, 1.0, 500.0, 0.0)
    correction.lose(699.9, 700.0)
    believed_m, covariance_m2 = correction.corrected(700.0, np.zeros(2))
    correction.set_back(700.0, 699.75)
    left_m, left_m2 = correction.corrected(699.75, np.zeros(2))
    assert left_m == pytest.approx(believed_m, abs=0.1)
    assert left_m2 == pytest.approx(covariance_m2, abs=0.3)
    assert correction.receive_answer(640.0, drift_m(640.0), np.zeros(2))
    assert correction.stale == 0


@pytest.mark.parametrize("told_until_s", [0.0, 600.0])
def test_a_follower_that_heard_nothing_for_long_doubts_all_of_it_when_its_clock_is_set_back(
    told_until_s: float,
) -> None:
    correction = taught(told_until_s)
    before_m = alone_sigma_m(correction, 4000.0)
    correction.set_back(4000.0, 700.0)
    assert alone_sigma_m(correction, 700.0) == pytest.approx(before_m)


def test_a_leader_that_changes_its_mind_after_a_clock_was_set_back_is_believed() -> None:
    correction = DriftCorrection(5000.0, CorrectionSettings())
    for time_s in np.arange(5080.0, 6240.0, 40.0):
        correction.receive_answer(float(time_s), drift_m(time_s), np.zeros(2), sigma_m=2.0)
    correction.set_back(6260.0, 260.0)
    moved_m = np.array([300.0, 0.0])
    for time_s in np.arange(280.0, 680.0, 40.0):
        correction.receive_answer(float(time_s), drift_m(time_s + 6000.0), moved_m, sigma_m=2.0)
    assert (correction.stale, correction.restarted) == (0, 1)
    position_m, _ = correction.corrected(660.0, drift_m(6660.0))
    assert position_m == pytest.approx(moved_m, abs=5.0)
