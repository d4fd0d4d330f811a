import dataclasses

import numpy as np
import pytest
from scipy import ndimage

from firmware.geometry import Array
from firmware.leader.matches import ANY_PAIR, Match, MatchingSettings, NoMatch, PairSigmas
from firmware.leader.matching import match
from firmware.submaps import GriddedSubmap
from protocol.errors import EstimationError
from tests.matching.scenes import Scene

STILL = MatchingSettings(walk_m2_per_s=0.0, drift_sigma_mps=0.0, position_sigma_m=0.1)
LEVEL = PairSigmas(tilt=0.0, bend_per_m=0.0)


def matched(
    reference: GriddedSubmap,
    query: GriddedSubmap,
    prior_m: Array,
    sigma_m: float,
    settings: MatchingSettings = STILL,
    sigmas: PairSigmas = ANY_PAIR,
) -> Match:
    outcome = match(reference, query, prior_m, np.eye(2) * sigma_m**2, settings, sigmas)
    assert outcome.match is not None, outcome.reason
    return outcome.match


def refused(
    reference: GriddedSubmap,
    query: GriddedSubmap,
    sigma_m: float,
    settings: MatchingSettings = STILL,
    sigmas: PairSigmas = ANY_PAIR,
) -> NoMatch:
    outcome = match(reference, query, np.zeros(2), np.eye(2) * sigma_m**2, settings, sigmas)
    assert outcome.reason is not None
    return outcome.reason


def test_shift_is_found_below_the_cell(scene: Scene) -> None:
    reference = scene.submap(200, 200, (41, 70))
    query = scene.submap(180, 230, (70, 41), shift_m=(13.3, -21.7))
    found = matched(reference, query, np.zeros(2), 30.0)
    assert np.abs(found.shift_m - [13.3, -21.7]).max() < 0.4
    assert found.axis_deg is None
    assert found.residual < 0.02


def test_misfit_is_the_same_by_either_reading_of_the_residual(scene: Scene) -> None:
    reference = scene.submap(200, 200, (41, 70))
    query = scene.submap(180, 230, (70, 41), shift_m=(13.3, -21.7))
    by_distance = dataclasses.replace(STILL, residual="absolute", residual_limit=0.2)
    squared, absolute = (
        matched(reference, query, np.zeros(2), 30.0, settings) for settings in (STILL, by_distance)
    )
    assert absolute.residual > 2.0 * squared.residual
    assert absolute.misfit == squared.misfit
    assert 0.3 < squared.misfit < 2.0


def test_strip_of_39_m_is_enough(scene: Scene) -> None:
    reference = scene.submap(200, 100, (41, 70))
    query = scene.submap(210, 200, (41, 70), shift_m=(5.0, 8.0))
    found = matched(reference, query, np.array([4.0, 4.0]), 15.0)
    assert np.abs(found.shift_m - [5.0, 8.0]).max() < 1.0
    assert 500 < found.overlap_cells < 900


def test_depth_offset_is_a_nuisance_unless_switched_off(scene: Scene) -> None:
    reference = scene.submap(200, 200, (41, 70))
    query = scene.submap(200, 220, (41, 70), offset_m=0.4)
    found = matched(reference, query, np.zeros(2), 10.0)
    assert np.abs(found.shift_m).max() < 0.4
    absolute = dataclasses.replace(STILL, absolute_depth=True)
    assert refused(reference, query, 10.0, absolute, LEVEL) is not None


def test_errors_are_those_that_the_covariance_announces() -> None:
    plain = dataclasses.replace(STILL, absolute_depth=True, cell_sigma_m=0.001)
    nees = []
    for seed in range(40):
        scene = Scene(seed, rms_m=0.3)
        reference = scene.submap(200, 100, (41, 70))
        truth = scene.rng.uniform(-6.0, 6.0, 2)
        query = scene.submap(210, 200, (41, 70), shift_m=(truth[0], truth[1]))
        found = matched(reference, query, np.zeros(2), 6.0, plain, LEVEL)
        error = found.shift_m - truth
        nees.append(float(error @ np.linalg.solve(found.covariance_m2, error)))
    assert 1.2 < np.mean(nees) < 3.0


def level(north: Array, east: Array) -> Array:
    return 40.0 + 0.0 * (north + east)


def test_flat_seabed_gives_no_closure(scene: Scene) -> None:
    flat = scene.submap(200, 200, (41, 70), relief=level)
    other = scene.submap(200, 230, (41, 70), relief=level)
    for sigma_m in (2.0, 20.0, 60.0):
        assert refused(flat, other, sigma_m) is NoMatch.FEATURELESS


def test_ridge_gives_a_closure_across_it_only(scene: Scene) -> None:
    def ridge(north: Array, east: Array) -> Array:
        profile = np.interp(east, np.arange(400.0), 2.0 * scene.depth_m[0])
        return np.asarray(40.0 + profile + 0.0 * north)

    reference = scene.submap(200, 200, (41, 70), relief=ridge)
    query = scene.submap(190, 210, (70, 41), relief=ridge, shift_m=(0.0, 6.0))
    found = matched(reference, query, np.zeros(2), 10.0)
    assert found.axis_deg == pytest.approx(90.0, abs=5.0)
    assert found.shift_m[1] == pytest.approx(6.0, abs=0.5)
    assert found.covariance_m2[0, 0] > 50.0**2
    assert found.covariance_m2[1, 1] < 1.0


def test_line_that_is_not_quite_the_unknown_direction_makes_no_closure_loose() -> None:
    def gullies(north: Array, east: Array) -> Array:
        return 40.0 + 0.03 * north + 2.5 * np.cos(2.0 * np.pi * east / 120.0)

    for seed in range(5):
        scene = Scene(seed)
        reference = scene.submap(200, 100, (41, 70), relief=gullies, sigma_m=0.1)
        query = scene.submap(190, 120, (70, 41), relief=gullies, sigma_m=0.1)
        found = matched(reference, query, np.array([3.0, 0.0]), 4.0)
        assert found.axis_deg == pytest.approx(90.0, abs=2.0)
        assert found.shift_m[1] == pytest.approx(0.0, abs=1.0)
        assert np.linalg.eigvalsh(found.covariance_m2)[0] < 1.0


def test_ripples_are_ambiguous_when_the_prior_spans_several(scene: Scene) -> None:
    def ripples(north: Array, east: Array) -> Array:
        return 40.0 + 0.3 * np.sin(2.0 * np.pi * north / 14.0) * np.sin(2.0 * np.pi * east / 14.0)

    reference = scene.submap(200, 200, (41, 70), relief=ripples)
    query = scene.submap(200, 220, (41, 70), relief=ripples)
    assert refused(reference, query, 30.0) is NoMatch.AMBIGUOUS
    assert np.abs(matched(reference, query, np.zeros(2), 2.0).shift_m).max() < 0.5


def rebuilt(grid: GriddedSubmap, scene: Scene, sigma_m: float) -> GriddedSubmap:
    """Return a grid as few points rebuild it: with an error whose neighbours err alike."""
    error = ndimage.gaussian_filter(scene.rng.standard_normal(grid.depth_m.shape), 2.0)
    error *= sigma_m / error.std()
    variance_m2 = np.full(grid.depth_m.shape, 1.5 * sigma_m**2)
    return dataclasses.replace(
        grid, depth_m=grid.depth_m + error, variance_m2=variance_m2, reconstructed=True
    )


def misses_among_ripples(sigma_m: float, prior_m: Array, prior_sigma_m: float) -> list[float]:
    """Return how far off those of twelve pairs of rebuilt ripples are that are matched."""
    misses_m = []
    for seed in range(12):
        scene = Scene(seed, rms_m=0.06)

        def ripples(north: Array, east: Array, scene: Scene = scene) -> Array:
            crests = 0.15 * np.sin(2.0 * np.pi * (north + 0.3 * east) / 14.0)
            return np.asarray(scene.at(north, east) + crests)

        reference, query = (
            rebuilt(scene.submap(corner_m, corner_m, (31, 35), relief=ripples), scene, sigma_m)
            for corner_m in (200.0, 215.0)
        )
        found = match(
            reference,
            query,
            prior_m[seed],
            np.eye(2) * prior_sigma_m**2,
            MatchingSettings(),
        ).match
        if found is not None:
            axis = np.radians(found.axis_deg or 0.0)
            misses_m.append(float(abs(found.shift_m @ [np.cos(axis), np.sin(axis)])))
    return misses_m


@pytest.mark.parametrize("sigma_m", [0.06, 0.09])
def test_ripple_with_more_overlap_is_not_the_right_one_for_that(sigma_m: float) -> None:
    told = misses_among_ripples(sigma_m, np.zeros((12, 2)), 3.0)
    assert len(told) >= 4
    assert max(told) < 1.0
    prior_m = np.random.default_rng(3).normal(0.0, 10.0, (12, 2))
    assert all(miss_m < 5.0 for miss_m in misses_among_ripples(sigma_m, prior_m, 15.0))


def test_unrelated_seabed_gives_no_closure(scene: Scene) -> None:
    reference = scene.submap(20, 20, (41, 70))
    query = scene.submap(250, 200, (41, 70), shift_m=(230.0, 180.0))
    assert refused(reference, query, 30.0) in {
        NoMatch.AMBIGUOUS,
        NoMatch.FEATURELESS,
        NoMatch.RESIDUAL,
        NoMatch.UNSETTLED,
    }


def test_grids_that_cannot_meet_are_refused_by_name(scene: Scene) -> None:
    reference = scene.submap(20, 20, (20, 20))
    query = scene.submap(300, 300, (20, 20))
    assert refused(reference, query, 5.0) is NoMatch.NO_OVERLAP
    empty = dataclasses.replace(query, depth_m=np.full((20, 20), np.nan))
    assert refused(reference, empty, 5.0) is NoMatch.EMPTY


def test_unlike_cells_and_bad_priors_are_errors(scene: Scene) -> None:
    grid = scene.submap(20, 20, (20, 20))
    coarse = dataclasses.replace(grid, cell_m=4.0)
    with pytest.raises(EstimationError, match=r"4\.0 m cells"):
        match(grid, coarse, np.zeros(2), np.eye(2), STILL)
    with pytest.raises(EstimationError, match="not positive definite"):
        match(grid, grid, np.zeros(2), np.diag([1.0, -1.0]), STILL)


def test_walk_while_the_overlap_was_measured_widens_the_covariance(scene: Scene) -> None:
    walking = dataclasses.replace(STILL, walk_m2_per_s=0.04)
    reference = scene.submap(200, 200, (41, 70))
    query = scene.submap(200, 210, (41, 70))
    still, walked = (matched(reference, query, np.zeros(2), 5.0, s) for s in (STILL, walking))
    assert walked.reference_time_s == pytest.approx(20.0, abs=2.0)
    added_m2 = walked.covariance_m2 - still.covariance_m2
    assert added_m2 == pytest.approx(0.04 * 2 * 40.0 / 12.0 * np.eye(2), abs=0.02)
