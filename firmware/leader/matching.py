"""Matching of two sub-maps: Eq. (8) and (10), what they leave open, and how sure the answer is."""

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from firmware.geometry import Array
from firmware.leader import ambiguity
from firmware.leader.alignment import Aligned
from firmware.leader.ambiguity import Prior
from firmware.leader.covariance import Refined, measure
from firmware.leader.drifts import NO_DRIFT, Drifts, screened_by_drift
from firmware.leader.hinting import hint_of
from firmware.leader.matches import (
    ANY_PAIR,
    Match,
    MatchingSettings,
    MatchOutcome,
    NoMatch,
    PairSigmas,
)
from firmware.leader.pair_problem import PairProblem, pair_problem, relief_of
from firmware.leader.refinement import refine
from firmware.leader.screening import ErrorSurface
from firmware.submaps import GriddedSubmap
from protocol.errors import EstimationError

_FREE_M = 1e4  # of a one-axis closure across it: nothing, however often it is said
_PEAK_CELLS = 5  # along each side of a square in which no second basin is looked for
_NEGLIGIBLE = 1e-4  # mass beside the best lattice shift's that is not worth refining


@dataclass(frozen=True, slots=True, kw_only=True)
class _Candidate:
    """A refined minimum with its E, overlap and noise there, and the prior's log density."""

    field: Aligned
    residual_m2: float
    overlap_cells: int
    noise_m2: float
    log_prior: float


def match(
    reference: GriddedSubmap,
    query: GriddedSubmap,
    prior_shift_m: Array,
    prior_covariance_m2: Array,
    settings: MatchingSettings,
    sigmas: PairSigmas = ANY_PAIR,
    *,
    drifts: Drifts = NO_DRIFT,
    hinted: bool = True,
) -> MatchOutcome:
    """Return the shift between two overlapping sub-maps, or why it cannot be known.

    E of Eq. (8) (Eq. (10) when a side is reconstructed) is screened at every lattice shift of the
    window that the prior implies, the best minima are refined below the cell, and the winner has
    to pass the threshold, carry evidence against unrelated seabed and leave little posterior mass
    elsewhere. The fit holds every shift with the drifts that it implies. A pair that fails leaves a
    hint, if one is asked for; then the screening does so, too. The prior is that of the shift: mean
    (2,) and covariance (2, 2).

    Raises
    ------
    EstimationError
        When the grids differ in cell size or the prior is not a covariance.
    """
    problem = pair_problem(reference, query, settings, sigmas)
    if problem is None:
        return _none(NoMatch.EMPTY)
    prior = Prior(np.asarray(prior_shift_m), _checked(prior_covariance_m2))
    problem = problem.coupled(drifts.coupling(prior, reference, query))
    whole = problem.surface()
    surface = _window(whole, prior, problem)
    if surface is None or not np.isfinite(surface.residual_m2).any():
        return _none(NoMatch.NO_OVERLAP)
    relief = relief_of(problem, whole, _best(surface))
    if relief is None:
        return _none(NoMatch.FEATURELESS)
    outcome = _search(problem, surface, relief, prior)
    if outcome.match is not None or not hinted:
        return outcome
    surface = screened_by_drift(problem, surface, (reference, query), drifts, prior)
    return replace(outcome, hint=hint_of(problem, surface, relief, prior))


def _search(
    problem: PairProblem,
    surface: ErrorSurface,
    relief: ambiguity.Relief,
    prior: Prior,
) -> MatchOutcome:
    """Return the outcome of a screened pair: evidence, refinement, gates."""
    null_share = problem.settings.null_share
    found = ambiguity.posterior(surface, _evidence(surface, relief), prior, null_share)
    candidates = _refine_best(surface, found, prior, problem)
    if not candidates:
        return _none(NoMatch.UNSETTLED)
    fitting = min(candidates, key=lambda c: c.residual_m2 / c.noise_m2)
    independent = fitting.overlap_cells / problem.correlated_cells
    scale = ambiguity.tolerated_misfit(fitting.residual_m2 / fitting.noise_m2, independent)
    relief = replace(relief, noise_scale=scale, information_per_cell=problem.information(scale))
    evidence = _evidence(surface, relief)
    refined = [_evidence_at(candidate, relief) for candidate in candidates]
    for candidate, value in zip(candidates, refined, strict=True):
        row, col = _nearest(surface, candidate.field.shift_m)
        evidence[row, col] = max(evidence[row, col], value)
    scores = [value + c.log_prior for c, value in zip(candidates, refined, strict=True)]
    best = int(np.argmax(scores))
    found = ambiguity.posterior(surface, evidence, prior, null_share)
    least = float(surface.misfit.min())  # on the lattice, beside it
    tolerated = ambiguity.tolerated_misfit(least, independent)
    return _decide(candidates[best], refined[best], found, prior, problem, surface, tolerated)


def _evidence(surface: ErrorSurface, relief: ambiguity.Relief) -> Array:
    return ambiguity.log_evidence(
        surface.residual_m2, surface.noise_m2, surface.overlap_cells, relief
    )


def _evidence_at(candidate: _Candidate, relief: ambiguity.Relief) -> float:
    return float(
        ambiguity.log_evidence(
            np.array(candidate.residual_m2),
            np.array(candidate.noise_m2),
            np.array(candidate.overlap_cells),
            relief,
        )
    )


def _window(whole: ErrorSurface, prior: Prior, problem: PairProblem) -> ErrorSurface | None:
    """Return the part of the surface that the prior allows, None if it is empty."""
    settings = problem.settings
    half = settings.search_sigmas * np.sqrt(np.diag(prior.covariance_m2))
    half = np.minimum(half + 2.0 * problem.query.grid.cell_m, settings.search_cap_m)
    return whole.around(prior.mean_m, half)


def _best(surface: ErrorSurface) -> Array:
    """Return the lattice shift of least E."""
    row, col = np.unravel_index(int(np.argmin(surface.residual_m2)), surface.residual_m2.shape)
    return np.array([surface.north_m[row], surface.east_m[col]])


def _refine_best(
    surface: ErrorSurface,
    found: ambiguity.Posterior,
    prior: Prior,
    problem: PairProblem,
) -> list[_Candidate]:
    """Return the refined minima among the best lattice shifts."""
    fields, inverse = problem.fields(), np.linalg.inv(prior.covariance_m2)
    candidates = []
    for start_m in _starts(surface, found.mass, problem.settings.basins):
        field = refine(problem.reference, problem.query, fields, start_m, problem.noise)
        if field is None:
            continue
        error, count, _ = problem.error_at(field.shift_m, absolute=False)
        if not np.isfinite(error):
            continue
        away = field.shift_m - prior.mean_m
        candidates.append(
            _Candidate(
                field=field,
                residual_m2=error,
                overlap_cells=count,
                noise_m2=float(surface.noise_m2[_nearest(surface, field.shift_m)]),
                log_prior=-0.5 * float(away @ inverse @ away),
            )
        )
    return candidates


def _starts(surface: ErrorSurface, mass: Array, most: int) -> Array:
    """Return the lattice shifts (N, 2) where the posterior's mass (K, L) peaks, best first."""
    peaks = (mass == ndimage.maximum_filter(mass, _PEAK_CELLS)) & (mass > _NEGLIGIBLE * mass.max())
    found = np.flatnonzero(peaks)
    best = found[np.argsort(-mass.flat[found], kind="stable")[:most]]
    row, column = np.unravel_index(best, mass.shape)
    return np.column_stack([surface.north_m[row], surface.east_m[column]])


def _decide(
    winner: _Candidate,
    evidence: float,
    found: ambiguity.Posterior,
    prior: Prior,
    problem: PairProblem,
    surface: ErrorSurface,
    tolerated: float,
) -> MatchOutcome:
    """Return the winner as a closure in the plane or along one axis, or the gate it failed.

    tolerated is the largest misfit of the screened surface that still counts as a fit.

    Where the mass is certain though neither the slopes nor the prior can be, chance has chosen
    among the repetitions of a pattern: such a pair counts as ambiguous.
    """
    settings, refined = problem.settings, measure(winner.field, problem.noise)
    square_m2 = residual = winner.residual_m2
    limit = settings.residual_noise_ratio * refined.variance_m2
    if settings.residual == "absolute":
        residual, _, _ = problem.error_at(refined.shift_m, absolute=True)
        limit = np.sqrt(limit)
    if evidence < settings.evidence_limit:
        return _none(NoMatch.FEATURELESS)
    if residual > max(settings.residual_limit, limit):
        return _none(NoMatch.RESIDUAL)
    misfit = square_m2 / refined.variance_m2
    covariance = refined.covariance_m2 * settings.covariance_scale
    values, vectors = np.linalg.eigh(covariance)
    sigmas = np.sqrt(values)
    elsewhere = ambiguity.mass_elsewhere(found, surface, refined.shift_m, settings.basin_m)
    certain = elsewhere.false_mass <= settings.false_mass_limit
    walk = np.eye(2) * refined.walk_m2
    if certain and sigmas[1] <= settings.sigma_limit_m:
        return _closure(refined, residual, misfit, covariance + walk, None)
    free_m = np.sqrt(vectors[:, 1] @ prior.covariance_m2 @ vectors[:, 1])
    if certain and min(sigmas[1] / 2.0, free_m) <= settings.basin_m:
        axis = vectors[:, 0]
    elif not certain and elsewhere.false_mass_off_line <= settings.false_mass_limit:
        axis = np.array([np.cos(elsewhere.axis_rad), np.sin(elsewhere.axis_rad)])
    else:
        return _none(NoMatch.AMBIGUOUS)
    turned_rad = problem.sigmas.strain_m / winner.field.extent_m
    line = ambiguity.ridge_of(surface, tolerated, prior, refined.shift_m, axis, turned_rad)
    axis, across = line.axis, np.array([-line.axis[1], line.axis[0]])
    slid_m2 = ambiguity.PRIOR_DOUBTED**2 * prior.covariance_m2  # as far as the match may lie off
    told_m2 = covariance @ np.linalg.inv(covariance + slid_m2) @ slid_m2
    turned_m2 = line.sigma_rad**2 * float(across @ slid_m2 @ across)
    along = float(axis @ told_m2 @ axis) + line.strayed_m2 + turned_m2
    if along > settings.sigma_limit_m**2:
        return _none(NoMatch.LOOSE)
    wide = along * np.outer(axis, axis) + _FREE_M**2 * np.outer(across, across)
    axis_deg = float(np.degrees(np.arctan2(axis[1], axis[0])) % 180.0)
    return _closure(refined, residual, misfit, wide + walk, axis_deg)


def _closure(
    refined: Refined, residual: float, misfit: float, covariance_m2: Array, axis_deg: float | None
) -> MatchOutcome:
    found = Match(
        shift_m=refined.shift_m,
        covariance_m2=covariance_m2,
        residual=residual,
        misfit=misfit,
        overlap_cells=refined.overlap_cells,
        axis_deg=axis_deg,
        centre_m=refined.centre_m,
        reference_time_s=refined.reference_time_s,
        query_time_s=refined.query_time_s,
    )
    return MatchOutcome(match=found, reason=None)


def _nearest(surface: ErrorSurface, shift_m: Array) -> tuple[int, int]:
    return (
        int(np.argmin(np.abs(surface.north_m - shift_m[0]))),
        int(np.argmin(np.abs(surface.east_m - shift_m[1]))),
    )


def _none(reason: NoMatch) -> MatchOutcome:
    return MatchOutcome(match=None, reason=reason)


def _checked(covariance_m2: Array) -> Array:
    covariance = np.asarray(covariance_m2, dtype=np.float64)
    if not np.all(np.isfinite(covariance)) or np.linalg.eigvalsh(covariance)[0] <= 0.0:
        raise EstimationError(
            f"prior covariance {covariance.tolist()} m^2 is not positive definite"
        )
    return covariance
