import numpy as np
import pytest

from firmware.geometry import Array
from firmware.leader.consistency import (
    CandidateClosure,
    Consistency,
    ConsistencySettings,
    Keys,
    RelativeOdometry,
    agreement,
    consistent_set,
    largest_clique,
)

SETTINGS = ConsistencySettings()
OTHER = 1000  # keys of the second vehicle start here


def survey(rng: np.random.Generator) -> tuple[Array, RelativeOdometry]:
    """Return true positions of two vehicles' nodes and odometry that walks away from them."""
    truth = rng.uniform(0.0, 500.0, (2, 200, 2))
    walk = np.cumsum(rng.normal(0.0, 0.3, truth.shape), axis=1)

    def odometry(first: Keys, second: Keys) -> tuple[Array, Array]:
        (v, i), (w, j) = np.divmod(first, OTHER), np.divmod(second, OTHER)
        offset = (truth + walk)[w, j] - (truth + walk)[v, i]
        offset[v != w] = np.nan
        steps = np.abs(i - j)[:, None, None]
        return offset, 0.09 * steps * np.eye(2)

    return truth, odometry


def closures_of(
    truth: Array, rng: np.random.Generator, good: int, bad: int
) -> tuple[list[CandidateClosure], Array]:
    closures, valid = [], []
    for number in range(good + bad):
        i, j = rng.integers(0, 200, 2)
        noise = rng.normal(0.0, 0.7, 2) if number < good else rng.uniform(-60.0, 60.0, 2)
        offset = truth[1, j] - truth[0, i] + noise
        ends = (int(i), OTHER + int(j))
        if rng.random() < 0.5:
            ends, offset = ends[::-1], -offset
        closures.append(
            CandidateClosure(
                origin=ends[0], target=ends[1], offset_m=offset, covariance_m2=0.49 * np.eye(2)
            )
        )
        valid.append(number < good)
    order = rng.permutation(good + bad)
    return [closures[k] for k in order], np.array(valid)[order]


def judged(
    closures: list[CandidateClosure], odometry: RelativeOdometry, settings: ConsistencySettings
) -> Consistency:
    """Return the verdict on closures that all rest on soundings of their own."""
    alike = np.zeros((len(closures), len(closures)), dtype=bool)
    return consistent_set(closures, odometry, settings, alike)


@pytest.mark.parametrize("bad_share", [0.3, 0.5, 0.6])
def test_false_closures_stay_outside_the_clique(bad_share: float) -> None:
    rng = np.random.default_rng(3)
    truth, odometry = survey(rng)
    bad = int(100 * bad_share)
    closures, valid = closures_of(truth, rng, 100 - bad, bad)
    result = judged(closures, odometry, SETTINGS)
    assert valid[result.believed].mean() > 0.95
    assert result.believed[valid].mean() > 0.75
    assert result.partners[result.believed].min() > 10


def test_three_windows_agree_with_one() -> None:
    rng = np.random.default_rng(4)
    truth, odometry = survey(rng)
    closures, valid = closures_of(truth, rng, 160, 80)
    result = judged(closures, odometry, ConsistencySettings(window=120))
    assert valid[result.believed].mean() > 0.95
    assert result.believed[valid].mean() > 0.75


def test_pairs_without_odometry_between_them_do_not_contradict() -> None:
    def nothing(first: Keys, second: Keys) -> tuple[Array, Array]:
        assert first.size == second.size
        return np.full((first.size, 2), np.nan), np.full((first.size, 2, 2), np.nan)

    rng = np.random.default_rng(5)
    truth, _ = survey(rng)
    closures, _ = closures_of(truth, rng, 5, 5)
    agree, known = agreement(closures, nothing, SETTINGS)
    assert not known.any()
    assert agree.sum() == 90
    result = judged(closures, nothing, SETTINGS)
    assert result.believed.all()
    assert not result.partners.any()


@pytest.mark.parametrize("ends", [(10, 1010), (1010, 10)])
def test_of_two_loops_the_tighter_one_decides(ends: tuple[int, int]) -> None:
    """The other way round dead reckoning is so unsure that everything agrees."""

    def at_anchor(first: Keys, second: Keys) -> tuple[Array, Array]:
        variance_m2 = 0.1 * np.abs(second - first)
        return np.zeros((first.size, 2)), variance_m2[:, None, None] * np.eye(2)

    def closure(origin: int, target: int, north_m: float) -> CandidateClosure:
        return CandidateClosure(
            origin=origin,
            target=target,
            offset_m=np.array([north_m, 0.0]),
            covariance_m2=0.25 * np.eye(2),
        )

    for north_m, is_alike in ((2.0, True), (20.0, False)):
        pair = [closure(0, 1000, north_m), closure(*ends, 0.0)]
        agree, known = agreement(pair, at_anchor, SETTINGS)
        assert (bool(agree[0, 1]), bool(known[0, 1])) == (is_alike, True)


def test_none_and_one_closure_are_consistent() -> None:
    truth, odometry = survey(np.random.default_rng(6))
    assert judged([], odometry, SETTINGS).believed.size == 0
    closures, _ = closures_of(truth, np.random.default_rng(6), 1, 0)
    assert judged(closures, odometry, SETTINGS).believed.all()


def test_clique_is_the_largest_of_two_disjoint_ones() -> None:
    agree = np.zeros((7, 7), dtype=bool)
    agree[:3, :3] = agree[3:, 3:] = True
    np.fill_diagonal(agree, val=False)
    assert largest_clique(agree, 7).tolist() == [3, 4, 5, 6]


def test_one_axis_closure_agrees_whatever_it_says_across() -> None:
    rng = np.random.default_rng(7)
    truth, odometry = survey(rng)
    closures, _ = closures_of(truth, rng, 20, 0)
    wide = CandidateClosure(
        origin=5,
        target=OTHER + 9,
        offset_m=truth[1, 9] - truth[0, 5] + [0.0, 50.0],
        covariance_m2=np.diag([0.5, 200.0**2]),
    )
    assert judged([*closures, wide], odometry, SETTINGS).believed[-1]
