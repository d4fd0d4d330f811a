"""A shift far from the expected one implies another drift, and is judged without its strain."""

import dataclasses

import numpy as np

from firmware.geometry import Array
from firmware.leader.ambiguity import Prior
from firmware.leader.drifts import NO_DRIFT, Drifts, screened_by_drift
from firmware.leader.matching import MatchingSettings
from firmware.leader.pair_problem import pair_problem
from firmware.leader.screening import ErrorSurface
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


def test_true_shift_fits_once_the_drift_that_it_implies_is_taken_out() -> None:
    scene = Scene(3)
    reference, query = (_strained(scene, southward=south) for south in (False, True))
    query = dataclasses.replace(
        query, north0_m=query.north0_m - TRUE_M[0], east0_m=query.east0_m - TRUE_M[1]
    )
    settings = MatchingSettings(position_sigma_m=0.1)
    problem = pair_problem(
        reference, query, settings, reference_reconstructed=False, query_reconstructed=False
    )
    assert problem is not None
    by_drift = screened_by_drift(problem, (reference, query), LINEAR, PRIOR)
    assert by_drift is not None
    plain = problem.surface()
    assert by_drift.residual_m2.shape == plain.residual_m2.shape
    assert _misfit(plain, TRUE_M) > 3.0 * _misfit(by_drift, TRUE_M)
    assert _misfit(by_drift, np.zeros(2)) == _misfit(plain, np.zeros(2))


def test_known_drift_needs_no_second_look() -> None:
    scene = Scene(3)
    grids = scene.submap(200, 200, (41, 60)), scene.submap(210, 200, (41, 60))
    problem = pair_problem(
        *grids, MatchingSettings(), reference_reconstructed=False, query_reconstructed=False
    )
    assert problem is not None
    assert screened_by_drift(problem, grids, NO_DRIFT, PRIOR) is None
    near = Prior(np.zeros(2), np.eye(2))
    assert screened_by_drift(problem, grids, LINEAR, near) is None
