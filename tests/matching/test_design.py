"""What explains how two sub-maps differ, and how surely the fit tells the shift."""

import dataclasses

import numpy as np
import pytest

from firmware.geometry import Array
from firmware.leader.alignment import Coupling, align
from firmware.leader.ambiguity import Prior
from firmware.leader.covariance import measure
from firmware.leader.design import design_of
from firmware.leader.drifts import Drifts
from firmware.leader.matches import MatchingSettings, PairSigmas
from firmware.leader.matching import match
from firmware.leader.pair_problem import noise_model, pair_problem
from firmware.leader.refinement import refine
from firmware.leader.relief import smoothing_cells, spectrum
from firmware.leader.screening import prepare
from firmware.submaps import GriddedSubmap
from tests.matching.scenes import Scene

PLAIN = MatchingSettings(
    walk_m2_per_s=0.0,
    drift_sigma_mps=0.0,
    position_sigma_m=0.0,
    absolute_depth=True,
    cell_sigma_m=0.001,
)
LEVEL = PairSigmas(tilt=0.0, bend_per_m=0.0)


def test_shift_between_other_times_has_run_on_with_the_drifts() -> None:
    """Told by a hundred thousand pairs: shift and drifts at some times, shift at others."""
    rng = np.random.default_rng(1)
    root = rng.standard_normal((6, 6)) * np.array([5.0, 5.0, 0.2, 0.2, 0.1, 0.1])[:, None]
    coupling = Coupling(mean_m=np.zeros(2), covariance=root @ root.T, times_s=(100.0, 300.0))
    pairs = root @ rng.standard_normal((6, 100_000))
    reference_mps, query_mps = pairs[2:4], pairs[4:]
    # a cell of the query lies drift times age too far along: it takes a shift that much smaller
    shift_m = pairs[:2] + 7.0 * reference_mps + 12.0 * query_mps
    gain, left = coupling.drifts_at((107.0, 288.0))
    told = np.cov(np.vstack([shift_m, pairs[2:]]))
    expected = np.linalg.solve(told[:2, :2], told[:2, 2:]).T
    assert gain == pytest.approx(expected, rel=0.05, abs=0.001)
    assert left == pytest.approx(told[2:, 2:] - expected @ told[:2, 2:], rel=0.05, abs=2e-4)


def _pair(seed: int, rms_m: float, truth_m: Array) -> tuple[GriddedSubmap, GriddedSubmap]:
    scene = Scene(seed, rms_m=rms_m)
    shift_m = (float(truth_m[0]), float(truth_m[1]))
    return (
        scene.submap(200, 100, (41, 70), sigma_m=0.1),
        scene.submap(210, 160, (41, 70), shift_m=shift_m, sigma_m=0.1),
    )


@pytest.mark.parametrize("rms_m", [0.4, 0.1])
def test_noise_in_the_slopes_makes_the_covariance_neither_small_nor_large(rms_m: float) -> None:
    nees, truth_m = [], np.array([0.7, -0.4])
    for seed in range(40):
        problem = pair_problem(*_pair(seed, rms_m, truth_m), PLAIN, LEVEL)
        assert problem is not None
        noise = noise_model(PLAIN, 0.0, LEVEL)
        found = refine(problem.reference, problem.query, problem.fields(), truth_m, noise)
        assert found is not None
        refined = measure(found, noise)
        error_m = refined.shift_m - truth_m
        nees.append(float(error_m @ np.linalg.solve(refined.covariance_m2, error_m)))
    assert 1.2 < np.mean(nees) < 2.8


def test_columns_do_to_the_difference_what_shift_and_drifts_do() -> None:
    scene = Scene(2)
    still = scene.submap(150, 150, (61, 61), sigma_m=0.0)
    problem = pair_problem(still, still, PLAIN, LEVEL)
    assert problem is not None
    field = align(problem.reference, problem.query, problem.fields(), np.zeros(2), problem.noise)
    assert field is not None
    columns = design_of(field, problem.noise).columns
    north_m, east_m = 150.0 + 2.0 * np.mgrid[:61, :61]
    for k, step_m in enumerate(np.eye(2)):
        ahead_m, behind_m = (
            scene.at(north_m + sign * step_m[0], east_m + sign * step_m[1])[field.both]
            for sign in (1.0, -1.0)
        )
        assert np.corrcoef(columns[k], ahead_m - behind_m)[0, 1] > 0.9
        assert columns[2 + k] == pytest.approx(-columns[k] * field.spans[0].age_s)
        assert columns[4 + k] == pytest.approx(columns[k] * field.spans[1].age_s)


def _smeared(scene: Scene, drift_mps: Array, *, southward: bool) -> GriddedSubmap:
    """Return a sub-map of a line in 40 s: each cell lies drift times age too far along."""
    grid = scene.submap(140, 150, (41, 60), sigma_m=0.1)
    age_s = np.linspace(-20.0, 20.0, 41)[:: -1 if southward else 1, None] * np.ones((1, 60))
    north_m, east_m = 140.0 + 2.0 * np.arange(41)[:, None], 150.0 + 2.0 * np.arange(60)[None, :]
    depth_m = scene.at(north_m - drift_mps[0] * age_s, east_m - drift_mps[1] * age_s)
    noise_m = np.sqrt(grid.variance_m2) * scene.rng.standard_normal(depth_m.shape)
    return dataclasses.replace(grid, depth_m=depth_m + noise_m, time_s=age_s + 20.0)


def test_a_shift_is_fitted_with_the_drift_that_it_implies() -> None:
    """One vehicle's unknown drift makes the offset of two lines; alone, it would blur it."""
    drift_mps, apart_s, sigma_mps = np.array([0.04, -0.03]), 20.0, 0.2
    truth_m = -drift_mps * apart_s
    prior = Prior(np.zeros(2), (sigma_mps * apart_s) ** 2 * np.eye(2))
    beside = Drifts(gain=np.zeros((4, 2)), left=sigma_mps**2 * np.eye(4))
    implied = Drifts(gain=np.tile(-np.eye(2) / apart_s, (2, 1)), left=1e-8 * np.eye(4))
    errors_m, sigmas_m = [], []
    for drifts in (beside, implied):
        found = []
        for seed in range(10):
            scene = Scene(seed, rms_m=0.15)
            reference, query = (_smeared(scene, drift_mps, southward=way) for way in (False, True))
            query = dataclasses.replace(
                query, north0_m=query.north0_m - truth_m[0], east0_m=query.east0_m - truth_m[1]
            )
            problem = pair_problem(reference, query, PLAIN, LEVEL)
            assert problem is not None
            problem = problem.coupled(drifts.coupling(prior, reference, query))
            field = refine(
                problem.reference, problem.query, problem.fields(), truth_m, problem.noise
            )
            assert field is not None
            found.append(measure(field, problem.noise))
        errors_m.append(np.sqrt(np.mean([np.sum((m.shift_m - truth_m) ** 2) for m in found])))
        sigmas_m.append(np.sqrt(np.mean([np.trace(m.covariance_m2) for m in found])))
    assert sigmas_m[1] < 0.8 * sigmas_m[0]
    assert max(errors_m) < 0.3  # of 1 m; slopes are not those of cells that lie metres apart


def _lines(seed: int) -> tuple[GriddedSubmap, GriddedSubmap]:
    """Return sub-maps of one place without drift, on lines of opposite heading."""
    scene = Scene(seed, rms_m=0.3)
    first, second = (scene.submap(140, 150, (41, 60), sigma_m=0.1) for _ in range(2))
    return first, dataclasses.replace(second, time_s=second.time_s[::-1] + 100.0)


def test_a_match_hears_what_its_shift_implies() -> None:
    still = dataclasses.replace(MatchingSettings(), walk_m2_per_s=0.0, drift_sigma_mps=0.0)
    shifts_m = []
    for expected_m in (0.0, 3.0):
        drifts = Drifts(
            gain=np.tile(-np.eye(2) / 20.0, (2, 1)),
            left=1e-8 * np.eye(4),
            expected_m=np.array([expected_m, 0.0]),
        )
        outcome = match(*_lines(1), np.zeros(2), 16.0 * np.eye(2), still, drifts=drifts)
        assert outcome.match is not None
        shifts_m.append(outcome.match.shift_m)
    assert np.hypot(*shifts_m[0]) < 0.3
    assert shifts_m[1][0] - shifts_m[0][0] > 0.3


@pytest.mark.parametrize(("expected_m", "right"), [(0.0, True), (8.0, False)])
def test_grids_were_rid_of_the_drift_of_the_expected_shift(
    expected_m: float, *, right: bool
) -> None:
    drifts = Drifts(
        gain=np.tile(-np.eye(2) / 20.0, (2, 1)),
        left=1e-8 * np.eye(4),
        expected_m=np.array([expected_m, 0.0]),
    )
    grids = _lines(2)
    problem = pair_problem(*grids, PLAIN, LEVEL)
    assert problem is not None
    problem = problem.coupled(drifts.coupling(Prior(np.zeros(2), 16.0 * np.eye(2)), *grids))
    field = refine(problem.reference, problem.query, problem.fields(), np.zeros(2), problem.noise)
    assert field is not None
    assert bool(np.hypot(*field.shift_m) < 0.15) is right


@pytest.mark.parametrize(("sigma_m", "least"), [(0.001, 0.5), (0.3, 1.25)])
def test_slopes_are_smoothed_as_much_as_noise_makes_it_worth(sigma_m: float, least: float) -> None:
    layer = prepare(Scene(1, rms_m=0.1).submap(150, 150, (61, 61), sigma_m=sigma_m))
    assert layer is not None
    chosen = smoothing_cells(spectrum(layer), sigma_m**2)
    assert chosen == least if least == 0.5 else chosen >= least


def test_flat_seabed_tells_no_shift_however_surely_it_is_fitted() -> None:
    flat = Scene(1).submap(150, 150, (41, 41), sigma_m=0.0, relief=_faintest)
    drifts = Drifts(gain=np.tile(-np.eye(2) / 20.0, (2, 1)), left=1e-12 * np.eye(4))
    problem = pair_problem(flat, flat, PLAIN, LEVEL)
    assert problem is not None
    problem = problem.coupled(drifts.coupling(Prior(np.zeros(2), np.eye(2)), flat, flat))
    field = align(problem.reference, problem.query, problem.fields(), np.zeros(2), problem.noise)
    assert field is not None
    sigmas_m = np.sqrt(np.linalg.eigvalsh(measure(field, problem.noise).covariance_m2))
    assert sigmas_m == pytest.approx(1000.0)


def test_slopes_that_a_depth_offset_explains_hide_no_others_that_contradict() -> None:
    scene = Scene(1, rms_m=0.1)
    gully, slope = 5.0 * np.cos(np.arange(60.0) / 9.0), 0.2 * np.arange(41.0)[:, None]
    ripple = 0.1 * np.sin(np.arange(41.0))[:, None]
    first, second = (scene.submap(140, 150, (41, 60), sigma_m=0.02) for _ in range(2))
    first, second = (
        dataclasses.replace(grid, depth_m=slope + gully + sign * ripple)
        for grid, sign in ((first, 1.0), (second, -1.0))
    )
    settings = dataclasses.replace(PLAIN, absolute_depth=False)
    problem = pair_problem(first, second, settings, LEVEL)
    assert problem is not None
    field = align(problem.reference, problem.query, problem.fields(), np.zeros(2), problem.noise)
    assert field is not None
    values_m2, axes = np.linalg.eigh(measure(field, problem.noise).covariance_m2)
    assert np.sqrt(values_m2) == pytest.approx([0.0, 1000.0], abs=0.1)
    assert abs(axes[:, 1] @ [1.0, 0.0]) > 0.99


def _faintest(north_m: Array, east_m: Array) -> Array:
    return 40.0 + 1e-9 * np.sin(north_m / 7.0) * np.cos(east_m / 5.0)
