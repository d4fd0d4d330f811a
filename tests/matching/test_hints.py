import numpy as np

from firmware.geometry import Array
from firmware.leader.matches import Hint, MatchingSettings
from firmware.leader.matching import match
from tests.matching.scenes import Relief, Scene

STILL = MatchingSettings(walk_m2_per_s=0.0, drift_sigma_mps=0.0, position_sigma_m=0.1)
PRIOR_M2 = 400.0 * np.eye(2)


def hint_of(scene: Scene, truth_m: Array) -> Hint | None:
    reference = scene.submap(200, 100, (31, 60))
    query = scene.submap(210, 160, (31, 60), shift_m=(truth_m[0], truth_m[1]))
    return match(reference, query, np.zeros(2), PRIOR_M2, STILL).hint


def posterior(hint: Hint, prior_m2: Array = PRIOR_M2) -> tuple[Array, Array]:
    """Return mean and covariance of the shift once the hint has met a prior about zero."""
    information = np.linalg.inv(hint.covariance_m2)
    covariance_m2 = np.linalg.inv(np.linalg.inv(prior_m2) + information)
    return covariance_m2 @ information @ hint.shift_m, covariance_m2


def test_faint_relief_leaves_hints_as_sure_as_they_say() -> None:
    squares, gains = [], []
    for seed in range(70):
        scene = Scene(seed, rms_m=0.035)
        truth_m = scene.rng.normal(0.0, 20.0, 2)
        hint = hint_of(scene, truth_m)
        if hint is None:
            continue
        mean_m, covariance_m2 = posterior(hint)
        away_m = truth_m - mean_m
        squares.append(float(away_m @ np.linalg.solve(covariance_m2, away_m)))
        gains.append(0.5 * np.log(np.linalg.det(PRIOR_M2) / np.linalg.det(covariance_m2)))
    assert len(squares) >= 6
    assert np.mean(squares) < 2.6  # two degrees of freedom; tempered evidence stays below
    assert np.mean(gains) > 0.7  # nats: half of the prior's area each, or less


def test_seabed_without_relief_leaves_no_hint() -> None:
    for seed in range(10):
        assert hint_of(Scene(seed, rms_m=1e-4), np.zeros(2)) is None


def test_closure_leaves_no_hint_beside_it(scene: Scene) -> None:
    reference = scene.submap(200, 200, (41, 70))
    query = scene.submap(180, 230, (70, 41))
    outcome = match(reference, query, np.zeros(2), PRIOR_M2, STILL)
    assert outcome.match is not None
    assert outcome.hint is None


def test_a_straight_ridge_tells_no_hint_how_far_along_it_sub_maps_lie() -> None:
    """They fit as far as they overlap, and the ridge goes on: that they overlap is a guess."""
    normal = np.array([np.cos(1.07), np.sin(1.07)])
    along = np.array([-normal[1], normal[0]])

    def ridge_m(north_m: Array, east_m: Array) -> Array:
        off_m = normal[0] * (north_m - 240.0) + normal[1] * (east_m - 190.0)
        return np.asarray(60.0 - 25.0 * np.exp(-0.5 * (off_m / 60.0) ** 2))

    prior_m2, hints = 60.0**2 * np.eye(2), 0
    for seed in range(6):
        scene = Scene(seed)
        truth_m = scene.rng.normal(0.0, 60.0, 2)
        reference = scene.submap(200, 130, (41, 60), relief=ridge_m)
        query = scene.submap(210, 150, (41, 60), shift_m=(truth_m[0], truth_m[1]), relief=ridge_m)
        outcome = match(reference, query, np.zeros(2), prior_m2, STILL)
        if outcome.match is not None:
            assert along @ outcome.match.covariance_m2 @ along > 1000.0**2
        hint = outcome.hint
        if hint is None:
            continue
        hints += 1
        _, left_m2 = posterior(hint, prior_m2)
        assert along @ left_m2 @ along > 0.9 * 60.0**2
        assert normal @ left_m2 @ normal < 0.5 * 60.0**2
    assert hints >= 2


def test_on_a_slope_the_depth_tells_waves_apart_that_look_alike() -> None:
    """The next wave lies two metres deeper."""

    def waves_m(north_m: Array, east_m: Array) -> Array:
        return np.asarray(
            60.0 + north_m / 30.0 + 0.4 * np.sin(np.pi * north_m / 30.0) + 0.0 * east_m
        )

    away_m, left_m2 = hinted_to_the_north(waves_m, 40.0, sigma_m=0.05, seeds=12)
    assert np.count_nonzero(left_m2 < 15.0**2) >= 4
    assert np.mean(away_m**2 / left_m2) < 3.0


def test_on_a_smooth_slope_depth_ends_what_faint_relief_does_not() -> None:
    """Long waves tell across the slope; along it there is nothing but depth."""

    def slope_m(north_m: Array, east_m: Array) -> Array:
        return np.asarray(60.0 + 0.02 * north_m + 0.3 * np.sin(np.pi * east_m / 100.0))

    away_m, left_m2 = hinted_to_the_north(slope_m, 60.0, sigma_m=0.02, seeds=10)
    assert np.count_nonzero(left_m2 < 38.0**2) >= 6
    assert np.mean(away_m**2 / left_m2) < 1.0
    assert np.mean(away_m**2) < 20.0**2  # knowing nothing it would be 26 m


def hinted_to_the_north(
    relief: Relief, prior_sigma_m: float, *, sigma_m: float, seeds: int
) -> tuple[Array, Array]:
    """Return errors (N,) and variances (N,) to the north of what hints make of a prior.

    Tide and sensor wander by 0.3 m.
    """
    prior_m2, away_m, north_m2 = prior_sigma_m**2 * np.eye(2), [], []
    for seed in range(seeds):
        scene = Scene(seed)
        truth_m = scene.rng.uniform(-45.0, 45.0, 2)  # where the sub-maps overlap by half
        reference = scene.submap(200, 130, (60, 41), relief=relief, sigma_m=sigma_m)
        query = scene.submap(
            210,
            150,
            (60, 41),
            shift_m=(truth_m[0], truth_m[1]),
            relief=relief,
            sigma_m=sigma_m,
            offset_m=float(scene.rng.normal(0.0, 0.3)),
        )
        hint = match(reference, query, np.zeros(2), prior_m2, STILL).hint
        if hint is None:
            continue
        mean_m, left_m2 = posterior(hint, prior_m2)
        away_m.append(truth_m[0] - mean_m[0])
        north_m2.append(left_m2[0, 0])
    return np.array(away_m), np.array(north_m2)
