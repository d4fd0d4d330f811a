"""The evidence of every shift, the posterior it makes of a prior, and what that leaves open."""

import dataclasses
import math

import numpy as np
import pytest

from firmware.geometry import Array
from firmware.leader.ambiguity import (
    Posterior,
    Prior,
    Relief,
    background,
    log_evidence,
    mass_elsewhere,
    misfit_of,
    moments,
    posterior,
    tempered_evidence,
    tolerated_misfit,
)
from firmware.leader.screening import ErrorSurface

NORTH_M, EAST_M = np.arange(-120.0, 121.0, 2.0), np.arange(-140.0, 141.0, 2.0)
SHAPE = NORTH_M.size, EAST_M.size
RELIEF = Relief(background=9.0, information_per_cell=0.02, coherent_cells=300.0, noise_scale=1.5)


def surface_of(residual_m2: Array, overlap_cells: float = 500.0) -> ErrorSurface:
    return ErrorSurface(
        north_m=NORTH_M,
        east_m=EAST_M,
        overlap_cells=np.full(SHAPE, overlap_cells),
        residual_m2=residual_m2,
        noise_m2=np.full(SHAPE, 0.04),
        depth_offset_m=np.zeros(SHAPE),
    )


@pytest.mark.parametrize("nats", [-4.0, 6.0])
def test_gaussian_evidence_makes_of_a_gaussian_prior_what_bayes_says(nats: float) -> None:
    """And with what is withheld from all shifts, where the prior stays what it was."""
    null_share, told_m = 0.05, np.array([30.0, 20.0])
    prior = Prior(np.array([4.0, -10.0]), np.array([[500.0, 150.0], [150.0, 700.0]]))
    told_m2 = np.array([[60.0, -20.0], [-20.0, 40.0]])
    away_m = np.stack(np.meshgrid(NORTH_M, EAST_M, indexing="ij"), axis=-1) - told_m
    evidence = nats - 0.5 * np.einsum("...i,ij,...j", away_m, np.linalg.inv(told_m2), away_m)
    found = posterior(surface_of(np.ones(SHAPE)), evidence, prior, null_share)
    spread_m2 = prior.covariance_m2 + 2.0**2 / 12.0 * np.eye(2)  # blurred by the lattice
    both_m2, missed_m = spread_m2 + told_m2, told_m - prior.mean_m
    likely = (1.0 - null_share) * np.sqrt(np.linalg.det(told_m2) / np.linalg.det(both_m2))
    likely *= np.exp(nats - 0.5 * missed_m @ np.linalg.solve(both_m2, missed_m))
    inside, outside = likely / (likely + null_share), null_share / (likely + null_share)
    assert found.outside == pytest.approx(outside, rel=1e-3)
    assert found.mass.sum() == pytest.approx(inside, rel=1e-3)
    gain = spread_m2 @ np.linalg.inv(both_m2)
    moved_m, left_m2 = gain @ missed_m, spread_m2 - gain @ spread_m2
    mean_m, covariance_m2 = moments(found, prior)
    assert mean_m == pytest.approx(prior.mean_m + inside * moved_m, abs=0.01)
    second_m2 = inside * (left_m2 + np.outer(moved_m, moved_m)) + outside * prior.covariance_m2
    expected_m2 = second_m2 - inside**2 * np.outer(moved_m, moved_m)
    assert covariance_m2 == pytest.approx(expected_m2, rel=1e-3)


def test_shifts_without_overlap_have_the_prior_s_mass_and_no_more() -> None:
    prior, evidence = Prior(np.zeros(2), 400.0 * np.eye(2)), np.zeros(SHAPE)
    evidence[NORTH_M > 0.0] = -np.inf
    found = posterior(surface_of(np.ones(SHAPE)), evidence, prior, 0.01)
    assert not found.mass[NORTH_M > 0.0].any()
    assert found.outside == pytest.approx(0.01 + 0.99 * 0.5, abs=0.02)


def test_mass_is_told_apart_by_the_winner_and_by_its_line() -> None:
    """Most of what is elsewhere lies 2 to the north and 1 to the east, again and again."""
    mass, winner_m = np.zeros(SHAPE), np.array([10.0, -20.0])
    for (north_m, east_m), share in {
        (0.0, 0.0): 0.5,
        (2.0, 2.0): 0.1,
        (40.0, 20.0): 0.2,
        (-80.0, -40.0): 0.1,
        (-10.0, 20.0): 0.04,
        (10.0, -20.0): 0.04,
    }.items():
        row = np.searchsorted(NORTH_M, winner_m[0] + north_m)
        mass[row, np.searchsorted(EAST_M, winner_m[1] + east_m)] = share
    found = Posterior(north_m=NORTH_M, east_m=EAST_M, mass=mass, outside=0.02)
    rough = surface_of(np.random.default_rng(1).uniform(0.1, 0.2, SHAPE))  # each has its minimum
    elsewhere = mass_elsewhere(found, rough, winner_m, 5.0)
    assert elsewhere.false_mass == pytest.approx(0.4)
    assert elsewhere.false_mass_off_line == pytest.approx(0.1)
    assert elsewhere.axis_rad == pytest.approx(np.arctan2(2.0, -1.0), abs=0.01)


@pytest.mark.parametrize(
    ("second_m", "at_m", "false_mass"),
    [(40.0, 18.0, 0.0), (40.0, 28.0, 0.3), (12.0, 8.0, 0.3), (12.0, 4.0, 0.0)],
)
@pytest.mark.parametrize("turned", [False, True])
def test_mass_on_the_slopes_down_to_the_winner_is_not_elsewhere(
    second_m: float, at_m: float, false_mass: float, *, turned: bool
) -> None:
    """Two minima: mass lies on the winner's side of what parts them, or beyond."""
    apart_m = np.minimum(np.abs(NORTH_M), np.abs(NORTH_M - second_m))
    residual_m2 = 0.04 + 0.001 * (apart_m[:, None] + np.abs(EAST_M))
    residual_m2[:, EAST_M > 20.0] = np.inf  # no overlap there
    mass = np.zeros(SHAPE)
    for north_m, share in ((0.0, 0.7), (at_m, 0.3)):
        mass[np.searchsorted(NORTH_M, north_m), np.searchsorted(EAST_M, 0.0)] += share
    surface = surface_of(residual_m2)
    found = Posterior(north_m=NORTH_M, east_m=EAST_M, mass=mass, outside=0.0)
    if turned:
        noise_m2 = np.full(SHAPE[::-1], 0.04)
        surface = dataclasses.replace(surface, residual_m2=residual_m2.T, noise_m2=noise_m2)
        found = Posterior(north_m=EAST_M, east_m=NORTH_M, mass=mass.T, outside=0.0)
    elsewhere = mass_elsewhere(found, surface, np.array([0.3, 0.4]), 5.0)
    assert elsewhere.false_mass == pytest.approx(false_mass)


def test_a_winner_on_the_slope_to_a_minimum_has_the_mass_of_that() -> None:
    """The lattice's minimum lies 8 m beside the winner: its fit knows neither tilt nor drift."""
    residual_m2 = 0.04 + 0.001 * (np.abs(NORTH_M[:, None] - 8.0) + np.abs(EAST_M))
    mass = np.zeros(SHAPE)
    mass[np.searchsorted(NORTH_M, 8.0), np.searchsorted(EAST_M, 0.0)] = 1.0
    found = Posterior(north_m=NORTH_M, east_m=EAST_M, mass=mass, outside=0.0)
    assert mass_elsewhere(found, surface_of(residual_m2), np.zeros(2), 5.0).false_mass == 0.0


@pytest.mark.parametrize("cells", [200.0, 500.0])
@pytest.mark.parametrize("misfit", [0.5, 1.0, 2.0, 4.0, 8.9, 9.0, 20.0])
def test_log_evidence_is_that_of_its_equation(cells: float, misfit: float) -> None:
    background = RELIEF.background / RELIEF.noise_scale  # in units of what the best leaves
    share = misfit / RELIEF.noise_scale

    def gain(x: float) -> float:
        if x >= background:
            return 0.0
        return math.log(background / max(1.0, x)) - x / max(1.0, x) + x / background

    told = min(cells, RELIEF.coherent_cells) - cells * (1.0 - min(gain(share) / gain(1.0), 1.0))
    noise_m2 = np.array([0.04, 0.04])
    found = log_evidence(
        np.array([misfit * 0.04, np.inf]), noise_m2, np.array([cells, cells]), RELIEF
    )
    assert found[0] == pytest.approx(max(told, 0.0) * RELIEF.information_per_cell, abs=1e-9)
    assert found[1] == -np.inf


def test_tempered_evidence_is_half_the_information_less_the_misfit() -> None:
    residual_m2 = np.full(SHAPE, np.inf)
    residual_m2[0, :4] = 0.04 * 1.5 * np.array([0.8, 1.0, 1.04, 5.0])
    surface = surface_of(residual_m2)
    nats = np.array([0.0, 0.0, 500.0 * 0.04 / 20.0, 500.0 * 4.0 / 20.0])
    assert misfit_of(surface, 1.5, 10.0)[0, :4] == pytest.approx(nats)
    assert np.all(misfit_of(surface, 1.5, 10.0)[1:] == np.inf)
    told = 0.5 * 0.02 * 300.0  # on no more cells than cohere
    found = tempered_evidence(surface, RELIEF, 10.0)
    assert found[0, :4] == pytest.approx(np.maximum(told - nats, 0.0))
    assert np.all(found[1:] == -np.inf)
    few = dataclasses.replace(surface, overlap_cells=np.full(SHAPE, 100.0))
    assert tempered_evidence(few, RELIEF, 10.0)[0, 0] == pytest.approx(0.5 * 0.02 * 100.0)


@pytest.mark.parametrize(
    ("misfit", "cells", "tolerated"),
    [
        (0.7, 1e4, 0.84),  # noise is known to a fifth
        (0.7, 18.0, 1.05),  # 1.5 sigmas of a mean square of 18
        (0.7, 0.5, 0.7 * (1.0 + 1.5 * np.sqrt(2.0))),
        (2.0, 1e4, 4.8),  # and whatever strains it beyond the noise strains others, too
        (0.1, 1e4, 0.5),
    ],
)
def test_shifts_are_as_good_as_the_best_within_what_chance_and_strain_do(
    misfit: float, cells: float, tolerated: float
) -> None:
    assert tolerated_misfit(misfit, cells) == pytest.approx(tolerated)


def test_background_is_the_median_of_what_lies_away_from_the_best() -> None:
    best_m, residual_m2 = np.array([20.0, -30.0]), np.full(SHAPE, np.inf)
    away_m = np.hypot(NORTH_M[:, None] - best_m[0], EAST_M[None, :] - best_m[1])
    residual_m2[away_m <= 15.0] = 0.001
    ring = (away_m > 15.0) & (away_m < 25.0)
    residual_m2[ring] = 0.04 * np.linspace(3.0, 7.0, np.count_nonzero(ring))
    assert background(surface_of(residual_m2), best_m, 15.0) == pytest.approx(5.0)
    few = np.where(away_m <= 15.0, residual_m2, np.inf)
    few[0, :19] = 0.2
    assert background(surface_of(few), best_m, 15.0) is None
    few[0, 19] = 0.2
    assert background(surface_of(few), best_m, 15.0) == pytest.approx(5.0)
