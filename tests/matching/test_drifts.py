"""A shift far from the expected one implies another drift, and is judged without its strain."""

import dataclasses

import numpy as np
import pytest

from firmware.geometry import Array
from firmware.leader.ambiguity import Prior
from firmware.leader.drifts import NO_DRIFT, Drifts, screened_by_drift
from firmware.leader.matches import MatchingSettings
from firmware.leader.matching import match
from firmware.leader.pair_problem import pair_problem
from firmware.leader.screening import ErrorSurface
from firmware.leader.warping import remove_drift
from firmware.submaps import GriddedSubmap
from tests.matching.scenes import Scene

DRIFT_MPS = np.array([0.2, -0.15])
APART_S = 200.0
TRUE_M = -DRIFT_MPS * APART_S
LINEAR = Drifts(gain=np.tile(-np.eye(2) / APART_S, (2, 1)), left=np.zeros((4, 4)))
PRIOR = Prior(np.zeros(2), 30.0**2 * np.eye(2))


def _strained(scene: Scene, *, southward: bool) -> GriddedSubmap:
    """Return a sub-map of a line in 40 s, smeared by the drift about its middle."""
    grid = scene.submap(140, 150, (41, 60))
    age_s = np.linspace(-20.0, 20.0, 41)[:: -1 if southward else 1, None] * np.ones((1, 60))
    north, east = np.meshgrid(140 + 2.0 * np.arange(41), 150 + 2.0 * np.arange(60), indexing="ij")
    depth_m = scene.at(north - DRIFT_MPS[0] * age_s, east - DRIFT_MPS[1] * age_s)
    noise_m = np.sqrt(grid.variance_m2) * scene.rng.standard_normal(depth_m.shape)
    return dataclasses.replace(grid, depth_m=depth_m + noise_m, time_s=age_s + 20.0)


def _misfit(surface: ErrorSurface, shift_m: Array) -> float:
    row = int(np.argmin(np.abs(surface.north_m - shift_m[0])))
    column = int(np.argmin(np.abs(surface.east_m - shift_m[1])))
    return float(surface.residual_m2[row, column] / surface.noise_m2[row, column])


@pytest.mark.parametrize("expected_m", [(0.0, 0.0), (24.0, -16.0)])
def test_true_shift_fits_once_the_drift_that_it_implies_is_taken_out(
    expected_m: tuple[float, float],
) -> None:
    scene, prior = Scene(3), Prior(np.array(expected_m), PRIOR.covariance_m2)
    true_m = TRUE_M + prior.mean_m
    reference, query = (_strained(scene, southward=south) for south in (False, True))
    query = dataclasses.replace(
        query, north0_m=query.north0_m - true_m[0], east0_m=query.east0_m - true_m[1]
    )
    settings = MatchingSettings(position_sigma_m=0.1)
    problem = pair_problem(reference, query, settings)
    assert problem is not None
    plain = problem.surface()
    by_drift = screened_by_drift(problem, plain, (reference, query), LINEAR, prior)
    assert by_drift.residual_m2.shape == plain.residual_m2.shape
    assert _misfit(plain, true_m) > 3.0 * _misfit(by_drift, true_m)
    assert _misfit(by_drift, prior.mean_m) == _misfit(plain, prior.mean_m)


def test_known_drift_needs_no_second_look() -> None:
    scene = Scene(3)
    grids = scene.submap(200, 200, (41, 60)), scene.submap(210, 200, (41, 60))
    problem = pair_problem(*grids, MatchingSettings())
    assert problem is not None
    plain, near = problem.surface(), Prior(np.zeros(2), np.eye(2))
    assert screened_by_drift(problem, plain, grids, NO_DRIFT, PRIOR) is plain
    assert screened_by_drift(problem, plain, grids, LINEAR, near) is plain


def test_drift_that_is_not_there_draws_no_hint_away() -> None:
    settings = MatchingSettings(position_sigma_m=0.1, walk_m2_per_s=0.0, drift_sigma_mps=0.0)
    hints = []
    for seed in range(12):
        scene = Scene(seed, rms_m=0.05)
        first, second = (
            remove_drift(scene.submap(140, 150, (41, 60)), 0.02, 0.03, 20.0) for _ in range(2)
        )
        found = match(first, second, np.zeros(2), PRIOR.covariance_m2, settings, drifts=LINEAR)
        if found.hint is not None:
            hints.append(float(np.hypot(*found.hint.shift_m)))
    assert len(hints) >= 2
    assert max(hints) < 5.0


def test_drifts_of_both_sides_are_told_apart() -> None:
    gain = np.array([[0.0, 0.0], [0.0, 0.0], [-0.004, 0.001], [0.0, -0.006]])
    drifts = Drifts(gain=gain, left=1e-6 * np.eye(4))
    offset_m2 = np.diag([400.0, 900.0])
    assert drifts.covariance(offset_m2)[2:, 2:] == pytest.approx(
        gain[2:] @ offset_m2 @ gain[2:].T + 1e-6 * np.eye(2)
    )
    assert drifts.covariance(offset_m2)[:2, :2] == pytest.approx(1e-6 * np.eye(2))
    assert 0.7 < drifts.unresolved_m(offset_m2) < 1.8
    assert drifts.unresolved_m(100.0 * offset_m2) > 4.0  # more drifts than are tried


@pytest.mark.parametrize("share", [0.01, 1.0, 100.0])
def test_what_stays_unresolved_is_what_shifts_have_beside_the_drift_nearest_to_them(
    share: float,
) -> None:
    """Cells of an age of 40 s / sqrt(12), and to the nearest of two metres once they are warped."""
    gain = np.array([[0.0, 0.0], [0.0, 0.0], [-0.004, 0.0], [0.0, -0.006]])
    drifts, offset_m2 = Drifts(gain=gain, left=np.zeros((4, 4))), share * np.diag([400.0, 900.0])
    apart_m, tried = [], []
    for axis, steps_m in enumerate(drifts.steps_m(offset_m2)):
        shifts_m = np.linspace(-2.5, 2.5, 5001) * np.sqrt(offset_m2[axis, axis])
        away_m = np.abs(shifts_m[:, None] - steps_m[:, axis]).min(axis=1)
        drifts_mps = away_m * np.abs(gain[2 + axis, axis])
        apart_m.append(40.0 / np.sqrt(12.0) * np.sqrt(np.mean(drifts_mps**2)))
        tried.append(len(steps_m))
    rounded_m = 0.8 if max(tried) > 1 else 0.0
    unresolved_m = np.hypot(max(apart_m), rounded_m)
    assert drifts.unresolved_m(offset_m2) == pytest.approx(unresolved_m, rel=0.01)
    assert tried == {0.01: [1, 1], 1.0: [3, 5], 100.0: [7, 7]}[share]


def test_query_is_warped_by_its_own_drift() -> None:
    scene = Scene(3)
    still = scene.submap(140, 150, (41, 60))
    query = _strained(scene, southward=True)
    query = dataclasses.replace(
        query, north0_m=query.north0_m - TRUE_M[0], east0_m=query.east0_m - TRUE_M[1]
    )
    problem = pair_problem(still, query, MatchingSettings())
    assert problem is not None
    plain, own, other = problem.surface(), -np.eye(2) / APART_S, np.zeros((2, 2))
    right, wrong = (
        screened_by_drift(
            problem,
            plain,
            (still, query),
            Drifts(gain=np.vstack(parts), left=np.zeros((4, 4))),
            PRIOR,
        )
        for parts in ((other, own), (own, other))
    )
    assert 1.5 * _misfit(right, TRUE_M) < _misfit(plain, TRUE_M)
    assert 1.2 * _misfit(right, TRUE_M) < _misfit(wrong, TRUE_M)
