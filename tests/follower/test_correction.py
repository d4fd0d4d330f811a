"""What answers teach a follower, and what they must not."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from firmware.follower.correction import CorrectionSettings, DriftCorrection
from firmware.follower.drift_filter import AnswerSeen, DriftFilter, DriftSettings, RangeSeen

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


def alone_sigma_m(correction: DriftCorrection, at_s: float) -> float:
    return float(np.sqrt(correction.corrected(at_s, np.zeros(2))[1][0, 0]))


def in_current(
    walk: float, until_s: float, seed: int, memory_s: float = 3600.0
) -> tuple[DriftCorrection, np.ndarray]:
    """Return what is learned of a drift that wanders, (T, 2), told with an error of a metre."""
    rng = np.random.default_rng(seed)
    bias_mps = BIAS_MPS + np.cumsum(walk * np.sqrt(10.0) * rng.normal(size=(1000, 2)), axis=0)
    ran_away_m = np.cumsum(
        10.0 * bias_mps + 0.2 * np.sqrt(10.0) * rng.normal(size=(1000, 2)), axis=0
    )
    correction = DriftCorrection(0.0, CorrectionSettings(walk_memory_s=memory_s))
    for k in range(4, int(until_s / 10.0), 4):
        said_m = rng.normal(scale=1.0, size=2)
        correction.receive_answer(10.0 * (k + 1), ran_away_m[k], said_m, sigma_m=1.0)
    return correction, ran_away_m


@pytest.mark.parametrize("walk", [0.0003, 0.004, 0.012])
def test_how_much_drift_wanders_is_learned_from_answers(walk: float) -> None:
    """Whatever the walk, ten minutes after the last of many answers the belief is as sure as right.

    Two is right. Where the prior's walk is taken for granted, the mean chi square is .3 in still
    water and 27 in the wildest.
    """
    chi_square = []
    for seed in range(40):
        correction, ran_away_m = in_current(walk, 3000.0, seed)
        position_m, covariance_m2 = correction.corrected(3600.0, ran_away_m[359])
        chi_square.append(position_m @ np.linalg.solve(covariance_m2, position_m))
    assert 0.5 < np.mean(chi_square) < 4.0


def test_still_water_that_begins_to_turn_is_noticed() -> None:
    """What was unlikely for hours is likely again within forty minutes; no answer is refused."""
    still, ran_away_m = in_current(0.0003, 9000.0, seed=2)
    before_m = alone_sigma_m(still, 9600.0)
    rng = np.random.default_rng(2)
    bias_mps, away_m = BIAS_MPS.copy(), ran_away_m[896].copy()
    for k in range(60):
        bias_mps += 0.006 * np.sqrt(40.0) * rng.normal(size=2)
        away_m += 40.0 * bias_mps
        still.receive_answer(8970.0 + 40.0 * (k + 1), away_m, np.zeros(2), sigma_m=1.0)
    assert (still.restarted, still.gated) == (0, 0)
    assert alone_sigma_m(still, 8970.0 + 2400.0 + 630.0) > 2.5 * before_m


def test_prior_of_walks_has_the_believed_one_for_its_root_mean_square() -> None:
    settings = DriftSettings()
    drift = DriftFilter(settings)
    _, covariance = drift.predicted(drift.deployed(0.0), 3600.0).blended()
    alone_m2 = settings.start_sigma_m**2 + settings.odometry_noise**2 * 3600.0
    alone_m2 += (settings.bias_sigma_mps * 3600.0) ** 2 + settings.bias_walk**2 * 3600.0**3 / 3
    assert covariance[0, 0] == pytest.approx(alone_m2, rel=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_answers_that_claim_to_be_surer_than_they_are_do_not_open_the_gate(seed: int) -> None:
    """They err by four of their sigmas, and anew each time; then one is 300 m off."""
    rng, correction = np.random.default_rng(seed), DriftCorrection(0.0, CorrectionSettings())
    for time_s in np.arange(10.0, 2301.0, 10.0):
        said_m = 4.0 * rng.standard_normal(2)
        correction.receive_answer(float(time_s), np.zeros(2), said_m, sigma_m=1.0)
    assert not correction.receive_answer(2400.0, np.zeros(2), np.array([300.0, 0.0]), sigma_m=1.0)


def test_what_was_learned_of_a_walk_fades() -> None:
    drift = DriftFilter(DriftSettings())
    state = first = drift.deployed(0.0)
    for time_s in np.arange(100.0, 9000.0, 100.0):
        seen = AnswerSeen(time_s=float(time_s), ran_away_m=np.zeros(2), sigma_m=1.0)
        state = drift.updated(state, seen)
    learned = state.log_weights - first.log_weights
    assert np.ptp(learned) > 10.0
    later = drift.predicted(state, 9000.0 + 5.0 * 3600.0).log_weights - first.log_weights
    assert np.ptp(later) < 0.01 * np.ptp(learned)


def test_drift_is_predicted_alike_in_one_step_and_in_many() -> None:
    drift = DriftFilter(DriftSettings())
    seen = AnswerSeen(time_s=300.0, ran_away_m=np.array([20.0, -9.0]), sigma_m=2.0)
    once = steps = drift.updated(drift.deployed(100.0), seen)
    for time_s in np.arange(310.0, 901.0, 10.0):
        steps = drift.predicted(steps, float(time_s))
    once = drift.predicted(once, 900.0)
    np.testing.assert_allclose(steps.means, once.means)
    np.testing.assert_allclose(steps.covariances, once.covariances, atol=1e-9)
    np.testing.assert_allclose(steps.log_weights, once.log_weights)


def test_a_range_teaches_what_draws_of_all_that_is_unsure_say() -> None:
    rng, s = np.random.default_rng(5), DriftSettings()
    root = np.diag([4.0, 3.0, 0.1, 0.1, 1.0, 1.0]) @ rng.standard_normal((6, 6)) / 2.0
    mean, covariance = np.array([20.0, -10.0, 0.1, 0.0, 0.4, -0.6]), root @ root.T
    seen = RangeSeen(
        time_s=0.0,
        reckoned_m=np.array([50.0, 60.0]),
        leader_m=np.array([330.0, 460.0]),
        leader_sigma_m=4.0,
        range_m=470.0,
        depth_difference_m=400.0,
    )
    draws = rng.multivariate_normal(mean, covariance, 400_000)
    fresh = s.fresh_share * rng.standard_normal((400_000, 2))
    leader_errors_m = seen.leader_sigma_m * (np.sqrt(1.0 - s.fresh_share**2) * draws[:, 4:] + fresh)
    between_m = seen.reckoned_m - draws[:, :2] - (seen.leader_m - leader_errors_m)
    slants_m = np.hypot(np.hypot(*between_m.T), seen.depth_difference_m)
    slants_m += s.range_sigma_m * rng.standard_normal(400_000)
    ranges_m = np.sqrt(slants_m**2 - seen.depth_difference_m**2)
    joint = np.cov(draws.T, ranges_m)
    gain = joint[:6, 6] / joint[6, 6]
    start = DriftFilter(s).deployed(0.0)
    state = replace(
        start,
        means=np.tile(mean, (len(start.means), 1)),
        covariances=np.tile(covariance, (len(start.means), 1, 1)),
    )
    learned, known = DriftFilter(s).updated(state, seen), np.sqrt(np.diag(covariance))
    expected = mean + gain * (seen.range_m - ranges_m.mean())
    assert (learned.means[0] - expected) / known == pytest.approx(np.zeros(6), abs=0.03)
    left = covariance - joint[6, 6] * np.outer(gain, gain)
    away = (learned.covariances[0] - left) / np.outer(known, known)
    assert away == pytest.approx(np.zeros((6, 6)), abs=0.03)


def test_a_checkpoint_holds_what_was_seen_and_gives_the_same_belief() -> None:
    correction, _ = in_current(0.004, 6000.0, seed=3)
    body = pickle.dumps(correction, protocol=5)
    assert len(body) < 100_000
    for told, again in zip(
        correction.corrected(6100.0, np.zeros(2)),
        pickle.loads(body).corrected(6100.0, np.zeros(2)),
        strict=True,
    ):
        assert np.array_equal(told, again)


def test_single_wrong_answer_cannot_throw_the_follower_off() -> None:
    correction = taught()
    assert not correction.receive_answer(640.0, drift_m(640.0), np.array([300.0, 0.0]))
    position_m, _ = correction.corrected(660.0, drift_m(660.0))
    assert position_m == pytest.approx([0.0, 0.0], abs=2.0)
    assert correction.gated == 1


def test_answer_that_is_not_believed_takes_nothing_from_those_that_are() -> None:
    """Neither that of the same state, nor that it may have been dead reckoning again."""
    told, echoed = (DriftCorrection(0.0, CorrectionSettings()) for _ in range(2))
    assert told.receive_answer(600.0, np.array([30.0, 0.0]), np.zeros(2), 2.0)
    assert echoed.receive_answer(40.0, np.zeros(2), np.zeros(2))
    for correction, time_s in ((told, 600.0), (echoed, 60.0)):
        before = correction.corrected(620.0, np.array([30.0, 0.0]))
        assert not correction.receive_answer(time_s, np.zeros(2), np.array([2000.0, 0.0]))
        for was, left in zip(
            before, correction.corrected(620.0, np.array([30.0, 0.0])), strict=True
        ):
            np.testing.assert_array_equal(left, was)


def test_leader_that_changes_its_mind_twice_alike_is_believed() -> None:
    correction = DriftCorrection(0.0, CorrectionSettings())
    for time_s in (80.0, 120.0, 160.0, 200.0):
        correction.receive_answer(time_s, drift_m(time_s), np.array([-25.0, 20.0]) * time_s / 200)
    for time_s in (240.0, 280.0, 320.0):
        correction.receive_answer(time_s, drift_m(time_s), np.zeros(2))
    position_m, _ = correction.corrected(400.0, drift_m(400.0))
    assert position_m == pytest.approx([0.0, 0.0], abs=4.0)


@pytest.mark.parametrize(
    ("apart_s", "apart_m", "believed"),
    [(40.0, 25.0, True), (40.0, 27.0, False), (2.0, 7.0, True), (2.0, 11.0, False)],
)
def test_only_answers_that_agree_make_a_follower_start_over(
    apart_s: float, apart_m: float, *, believed: bool
) -> None:
    """Within four sigmas of 2 m, and three of a drift of 0.15 m/s meanwhile."""
    correction, moved_m = taught(), np.array([300.0, 0.0])
    correction.lose(100.0, 101.0)
    assert not correction.receive_answer(640.0, drift_m(640.0), moved_m, 2.0)
    later_s = 640.0 + apart_s
    moved_m = np.array([300.0, apart_m])
    ran_away_m = drift_m(640.0)
    assert correction.receive_answer(later_s, ran_away_m, moved_m, 2.0) is believed
    assert correction.restarted == believed
    position_m, _ = correction.corrected(later_s, ran_away_m)
    assert position_m == pytest.approx(moved_m if believed else np.zeros(2), abs=8.0)


def test_a_right_answer_between_takes_a_wrong_one_its_witness() -> None:
    correction = taught()
    for time_s, off_m in ((640.0, 300.0), (680.0, 0.0), (720.0, 300.0)):
        believed = correction.receive_answer(time_s, drift_m(time_s), np.array([off_m, 0.0]), 2.0)
        assert believed is (off_m == 0.0)
    assert (correction.restarted, correction.gated) == (0, 2)


def test_repeated_answer_is_not_counted_as_new_evidence() -> None:
    once, often = taught(), taught()
    for correction, times in ((once, 1), (often, 20)):
        for _ in range(times):
            correction.receive_answer(640.0, drift_m(640.0), np.array([2.0, 2.0]))
    for part in (0, 1):
        known = once.corrected(700.0, np.zeros(2))[part]
        assert often.corrected(700.0, np.zeros(2))[part] == pytest.approx(known)


def assert_alike(one: DriftCorrection, other: DriftCorrection, time_s: float) -> None:
    for part, as_well in zip(
        one.corrected(time_s, np.zeros(2)), other.corrected(time_s, np.zeros(2)), strict=True
    ):
        assert part == pytest.approx(as_well)


def test_a_later_answer_for_the_same_state_takes_the_place_of_the_earlier_one() -> None:
    replaced, told_once = (DriftCorrection(0.0, CorrectionSettings()) for _ in range(2))
    for correction, offs_m in ((replaced, ([6.0, -4.0], [0.0, 0.0])), (told_once, ([0.0, 0.0],))):
        for time_s in (200.0, 300.0, 500.0):
            correction.receive_answer(time_s, drift_m(time_s), np.zeros(2), 12.0 - time_s / 50.0)
        for off_m in offs_m:
            assert correction.receive_answer(400.0, drift_m(400.0), np.array(off_m), 1.0)
    assert_alike(replaced, told_once, 600.0)


def test_an_answer_long_under_way_is_held_against_what_was_believed_of_its_time() -> None:
    correction = DriftCorrection(0.0, CorrectionSettings())
    assert correction.receive_answer(600.0, np.array([90.0, 0.0]), np.zeros(2), 1.0)
    assert correction.receive_answer(20.0, np.array([0.5, 0.0]), np.zeros(2), 1.0)
    position_m, _ = correction.corrected(600.0, np.array([90.0, 0.0]))
    assert position_m == pytest.approx([0.0, 0.0], abs=2.0)


def test_what_comes_in_any_order_teaches_the_same() -> None:
    """Ranges, an answer and a loss; no part counts twice."""
    forward, shuffled = (DriftCorrection(0.0, CorrectionSettings()) for _ in range(2))
    for correction, order in ((forward, (0, 1, 2, 3, 4)), (shuffled, (3, 0, 4, 2, 1))):
        for k in order:
            time_s = 100.0 + 20.0 * k
            if k == 1:
                assert correction.receive_answer(time_s, drift_m(time_s), np.ones(2), 4.0)
            elif k == 2:
                correction.lose(time_s - 3.0, time_s)
            else:
                range_m = 300.0 + k
                leader_m = drift_m(time_s) + np.array([0.0, 300.0])
                assert correction.receive_range(
                    time_s, drift_m(time_s), leader_m, 1.0, range_m, 0.0
                )
    assert (forward.ranges_accepted, forward.accepted) == (3, 1)
    assert_alike(forward, shuffled, 200.0)


@pytest.mark.parametrize(
    ("time_s", "missed_m", "echo"),
    [(300.0, 45.0, True), (300.0, 57.0, False), (3000.0, 45.0, False)],
)
def test_an_answer_near_dead_reckoning_is_an_echo_of_it_as_long_as_that_is_likelier(
    time_s: float, missed_m: float, *, echo: bool
) -> None:
    correction = DriftCorrection(0.0, CorrectionSettings())
    assert correction.receive_answer(time_s, np.array([missed_m, 0.0]), np.zeros(2))
    assert (alone_sigma_m(correction, time_s) > 15.0) is echo


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


def test_what_a_leader_says_again_and_again_is_believed_once() -> None:
    """A leader that was told one thing early carries it on: its answers grow, their news does not.

    It knows the drift to 0.1 instead of 0.15 m/s, and learns no more.
    """
    correction, s = DriftCorrection(0.0, CorrectionSettings()), CorrectionSettings()
    for time_s in np.arange(80.0, 400.0, 40.0):
        said_m = np.array([0.15 * time_s, 0.0])
        variance_m2 = (0.1 * time_s) ** 2 + s.odometry_noise**2 * time_s
        correction.receive_answer(float(time_s), said_m, np.zeros(2), float(np.sqrt(variance_m2)))
    position_m, covariance_m2 = correction.corrected(float(time_s), said_m)
    assert position_m == pytest.approx([0.0, 0.0], abs=3.0)
    assert variance_m2 < covariance_m2[0, 0] < 1.3 * variance_m2


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
    for depth_difference_m in (0.0, 300.0, 800.0):
        correction = taught()
        slant_m = float(np.hypot(400.0, depth_difference_m))
        assert correction.receive_range(610.0, at_m, leader_m, 1.0, slant_m, depth_difference_m)
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
    assert correction.gated == 1
    assert np.isfinite(correction.corrected(700.0, np.zeros(2))[0]).all()


def test_answers_that_claim_to_be_certain_leave_a_covariance() -> None:
    correction = DriftCorrection(0.0, CorrectionSettings())
    for time_s in np.arange(10.0, 300.0, 10.0):
        correction.receive_answer(float(time_s), np.zeros(2), np.zeros(2), 1e-19)
    assert correction.accepted > 20
    assert np.linalg.eigvalsh(correction.corrected(290.0, np.zeros(2))[1])[0] > 0.01**2
