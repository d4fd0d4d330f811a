"""Windows of ranges with stretched and wild ones among them."""

from dataclasses import fields

import numpy as np
import pytest
from numpy.typing import NDArray

from firmware.geometry import Array
from firmware.leader.range_judge import RangeJudge, RangeSettings, RangeVerdict

TIMES_S = np.linspace(0.0, 36.0, 10)


def window(
    rng: np.random.Generator, share: float, miss_m: float, size: int = 10
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return measured, predicted and whether stretched."""
    true_m = rng.uniform(200, 600) + np.arange(size)
    stretched = rng.random(size) < share
    measured_m: Array = np.where(stretched, 1.1, 1.0) * true_m + rng.standard_normal(size)
    return measured_m, np.asarray(true_m - miss_m, dtype=np.float64), stretched


@pytest.mark.parametrize("share", [0.2, 0.8])
def test_stretched_ranges_are_told_apart_under_both_readings_of_eq_14(share: float) -> None:
    rng, judge = np.random.default_rng(8), RangeJudge(RangeSettings())
    right = total = 0
    for _ in range(60):
        measured_m, predicted_m, stretched = window(rng, share, rng.normal(0, 5))
        verdict = judge.judge(measured_m, predicted_m, TIMES_S, 5.0)
        if verdict.certain:
            judge.learn(verdict)
            used = verdict.true | verdict.stretched
            right += int(np.sum(verdict.stretched[used] == stretched[used]))
            total += int(used.sum())
    assert total > 400  # of 600; a window that is left undecided is joined by the next
    assert right / total > 0.995
    assert judge.stretched_share == pytest.approx(share, abs=0.06)


def test_hours_of_few_outliers_hide_no_window_of_many() -> None:
    rng, judge = np.random.default_rng(7), RangeJudge(RangeSettings())
    stretched = rng.random(3600) < 0.05
    judge.learn(RangeVerdict(true=~stretched, stretched=stretched, certain=True))
    certain = 0
    for _ in range(40):
        measured_m, predicted_m, stretched = window(rng, 0.8, rng.normal(0, 3), 20)
        verdict = judge.judge(measured_m, predicted_m, np.linspace(0.0, 76.0, 20), 3.0)
        certain += verdict.certain
        assert not (verdict.certain and np.any(verdict.true & stretched))
    assert certain >= 20


def test_drift_within_the_window_does_not_hide_what_is_stretched() -> None:
    rng, judge = np.random.default_rng(9), RangeJudge(RangeSettings())
    measured_m, predicted_m, stretched = window(rng, 0.2, 30.0)
    verdict = judge.judge(measured_m, predicted_m - 0.3 * TIMES_S, TIMES_S, 40.0)
    assert verdict.certain
    assert verdict.stretched.tolist() == stretched.tolist()


@pytest.mark.parametrize("factor", [1.0, 1.001])
def test_a_stretch_too_small_to_be_told_is_none(factor: float) -> None:
    judge = RangeJudge(RangeSettings(outlier_factor=factor))
    true_m = 300.0 + np.arange(10.0)
    verdict = judge.judge(true_m, true_m, TIMES_S, 3.0)
    assert verdict.true.all()
    assert not verdict.stretched.any()


def test_window_with_two_equal_explanations_is_left_undecided() -> None:
    judge = RangeJudge(RangeSettings())
    true_m = np.full(6, 300.0)
    measured_m = np.where(np.arange(6) % 2 == 0, 1.1, 1.0) * true_m
    lonely_m = np.array([330.0])
    assert not judge.judge(lonely_m, np.array([315.0]), TIMES_S[:1], 60.0).certain
    assert judge.judge(measured_m, true_m, TIMES_S[:6], 2.0).certain


@pytest.mark.parametrize(
    ("seconds", "off_m", "believed"), [(18.0, 7.0, False), (60.0, 7.0, True), (60.0, 16.0, False)]
)
def test_ranges_scatter_as_far_as_dead_reckoning_errs_meanwhile(
    seconds: float, off_m: float, *, believed: bool
) -> None:
    """The root of a metre's noise and 1.3 m in 20 s, or 2.3 m in a minute; beyond it is wild."""
    true_m = np.full(10, 300.0)
    measured_m = true_m + off_m * (np.arange(10) == 5)
    judge = RangeJudge(RangeSettings())
    verdict = judge.judge(measured_m, true_m, np.linspace(0.0, seconds, 10), 3.0)
    assert verdict.certain
    assert np.delete(verdict.true, 5).all()
    assert (verdict.true[5], verdict.stretched[5]) == (believed, False)


@pytest.mark.parametrize("bad_m", [0.0, -3.0, 100_000.0, np.nan, np.inf])
def test_impossible_range_is_neither_true_nor_stretched(bad_m: float) -> None:
    measured_m = np.array([300.0, bad_m, 301.0, 299.5])
    verdict = RangeJudge(RangeSettings()).judge(measured_m, np.full(4, 300.0), TIMES_S[:4], 3.0)
    assert verdict.true.tolist() == [True, False, True, True]
    assert not verdict.stretched.any()


def test_window_of_impossible_ranges_alone_is_not_certain() -> None:
    verdict = RangeJudge(RangeSettings()).judge(
        np.full(3, np.nan), np.full(3, 300.0), TIMES_S[:3], 3.0
    )
    assert not verdict.certain


def test_longest_window_is_judged_even_if_nothing_explains_it() -> None:
    """The product of so many densities stays within a double."""
    longest = next(f for f in fields(RangeSettings) if f.name == "joined").metadata["maximum"]
    judge, times_s = RangeJudge(RangeSettings(joined=longest)), np.linspace(0.0, 60.0, longest)
    verdict = judge.judge(np.full(longest, 5000.0), np.full(longest, 300.0), times_s, 3.0)
    assert not verdict.true.any()
    assert not verdict.stretched.any()
    true_m = 300.0 + 0.1 * times_s
    assert judge.judge(true_m, true_m, times_s, 3.0).true.all()


def test_lost_prediction_is_told_from_a_window_of_stretched_ranges() -> None:
    """An estimate that is 30 m off, and sure of 2 m, must not read true ranges as stretched."""
    judge, rng = RangeJudge(RangeSettings()), np.random.default_rng(10)
    true_m = np.full(4, 300.0)
    measured_m = true_m + rng.standard_normal(4)
    assert not judge.judge(measured_m, true_m - 30.0, TIMES_S[:4], 2.0).certain
    certain = 0
    for _ in range(40):
        measured_m, predicted_m, stretched = window(rng, 0.2, 30.0)
        verdict = judge.judge(measured_m, predicted_m, TIMES_S, 2.0)
        if verdict.certain:  # those that are not are joined by the next
            judge.learn(verdict)
            assert verdict.stretched.tolist() == stretched.tolist()
        certain += verdict.certain
    assert certain >= 30
