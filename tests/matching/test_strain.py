"""Drift that is not known yet strains sub-maps: pairs are told by how much, and so are hints."""

import numpy as np
import pytest
from scipy import ndimage

from firmware.geometry import Array
from firmware.leader.ambiguity import Prior, ridge_of
from firmware.leader.atlas import SheetId, sheet_of
from firmware.leader.drifts import AGE_S
from firmware.leader.matches import MatchingSettings, PairSigmas
from firmware.leader.matching import match
from firmware.leader.pair_problem import pair_problem
from firmware.leader.pairing import Side, side_of, strain_m
from firmware.leader.screening import ErrorSurface
from firmware.leader.trajectory import Trajectory
from firmware.submaps import GriddedSubmap, Track
from tests.matching.scenes import Scene

DRIFT_MPS = 0.1
STILL = MatchingSettings(walk_m2_per_s=0.0, drift_sigma_mps=0.0, position_sigma_m=0.1)
CROSS_M = np.arange(-60.0, 61.0, 2.0)


def _side(heading_rad: float) -> Side:
    times_s = np.arange(40.0)
    along_m = 2.0 * (times_s - 20.0)
    track = Track(
        time_s=times_s,
        north_m=along_m * np.cos(heading_rad),
        east_m=along_m * np.sin(heading_rad),
        yaw_rad=np.full(40, heading_rad),
    )
    shape = (40, 40)
    grid = GriddedSubmap(
        north0_m=-40.0,
        east0_m=-40.0,
        cell_m=2.0,
        depth_m=np.full(shape, 40.0),
        variance_m2=np.full(shape, 0.01),
        time_s=np.full(shape, 20.0),
    )
    sheet_id = SheetId(vehicle=0, boot_epoch=0, submap=0)
    sheet = sheet_of(sheet_id, track, grid)
    assert sheet is not None
    still = Trajectory(
        time_s=np.array([0.0, 40.0]),
        reckoned_m=np.zeros((2, 2)),
        position_m=np.zeros((2, 2)),
        bias_mps=np.zeros((2, 2)),
    )
    return side_of(sheet, still)


@pytest.mark.parametrize(
    ("heading_rad", "apart_s"), [(0.0, 0.0), (np.pi, 2.0 * AGE_S), (np.pi / 2, np.sqrt(2) * AGE_S)]
)
def test_one_unknown_drift_strains_lines_of_opposite_heading_most(
    heading_rad: float, apart_s: float
) -> None:
    same = DRIFT_MPS**2 * np.tile(np.eye(2), (2, 2))  # one vehicle's, the same on both lines
    apart_m = strain_m(_side(0.0), _side(heading_rad), same)
    assert apart_m == pytest.approx(DRIFT_MPS * apart_s, abs=1e-6)


@pytest.mark.parametrize(
    ("heading_rad", "starboard"),
    [(0.0, [0.0, 1.0]), (np.pi / 2, [-1.0, 0.0]), (-np.pi / 2, [1.0, 0.0])],
)
def test_starboard_is_to_the_right_of_the_heading(
    heading_rad: float, starboard: list[float]
) -> None:
    assert _side(heading_rad).starboard == pytest.approx(starboard)


def _hints(scenes: list[Scene], prior_m: float, strain_m: float = 0.0) -> int:
    """Return how many scenes leave a hint of the shift between two sub-maps."""
    sigmas, prior_m2 = PairSigmas(strain_m=strain_m), prior_m**2 * np.eye(2)
    hints = 0
    for scene in scenes:
        sides = [scene.submap(200, east_m, (31, 60)) for east_m in (100, 160)]
        found = match(sides[0], sides[1], np.zeros(2), prior_m2, STILL, sigmas)
        hints += found.hint is not None
    return hints


def test_waves_longer_than_the_prior_leaves_open_confirm_nothing() -> None:
    scenes = [Scene(seed) for seed in range(10)]
    for scene in scenes:
        swell = ndimage.gaussian_filter(scene.rng.standard_normal((400, 400)), 25.0)
        scene.depth_m = 0.1 * swell / swell.std()
    assert _hints(scenes, prior_m=60.0) > 0
    assert _hints(scenes, prior_m=8.0) == 0


def test_strain_blurs_a_slope_both_ways() -> None:
    scene = Scene(1)
    plane = scene.submap(
        0, 0, (41, 60), relief=lambda north_m, east_m: 40.0 + 0.1 * north_m + 0.05 * east_m
    )
    problem = pair_problem(
        plane,
        plane,
        STILL,
        PairSigmas(strain_m=3.0),
    )
    assert problem is not None
    surface = problem.surface()
    added_m2 = problem.strained(surface).noise_m2 - surface.noise_m2
    assert added_m2 == pytest.approx(3.0**2 * (0.1**2 + 0.05**2), rel=0.05)


def test_what_strain_may_have_done_is_no_evidence() -> None:
    scenes = [Scene(seed, rms_m=0.035) for seed in range(10)]
    assert _hints(scenes, prior_m=20.0) > 0
    assert _hints(scenes, prior_m=20.0, strain_m=30.0) == 0


def _ridge(off_m: Array) -> ErrorSurface:
    """Return a surface that fits best where shifts are not off (K, L) a line."""
    return ErrorSurface(
        north_m=CROSS_M,
        east_m=CROSS_M,
        overlap_cells=np.full(off_m.shape, 500.0),
        residual_m2=0.01 * (0.5 + off_m**2 / 4.0),
        noise_m2=np.full(off_m.shape, 0.01),
        depth_offset_m=np.zeros(off_m.shape),
    )


@pytest.mark.parametrize("turned_rad", [0.0, 0.5])
@pytest.mark.parametrize(("bend_per_m", "strays"), [(0.0, False), (0.01, True)])
def test_one_axis_closure_knows_how_its_contour_bends(
    bend_per_m: float, turned_rad: float, *, strays: bool
) -> None:
    axis = np.array([np.cos(turned_rad), np.sin(turned_rad)])
    across_m = axis[0] * CROSS_M[:, None] + axis[1] * CROSS_M[None, :]
    along_m = axis[0] * CROSS_M[None, :] - axis[1] * CROSS_M[:, None]
    off_m = across_m - bend_per_m * along_m**2
    surface = _ridge(off_m)
    prior = Prior(np.array([0.0, 10.0]), 225.0 * np.eye(2))
    found_m2 = ridge_of(surface, 1.0, prior, np.zeros(2), axis).strayed_m2
    assert (found_m2 > 4.0) is strays
    assert strays or found_m2 < 0.5


@pytest.mark.parametrize("prior", [(0.0, 10.0), (600.0, 20.0)])
def test_one_axis_closure_has_the_axis_of_the_whole_ridge_not_of_what_the_prior_leaves(
    prior: tuple[float, float],
) -> None:
    """A few degrees beside it, it would be metres off where the prior is wrong by three sigmas.

    Nor does it matter how far across the ridge the prior lies.
    """
    away_m, sigma_m = prior
    right, about = (np.array([np.cos(at), np.sin(at)]) for at in (1.07, 1.17))
    off_m = right[0] * CROSS_M[:, None] + right[1] * CROSS_M[None, :]
    surface = _ridge(off_m)
    believed = Prior(away_m * right, sigma_m**2 * np.eye(2))
    found = ridge_of(surface, 1.0, believed, np.zeros(2), about)
    assert np.degrees(np.arccos(found.axis @ right)) < 1.0
    assert np.degrees(found.sigma_rad) < 3.0
