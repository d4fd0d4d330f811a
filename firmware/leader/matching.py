"""Matching of two sub-maps: Eq. (8) and (10), what they leave open, and how sure the answer is."""

import enum
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from firmware.geometry import Array
from firmware.leader import ambiguity
from firmware.leader.refinement import NoiseModel, Refined, refine, slopes
from firmware.leader.screening import ErrorSurface, Layer, error_at, error_surface, prepare
from firmware.submaps import GriddedSubmap
from protocol.errors import EstimationError
from protocol.settings import Settings, setting


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchingSettings(Settings):
    """How sub-maps are matched and when a match becomes a closure."""

    residual: str = setting(
        "squared",
        "",
        "the 0.02 of the paper lies above the noise only on the squared reading",
        choices=("squared", "absolute"),
    )
    residual_limit: float = setting(0.02, "m^2 or m", "the paper's threshold on E", minimum=0.0)
    residual_noise_ratio: float = setting(
        2.5, "", "E may be this many times the predicted noise where that is larger", minimum=0.0
    )
    minimum_overlap_m2: float = setting(
        480.0, "m^2", "the paper's N_T = 120 points of 2 m cells", minimum=0.0
    )
    search_sigmas: float = setting(3.0, "", "99 % of the prior's mass", minimum=1.0)
    search_cap_m: float = setting(200.0, "m", "beyond it sub-maps do not meet", minimum=1.0)
    candidates: int = setting(200, "", "lattice shifts looked at more closely", minimum=1)
    basins: int = setting(4, "", "separate minima refined below the cell", minimum=1)
    depth_offset_sigma_m: float = setting(
        0.3, "m", "tide and datum between passes; 0 is the paper's absolute depth", minimum=0.0
    )
    tilt_sigma: float = setting(
        0.004, "m/m", "roll bias of 0.2 degree seen from both sides", minimum=0.0
    )
    bend_sigma_per_m: float = setting(
        4e-5, "1/m", "a smile of 0.15 m at the edge of a 60 m swath", minimum=0.0
    )
    drift_sigma_mps: float = setting(
        0.03, "m/s", "drift within a sub-map that is left after its removal", minimum=0.0
    )
    walk_m2_per_s: float = setting(
        0.04, "m^2/s", "Eq. 12: variance 0.04 a second and axis", minimum=0.0
    )
    cell_sigma_m: float = setting(
        0.02, "m", "gridding and sub-cell relief beside the sounding noise", minimum=0.001
    )
    position_sigma_m: float = setting(
        0.5, "m", "heading noise and wandering inside a sub-map, felt on slopes", minimum=0.0
    )
    correlation_m: float = setting(
        8.0, "m", "spacing of 150 pseudo points on a sub-map", minimum=0.1
    )
    correlated_share: float = setting(
        0.5, "", "of a reconstruction's variance that neighbours share", minimum=0.0, maximum=1.0
    )
    basin_m: float = setting(5.0, "m", "further off a closure is called invalid", minimum=0.1)
    false_mass_limit: float = setting(
        0.05, "", "posterior mass that may lie outside the winner's basin", minimum=0.0, maximum=1.0
    )
    null_share: float = setting(
        0.01, "", "chance that the graph's prior is wrong altogether", minimum=0.0, maximum=1.0
    )
    evidence_limit: float = setting(
        3.0, "", "log evidence of the relief alone, whatever the prior says", minimum=0.0
    )
    sigma_limit_m: float = setting(
        2.5, "m", "a weaker shift could not be told from an invalid one", minimum=0.0
    )
    covariance_scale: float = setting(
        1.0, "", "from simulated pairs, so that NEES is 2", minimum=0.1
    )
    slope_smoothing_cells: float = setting(
        1.0, "cells", "keeps sounding noise out of the slopes", minimum=0.1
    )


class NoMatch(enum.Enum):
    """Why two sub-maps gave no closure."""

    EMPTY = "a grid has no known cell"
    NO_OVERLAP = "no shift of the search window has enough overlap"
    FEATURELESS = "too little relief to tell a match from chance"
    RESIDUAL = "the least residual error is above the threshold"
    AMBIGUOUS = "another shift explains the data nearly as well"
    LOOSE = "the minimum is too wide in both directions"
    UNSETTLED = "no minimum could be refined below the cell"


@dataclass(frozen=True, slots=True, kw_only=True)
class Match:
    """A shift to add to the query's NED coordinates so that it lies on the reference.

    The shift holds between the reference's instant and the query's; by default these are the
    mean times at which the overlap was measured. covariance_m2 (2, 2) is the measurement's own,
    without the prior. axis_deg is None, or the direction from north in which a one-axis closure
    holds; across it the covariance is wide. false_mass is the posterior probability that the true
    shift lies outside the winner's basin (outside its line, for one axis).
    """

    shift_m: Array
    covariance_m2: Array
    residual: float
    overlap_cells: int
    depth_offset_m: float
    axis_deg: float | None
    false_mass: float
    log_evidence: float
    misfit: float
    variance_m2: float
    reference_time_s: float
    query_time_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchOutcome:
    """A match, or the reason why there is none."""

    match: Match | None
    reason: NoMatch | None


@dataclass(frozen=True, slots=True, kw_only=True)
class _Candidate:
    """A refined minimum with its E, log evidence and log posterior."""

    refined: Refined
    residual_m2: float
    evidence: float
    score: float


def match(
    reference: GriddedSubmap,
    query: GriddedSubmap,
    prior_shift_m: Array,
    prior_covariance_m2: Array,
    settings: MatchingSettings,
    *,
    reference_reconstructed: bool = False,
    query_reconstructed: bool = False,
    times_s: tuple[float | None, float | None] = (None, None),
) -> MatchOutcome:
    """Return the shift between two overlapping sub-maps, or why it cannot be known.

    E of Eq. (8) (Eq. (10) when a side is reconstructed) is screened at every lattice shift of the
    window that the prior implies, the best minima are refined below the cell, and the winner has
    to pass the threshold, carry evidence against unrelated seabed and leave little posterior mass
    elsewhere. times_s are the instants of reference and query to which the shift shall refer.

    Raises
    ------
    EstimationError
        When the grids differ in cell size or the prior is not a covariance.
    """
    _check(reference, query, prior_covariance_m2)
    layer_r = prepare(reference, reconstructed=reference_reconstructed)
    layer_q = prepare(query, reconstructed=query_reconstructed)
    if layer_r is None or layer_q is None:
        return _none(NoMatch.EMPTY)
    noise = _noise_model(settings, reconstructed=reference_reconstructed or query_reconstructed)
    slope2 = 0.5 * (_mean_slope2(layer_r) + _mean_slope2(layer_q))
    noise_m2 = _mean_variance(layer_r) + _mean_variance(layer_q) + settings.cell_sigma_m**2
    noise_m2 += settings.position_sigma_m**2 * slope2
    offset_m2 = settings.depth_offset_sigma_m**2
    problem = _Problem(
        reference=layer_r,
        query=layer_q,
        prior_m=np.asarray(prior_shift_m, dtype=np.float64),
        covariance_m2=np.asarray(prior_covariance_m2, dtype=np.float64),
        settings=settings,
        noise=noise,
        minimum_cells=settings.minimum_overlap_m2 / query.cell_m**2,
        ridge_cells=noise_m2 / offset_m2 if offset_m2 > 0.0 else np.inf,
        noise_m2=noise_m2,
        slope2=slope2,
    )
    return _search(problem, times_s)


def count_reasons(outcomes: Iterable[MatchOutcome]) -> dict[NoMatch, int]:
    """Return how often each reason occurred."""
    counts = dict.fromkeys(NoMatch, 0)
    for outcome in outcomes:
        if outcome.reason is not None:
            counts[outcome.reason] += 1
    return counts


@dataclass(frozen=True, slots=True, kw_only=True)
class _Problem:
    """What stays the same while one pair is matched."""

    reference: Layer
    query: Layer
    prior_m: Array
    covariance_m2: Array
    settings: MatchingSettings
    noise: NoiseModel
    minimum_cells: float
    ridge_cells: float
    noise_m2: float
    slope2: float


def _search(problem: _Problem, times_s: tuple[float | None, float | None]) -> MatchOutcome:
    """Return the outcome: screen, evidence, refinement, gates."""
    whole = error_surface(
        problem.reference, problem.query, problem.minimum_cells, problem.ridge_cells
    )
    surface = _window(whole, problem)
    if surface is None or not np.isfinite(surface.residual_m2).any():
        return _none(NoMatch.NO_OVERLAP)
    relief = _relief(whole, surface, problem)
    if relief is None:
        return _none(NoMatch.FEATURELESS)
    evidence = ambiguity.log_evidence(surface.residual_m2, surface.overlap_cells, relief)
    found = _posterior(surface, evidence, problem)
    candidates = _refine_best(surface, found, relief, problem, times_s)
    if not candidates:
        return _none(NoMatch.UNSETTLED)
    for candidate in candidates:
        row, col = _nearest(surface, candidate.refined.shift_m)
        evidence[row, col] = max(evidence[row, col], candidate.evidence)
    winner = max(candidates, key=lambda candidate: candidate.score)
    found = _posterior(surface, evidence, problem)
    return _decide(winner, found, problem)


def _window(whole: ErrorSurface, problem: _Problem) -> ErrorSurface | None:
    """Return the part of the surface that the prior allows, None if it is empty."""
    settings = problem.settings
    half = settings.search_sigmas * np.sqrt(np.diag(problem.covariance_m2))
    half = np.minimum(half + 2.0 * problem.query.grid.cell_m, settings.search_cap_m)
    north = np.flatnonzero(np.abs(whole.north_m - problem.prior_m[0]) <= half[0])
    east = np.flatnonzero(np.abs(whole.east_m - problem.prior_m[1]) <= half[1])
    if north.size < 2 or east.size < 2:
        return None
    box = (slice(north[0], north[-1] + 1), slice(east[0], east[-1] + 1))
    return ErrorSurface(
        north_m=whole.north_m[box[0]],
        east_m=whole.east_m[box[1]],
        overlap_cells=whole.overlap_cells[box],
        residual_m2=whole.residual_m2[box],
        depth_offset_m=whole.depth_offset_m[box],
    )


def _relief(
    whole: ErrorSurface, surface: ErrorSurface, problem: _Problem
) -> ambiguity.Relief | None:
    """Return background, noise and the number of independent pieces of relief per cell."""
    row, col = np.unravel_index(int(np.argmin(surface.residual_m2)), surface.residual_m2.shape)
    best_m = np.array([surface.north_m[row], surface.east_m[col]])
    away_m = 3.0 * problem.settings.basin_m
    background_m2 = ambiguity.background(whole, best_m, away_m)
    if background_m2 is None:
        return None
    cell_m = problem.query.grid.cell_m
    relief_m2 = max(background_m2 - problem.noise_m2, 0.0) / 2.0
    length2_m2 = max(relief_m2 / max(problem.slope2, 1e-12), cell_m**2)
    return ambiguity.Relief(
        background_m2=background_m2,
        noise_m2=problem.noise_m2,
        pieces_per_cell=min(cell_m**2 / (np.pi * length2_m2), 0.25),
    )


def _posterior(surface: ErrorSurface, evidence: Array, problem: _Problem) -> ambiguity.Posterior:
    return ambiguity.posterior(
        surface, evidence, problem.prior_m, problem.covariance_m2, problem.settings.null_share
    )


def _refine_best(
    surface: ErrorSurface,
    found: ambiguity.Posterior,
    relief: ambiguity.Relief,
    problem: _Problem,
    times_s: tuple[float | None, float | None],
) -> list[_Candidate]:
    """Return the refined minima among the best lattice shifts."""
    settings = problem.settings
    slopes_rq = (
        slopes(problem.reference, settings.slope_smoothing_cells),
        slopes(problem.query, settings.slope_smoothing_cells),
    )
    inverse = np.linalg.inv(problem.covariance_m2)
    candidates = []
    for start_m in _starts(surface, found, settings, problem.query.grid.cell_m):
        refined = refine(
            problem.reference, problem.query, slopes_rq, start_m, times_s, problem.noise
        )
        if refined is None:
            continue
        error, count, _ = _error(problem, refined.shift_m, absolute=False)
        evidence = float(ambiguity.log_evidence(np.array(error), np.array(count), relief))
        away = refined.shift_m - problem.prior_m
        score = evidence - 0.5 * float(away @ inverse @ away)
        candidates.append(
            _Candidate(refined=refined, residual_m2=error, evidence=evidence, score=score)
        )
    return candidates


def _starts(
    surface: ErrorSurface, found: ambiguity.Posterior, settings: MatchingSettings, cell_m: float
) -> list[Array]:
    """Return the best of the best lattice shifts, no two of them neighbours."""
    flat = found.mass.ravel()
    count = min(settings.candidates, flat.size)
    order = np.argpartition(flat, -count)[-count:]
    order = order[np.argsort(flat[order])[::-1]]
    starts: list[Array] = []
    for index in order:
        if flat[index] <= 0.0:
            break
        row, col = divmod(int(index), found.mass.shape[1])
        shift = np.array([surface.north_m[row], surface.east_m[col]])
        if all(np.hypot(*(shift - other)) > 2.9 * cell_m for other in starts):
            starts.append(shift)
        if len(starts) == settings.basins:
            break
    return starts


def _decide(winner: _Candidate, found: ambiguity.Posterior, problem: _Problem) -> MatchOutcome:
    """Return the winner as a closure in the plane or along one axis, or the gate it failed."""
    settings, refined = problem.settings, winner.refined
    residual, _, _ = _error(problem, refined.shift_m, absolute=settings.residual == "absolute")
    limit = settings.residual_noise_ratio * refined.variance_m2
    if settings.residual == "absolute":
        limit = np.sqrt(limit)
    if winner.evidence < settings.evidence_limit:
        return _none(NoMatch.FEATURELESS)
    if residual > max(settings.residual_limit, limit):
        return _none(NoMatch.RESIDUAL)
    covariance = refined.covariance_m2 * settings.covariance_scale
    values, vectors = np.linalg.eigh(covariance)
    sigmas = np.sqrt(values)
    verdict = ambiguity.judge(found, refined.shift_m, settings.basin_m)
    if verdict.false_mass <= settings.false_mass_limit and sigmas[1] <= settings.sigma_limit_m:
        return _closure(winner, residual, covariance, None, verdict.false_mass)
    if verdict.false_mass <= settings.false_mass_limit:
        axis, false_mass = vectors[:, 0], verdict.false_mass
    elif verdict.false_mass_off_line <= settings.false_mass_limit:
        axis = np.array([np.cos(verdict.axis_rad), np.sin(verdict.axis_rad)])
        false_mass = verdict.false_mass_off_line
    else:
        return _none(NoMatch.AMBIGUOUS)
    along = float(axis @ covariance @ axis)
    if along > settings.sigma_limit_m**2:
        return _none(NoMatch.LOOSE)
    across = np.array([-axis[1], axis[0]])
    wide = along * np.outer(axis, axis) + settings.search_cap_m**2 * np.outer(across, across)
    axis_deg = float(np.degrees(np.arctan2(axis[1], axis[0])) % 180.0)
    return _closure(winner, residual, wide, axis_deg, false_mass)


def _closure(
    winner: _Candidate,
    residual: float,
    covariance_m2: Array,
    axis_deg: float | None,
    false_mass: float,
) -> MatchOutcome:
    refined = winner.refined
    found = Match(
        shift_m=refined.shift_m,
        covariance_m2=covariance_m2,
        residual=residual,
        overlap_cells=refined.overlap_cells,
        depth_offset_m=refined.depth_offset_m,
        axis_deg=axis_deg,
        false_mass=false_mass,
        log_evidence=winner.evidence,
        misfit=refined.misfit,
        variance_m2=refined.variance_m2,
        reference_time_s=refined.reference_time_s,
        query_time_s=refined.query_time_s,
    )
    return MatchOutcome(match=found, reason=None)


def _error(problem: _Problem, shift_m: Array, *, absolute: bool) -> tuple[float, int, float]:
    return error_at(
        problem.reference,
        problem.query,
        shift_m,
        problem.minimum_cells,
        problem.ridge_cells,
        absolute=absolute,
    )


def _nearest(surface: ErrorSurface, shift_m: Array) -> tuple[int, int]:
    return (
        int(np.argmin(np.abs(surface.north_m - shift_m[0]))),
        int(np.argmin(np.abs(surface.east_m - shift_m[1]))),
    )


def _none(reason: NoMatch) -> MatchOutcome:
    return MatchOutcome(match=None, reason=reason)


def _mean_variance(layer: Layer) -> float:
    return float(np.nanmean(layer.grid.variance_m2))


def _mean_slope2(layer: Layer) -> float:
    """Return the mean squared slope per axis, free of the cells' noise.

    A product of differences that share no cell: noise is independent, relief is not.
    """
    depth, step_m = layer.grid.depth_m, layer.grid.cell_m
    products = []
    for values in (depth, depth.T):
        difference = np.diff(values, axis=0)
        product = difference[:-2] * difference[2:]
        products.append(product[np.isfinite(product)])
    both = np.concatenate(products)
    return max(float(both.mean()) / step_m**2, 0.0) if both.size else 0.0


def _check(reference: GriddedSubmap, query: GriddedSubmap, covariance_m2: Array) -> None:
    if abs(reference.cell_m - query.cell_m) > 1e-9:
        raise EstimationError(
            f"grids of {reference.cell_m} m and {query.cell_m} m cells cannot be matched; "
            "grid both alike"
        )
    if not np.all(np.isfinite(covariance_m2)) or np.linalg.eigvalsh(covariance_m2)[0] <= 0.0:
        raise EstimationError(
            f"prior covariance {np.asarray(covariance_m2).tolist()} m^2 is not positive definite"
        )


def _noise_model(settings: MatchingSettings, *, reconstructed: bool) -> NoiseModel:
    return NoiseModel(
        cell_sigma_m=settings.cell_sigma_m,
        position_sigma_m=settings.position_sigma_m,
        offset_sigma_m=settings.depth_offset_sigma_m,
        tilt_sigma=settings.tilt_sigma,
        bend_sigma_per_m=settings.bend_sigma_per_m,
        drift_sigma_mps=settings.drift_sigma_mps,
        walk_m2_per_s=settings.walk_m2_per_s,
        correlation_m=settings.correlation_m,
        correlated_share=settings.correlated_share if reconstructed else 0.0,
    )
