"""Matching of two sub-maps: Eq. (8) and (10), what they leave open, and how sure the answer is."""

from dataclasses import dataclass, replace

import numpy as np

from firmware.geometry import Array
from firmware.leader import ambiguity
from firmware.leader.alignment import Aligned, NoiseModel, fields_of
from firmware.leader.covariance import Refined, measure
from firmware.leader.matches import Match, MatchingSettings, MatchOutcome, NoMatch
from firmware.leader.refinement import refine
from firmware.leader.relief import (
    Spectrum,
    WaveNoise,
    fine_relief_m2,
    information_per_cell,
    spectrum,
)
from firmware.leader.screening import (
    ErrorSurface,
    Layer,
    error_at,
    error_surface,
    mean_slope2,
    prepare,
)
from firmware.submaps import GriddedSubmap
from protocol.errors import EstimationError

_NEGLIGIBLE = 1e-6  # mass beside the best lattice shift's that is not worth refining

__all__ = ["Match", "MatchOutcome", "MatchingSettings", "NoMatch", "match"]


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
    prior_m, covariance_m2 = np.asarray(prior_shift_m), np.asarray(prior_covariance_m2)
    return _search(_problem(layer_r, layer_q, prior_m, covariance_m2, settings), times_s)


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
    spectra: tuple[Spectrum, Spectrum]
    white_m2: float
    shared_m2: float


def _problem(
    reference: Layer,
    query: Layer,
    prior_m: Array,
    covariance_m2: Array,
    settings: MatchingSettings,
) -> _Problem:
    """Return the problem with every layer charged with its share of the noise.

    A reconstruction misses the waves that are shorter than its points can carry; how high they
    are is told by the finer of the two spectra.
    """
    spectra = (spectrum(reference), spectrum(query))
    fine_m2 = max(fine_relief_m2(s, settings.finest_wave_m) for s in spectra)
    slope2 = 0.5 * (mean_slope2(reference.grid) + mean_slope2(query.grid))
    half_m2 = 0.5 * settings.cell_sigma_m**2 + settings.position_sigma_m**2 * slope2
    layers = [
        layer.charged(fine_m2 if layer.reconstructed else 0.0, half_m2)
        for layer in (reference, query)
    ]
    noise_m2 = sum(_per_cell(layer.noise_m2, layer) for layer in layers)
    rebuilt_m2 = sum(_per_cell(layer.map_m2, layer) for layer in layers if layer.reconstructed)
    shared_m2 = settings.correlated_share * rebuilt_m2
    offset_m2 = settings.depth_offset_sigma_m**2
    return _Problem(
        reference=layers[0],
        query=layers[1],
        prior_m=prior_m,
        covariance_m2=covariance_m2,
        settings=settings,
        noise=_noise_model(settings, shared_m2 / noise_m2),
        minimum_cells=settings.minimum_overlap_m2 / query.grid.cell_m**2,
        ridge_cells=noise_m2 / offset_m2 if offset_m2 > 0.0 else np.inf,
        spectra=spectra,
        white_m2=noise_m2 - shared_m2,
        shared_m2=shared_m2,
    )


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
    found = _posterior(surface, _evidence(surface, relief), problem)
    candidates = _refine_best(surface, found, problem, times_s)
    if not candidates:
        return _none(NoMatch.UNSETTLED)
    scale = _tolerated(min(c.residual_m2 / c.noise_m2 for c in candidates))
    relief = replace(relief, noise_scale=scale, information_per_cell=_information(problem, scale))
    evidence = _evidence(surface, relief)
    refined = [_evidence_at(candidate, relief) for candidate in candidates]
    for candidate, value in zip(candidates, refined, strict=True):
        row, col = _nearest(surface, candidate.field.shift_m)
        evidence[row, col] = max(evidence[row, col], value)
    scores = [value + c.log_prior for c, value in zip(candidates, refined, strict=True)]
    best = int(np.argmax(scores))
    found = _posterior(surface, evidence, problem)
    return _decide(candidates[best], refined[best], found, problem)


def _tolerated(misfit: float) -> float:
    """Return the misfit up to which a shift counts as good as the best, whose misfit is given.

    Residuals fluctuate by a tenth; where even the best fits worse than the noise allows, something
    unmodelled with few degrees of freedom is at work (strain within a sub-map), and differences of
    its own size mean nothing.
    """
    return max(misfit * (1.2 + max(misfit - 0.8, 0.0)), 0.5)


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


def _window(whole: ErrorSurface, problem: _Problem) -> ErrorSurface | None:
    """Return the part of the surface that the prior allows, None if it is empty."""
    settings = problem.settings
    half = settings.search_sigmas * np.sqrt(np.diag(problem.covariance_m2))
    half = np.minimum(half + 2.0 * problem.query.grid.cell_m, settings.search_cap_m)
    north = np.flatnonzero(np.abs(whole.north_m - problem.prior_m[0]) <= half[0])
    east = np.flatnonzero(np.abs(whole.east_m - problem.prior_m[1]) <= half[1])
    if north.size < 2 or east.size < 2:
        return None
    return whole.window(slice(north[0], north[-1] + 1), slice(east[0], east[-1] + 1))


def _relief(
    whole: ErrorSurface, surface: ErrorSurface, problem: _Problem
) -> ambiguity.Relief | None:
    """Return background, noise and the information of the relief."""
    row, col = np.unravel_index(int(np.argmin(surface.residual_m2)), surface.residual_m2.shape)
    best_m = np.array([surface.north_m[row], surface.east_m[col]])
    away_m = 3.0 * problem.settings.basin_m
    background = ambiguity.background(whole, best_m, away_m)
    if background is None:
        return None
    return ambiguity.Relief(
        background=background,
        information_per_cell=_information(problem, noise_scale=1.0),
        coherent_cells=problem.settings.coherent_overlap_m2 / problem.query.grid.cell_m**2,
    )


def _information(problem: _Problem, noise_scale: float) -> float:
    """Return the information per cell of the layer that has less of it."""
    noise = WaveNoise(
        white_m2=problem.white_m2 * noise_scale,
        shared_m2=problem.shared_m2 * noise_scale,
        correlation_m=problem.settings.correlation_m,
        position_sigma_m=problem.settings.position_sigma_m,
    )
    return min(information_per_cell(relief, noise) for relief in problem.spectra)


def _posterior(surface: ErrorSurface, evidence: Array, problem: _Problem) -> ambiguity.Posterior:
    return ambiguity.posterior(
        surface, evidence, problem.prior_m, problem.covariance_m2, problem.settings.null_share
    )


def _refine_best(
    surface: ErrorSurface,
    found: ambiguity.Posterior,
    problem: _Problem,
    times_s: tuple[float | None, float | None],
) -> list[_Candidate]:
    """Return the refined minima among the best lattice shifts."""
    fields = (
        fields_of(problem.reference, problem.settings.slope_smoothing_cells),
        fields_of(problem.query, problem.settings.slope_smoothing_cells),
    )
    inverse = np.linalg.inv(problem.covariance_m2)
    candidates = []
    for start_m in _starts(surface, found, problem.settings, problem.query.grid.cell_m):
        field = refine(problem.reference, problem.query, fields, start_m, times_s, problem.noise)
        if field is None:
            continue
        error, count, _ = _error(problem, field.shift_m, absolute=False)
        if not np.isfinite(error):
            continue
        away = field.shift_m - problem.prior_m
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
        if flat[index] <= _NEGLIGIBLE * flat[order[0]]:
            break
        row, col = divmod(int(index), found.mass.shape[1])
        shift = np.array([surface.north_m[row], surface.east_m[col]])
        if all(np.hypot(*(shift - other)) > 2.9 * cell_m for other in starts):
            starts.append(shift)
        if len(starts) == settings.basins:
            break
    return starts


def _decide(
    winner: _Candidate, evidence: float, found: ambiguity.Posterior, problem: _Problem
) -> MatchOutcome:
    """Return the winner as a closure in the plane or along one axis, or the gate it failed.

    Mass that is certain where neither the slopes nor the prior can be is a contradiction: chance
    has chosen among repetitions of a pattern.
    """
    settings, refined = problem.settings, measure(winner.field, problem.noise)
    residual, _, _ = _error(problem, refined.shift_m, absolute=settings.residual == "absolute")
    limit = settings.residual_noise_ratio * refined.variance_m2
    if settings.residual == "absolute":
        limit = np.sqrt(limit)
    if evidence < settings.evidence_limit:
        return _none(NoMatch.FEATURELESS)
    if residual > max(settings.residual_limit, limit):
        return _none(NoMatch.RESIDUAL)
    covariance = refined.covariance_m2 * settings.covariance_scale
    values, vectors = np.linalg.eigh(covariance)
    sigmas = np.sqrt(values)
    verdict = ambiguity.judge(found, refined.shift_m, settings.basin_m)
    certain = verdict.false_mass <= settings.false_mass_limit
    walk = np.eye(2) * refined.walk_m2
    if certain and sigmas[1] <= settings.sigma_limit_m:
        return _closure(refined, residual, evidence, covariance + walk, None, verdict.false_mass)
    free_m = np.sqrt(vectors[:, 1] @ problem.covariance_m2 @ vectors[:, 1])
    if certain and min(sigmas[1] / 2.0, free_m) <= settings.basin_m:
        axis, false_mass = vectors[:, 0], verdict.false_mass
    elif not certain and verdict.false_mass_off_line <= settings.false_mass_limit:
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
    return _closure(refined, residual, evidence, wide + walk, axis_deg, false_mass)


def _closure(
    refined: Refined,
    residual: float,
    log_evidence: float,
    covariance_m2: Array,
    axis_deg: float | None,
    false_mass: float,
) -> MatchOutcome:
    found = Match(
        shift_m=refined.shift_m,
        covariance_m2=covariance_m2,
        residual=residual,
        overlap_cells=refined.overlap_cells,
        depth_offset_m=refined.depth_offset_m,
        axis_deg=axis_deg,
        false_mass=false_mass,
        log_evidence=log_evidence,
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


def _per_cell(values: Array, layer: Layer) -> float:
    return float(values.sum() / layer.known.sum())


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


def _noise_model(settings: MatchingSettings, correlated_share: float) -> NoiseModel:
    return NoiseModel(
        cell_sigma_m=settings.cell_sigma_m,
        position_sigma_m=settings.position_sigma_m,
        offset_sigma_m=settings.depth_offset_sigma_m,
        tilt_sigma=settings.tilt_sigma,
        bend_sigma_per_m=settings.bend_sigma_per_m,
        drift_sigma_mps=settings.drift_sigma_mps,
        walk_m2_per_s=settings.walk_m2_per_s,
        correlation_m=settings.correlation_m,
        correlated_share=correlated_share,
    )
