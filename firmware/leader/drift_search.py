"""The drift that a vehicle's own sub-maps share, where no pair of them tells it alone.

Where relief is faint, a pair of sub-maps fits at many shifts. Yet one drift moves all pairs of a
vehicle, each by as much as the time between its two passes: drifts are tried, and what every pair
says of the shift that a drift implies is summed. What is found is told as the hint of one pair.
"""

import itertools
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, ndimage

from firmware.geometry import Array
from firmware.leader import ambiguity
from firmware.leader.alignment import align
from firmware.leader.ambiguity import Relief
from firmware.leader.atlas import overlap_m2
from firmware.leader.coarse_grid import coarse
from firmware.leader.design import curvature, design_of
from firmware.leader.drifts import AGE_S, SUBMAP_S
from firmware.leader.hinting import depth_misfit
from firmware.leader.match_job import MatchJob
from firmware.leader.matches import Hint
from firmware.leader.pair_problem import PairProblem, pair_problem
from firmware.leader.screening import ErrorSurface
from firmware.leader.wander import MeanDrift, Wandering, mean_drift
from firmware.leader.warping import remove_drift
from firmware.submaps import GriddedSubmap

_STEP_MPS = 0.02  # between drifts that are tried
_STEPS_EACH = 5  # along each axis, that share a surface: their strain differs by half a metre
_REACH_SIGMAS = 2.25  # of the drift before anything is known, that are tried
_TOLERANCE = 1.2  # of the best misfit: a pair tells a region of shifts, not one
_LEAST_MISFIT = 1.3  # of coarse cells: by chance one shift has a tenth more than the next
_MOST_MISFIT = 3.0  # of the best shift; a pair that fits worse errs in a way that no drift explains
_DATUM_FLOOR_M = 0.03  # of a depth offset between two passes
_LEAST_SHARED = 0.4  # of slopes: half and more on seabed that tells, next to none along a ridge
_TINY = 1e-9  # (s/m)^2
_MOST_TOLD = 50.0  # nats of one pair
_MOST_GROUPS = 12  # of drifts each way: more than a metre a second
_GAINED = 0.25  # share of the variance, in the worse direction, up to which a drift counts as found


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundDrift:
    """What a search found, as a hint of one of its pairs: passes farthest apart in time tell most.

    `pair` is its place among the search's jobs.
    """

    pair: int
    hint: Hint


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftSearch:
    """A search for the mean drift of one chain by its own pairs, at least one; first passes first.

    drift_sigma_mps is how large drift may be, each axis, before anything tells of it.
    """

    jobs: tuple[MatchJob, ...]
    wandering: Wandering
    drift_sigma_mps: float

    def run(self) -> FoundDrift | None:
        """Return what all pairs together say, None where that is too little."""
        begin_s = min(job.origin.time_s for job in self.jobs)
        end_s = max(job.target.time_s for job in self.jobs)
        spans = [
            mean_drift(
                (job.origin.time_s - begin_s, job.target.time_s - begin_s),
                end_s - begin_s,
                self.wandering,
                self.drift_sigma_mps,
            )
            for job in self.jobs
        ]
        pairs = [_Tried(job, span) for job, span in zip(self.jobs, spans, strict=True)]
        prior_m2ps2 = spans[0].variance_m2ps2
        drifts_mps = _tried(_REACH_SIGMAS * np.sqrt(prior_m2ps2))
        log_mass = -0.5 * np.add.outer(drifts_mps**2, drifts_mps**2) / prior_m2ps2
        for pair in pairs:
            log_mass += pair.evidence(drifts_mps)
        mean_mps, covariance = _moments(drifts_mps, log_mass)
        if np.linalg.eigvalsh(covariance)[-1] > _GAINED * prior_m2ps2:
            return None
        if _shared_slopes(pairs, mean_mps) < _LEAST_SHARED:
            return None
        likely = np.linalg.inv(np.linalg.inv(covariance) - np.eye(2) / prior_m2ps2)
        farthest = int(np.argmax([span.gain_s for span in spans]))
        span = spans[farthest]
        left_m2 = span.left_m2 + self.jobs[farthest].settings.hint_floor_m ** 2
        return FoundDrift(
            pair=farthest,
            hint=Hint(
                shift_m=-span.gain_s * mean_mps,
                covariance_m2=span.gain_s**2 * likely + left_m2 * np.eye(2),
            ),
        )


class _Tried:
    """A pair in coarse cells, and what a drift makes of it."""

    def __init__(self, job: MatchJob, span: MeanDrift) -> None:
        self._job, self._span = job, span
        self._grids = coarse(job.origin_grid), coarse(job.target_grid)

    def evidence(self, drifts_mps: Array) -> Array:
        """Return the log evidence (D, D) for every drift, zero where nothing would overlap."""
        found = np.zeros((drifts_mps.size, drifts_mps.size))
        job = self._job
        rounded_m = AGE_S * _STEP_MPS * _STEPS_EACH / np.sqrt(6.0)
        walked_m = np.sqrt(job.settings.walk_m2_per_s * SUBMAP_S / 3.0)
        strain_m = float(np.hypot(rounded_m, walked_m))
        sigmas = replace(job.sigmas, strain_m=strain_m)
        problem = pair_problem(*self._grids, job.settings, sigmas)
        if problem is None:
            return found
        surfaces = dict[tuple[int, int], ErrorSurface]()
        groups = range(drifts_mps.size // _STEPS_EACH)
        for i, j in itertools.product(groups, groups):
            drift_mps = drifts_mps[np.array([i, j]) * _STEPS_EACH + _STEPS_EACH // 2]
            if np.hypot(*drift_mps) <= drifts_mps[-1]:
                surface = self._surface(problem, drift_mps)
                if surface is not None:
                    surfaces[i, j] = surface
        least = min((float(surface.misfit.min()) for surface in surfaces.values()), default=np.inf)
        if least > _MOST_MISFIT:
            return found
        scale = max(_TOLERANCE * least, _LEAST_MISFIT)
        relief = Relief(
            background=np.inf,
            information_per_cell=2.0 * problem.information(scale, strain_m=strain_m),
            coherent_cells=job.settings.coherent_overlap_m2 / problem.query.grid.cell_m**2,
            noise_scale=scale,
        )
        for (i, j), surface in surfaces.items():
            rows = slice(i * _STEPS_EACH, (i + 1) * _STEPS_EACH)
            columns = slice(j * _STEPS_EACH, (j + 1) * _STEPS_EACH)
            mesh_mps = np.meshgrid(drifts_mps[rows], drifts_mps[columns], indexing="ij")
            shifts_m = -self._span.gain_s * np.stack(mesh_mps)
            told = ambiguity.tempered_evidence(surface, relief, problem.correlated_cells)
            told -= depth_misfit(problem, surface, _DATUM_FLOOR_M)
            told = np.clip(told, 0.0, _MOST_TOLD)
            found[rows, columns] = _averaged(surface, told, self._span.left_m2, shifts_m)
        return found

    def slopes(self, drift_mps: Array) -> Array:
        """Return what slopes tell of a drift (2,) by both passes, and by their mean, (2, 2, 2).

        Both are informations in (s/m)^2, where the pair lies by that drift.
        """
        job = self._job
        problem = pair_problem(*self._warped(drift_mps), job.settings, job.sigmas)
        if problem is None:
            return np.zeros((2, 2, 2))
        shift_m = -self._span.gain_s * drift_mps
        field = align(problem.reference, problem.query, problem.fields(), shift_m, problem.noise)
        if field is None:
            return np.zeros((2, 2, 2))
        design = design_of(field, problem.noise)
        mean = design.columns[:2]
        both = curvature(field, design)[:2, :2]
        return self._span.gain_s**2 * np.stack([both, (mean / field.variance_m2) @ mean.T])

    def _surface(self, problem: PairProblem, drift_mps: Array) -> ErrorSurface | None:
        """Return the error surface about the shift by a drift (2,), None if nothing overlaps."""
        job, span = self._job, self._span
        shift_m = -span.gain_s * drift_mps
        half_m = span.gain_s * _STEP_MPS * _STEPS_EACH / 2 + 3.0 * np.sqrt(span.left_m2)
        around_m = shift_m + half_m * np.array([[0, 0], [1, 1], [1, -1], [-1, 1], [-1, -1]])
        if overlap_m2(job.origin, job.target, around_m).max() < job.settings.minimum_overlap_m2:
            return None
        whole = problem.surface_of(*self._warped(drift_mps))
        if whole is None:
            return None
        near = whole.around(shift_m, np.full(2, half_m + problem.query.grid.cell_m))
        if near is None or not np.isfinite(near.residual_m2).any():
            return None
        return problem.strained(near)

    def _warped(self, drift_mps: Array) -> tuple[GriddedSubmap, GriddedSubmap]:
        """Return both grids, from which drifts of their own were taken, rid of a drift (2,)."""
        job, (origin, target) = self._job, self._grids
        north_mps, east_mps = (drift_mps - job.origin_drift_mps).tolist()
        origin = remove_drift(origin, north_mps, east_mps, job.origin.time_s, nearest=True)
        north_mps, east_mps = (drift_mps - job.target_drift_mps).tolist()
        return origin, remove_drift(target, north_mps, east_mps, job.target.time_s, nearest=True)


def _tried(reach_mps: float) -> Array:
    """Return the drifts along one axis, (D,), in whole groups that share a surface."""
    groups = int(np.ceil(reach_mps / _STEP_MPS / _STEPS_EACH - 0.5))
    each_way = min(groups, _MOST_GROUPS) * _STEPS_EACH + _STEPS_EACH // 2
    return np.asarray(_STEP_MPS * np.arange(-each_way, each_way + 1.0))


def _shared_slopes(pairs: list[_Tried], drift_mps: Array) -> float:
    """Return the share of slopes that both passes have, in the direction of the least of it.

    Along a ridge that goes on as far as sub-maps overlap slopes are noise, which they do not share:
    that they overlap at all is then all that is known.
    """
    both, mean = np.sum([pair.slopes(drift_mps) for pair in pairs], axis=0)
    return float(linalg.eigvalsh(both, mean + _TINY * np.eye(2))[0])


def _averaged(surface: ErrorSurface, evidence: Array, left_m2: float, shifts_m: Array) -> Array:
    """Return the log of the mean of exp(evidence) about shifts (2, ...), as sure as left_m2."""
    cell_m = float(surface.north_m[1] - surface.north_m[0])
    blur_cells = np.sqrt(left_m2) / cell_m
    blurred = ndimage.gaussian_filter(np.exp(evidence), blur_cells, mode="constant", cval=1.0)
    first_m = np.array([surface.north_m[0], surface.east_m[0]]).reshape(2, 1, 1)
    at = (shifts_m - first_m) / cell_m
    means = ndimage.map_coordinates(blurred, at, order=1, mode="constant", cval=1.0)
    return np.asarray(np.log(means))


def _moments(drifts_mps: Array, log_mass: Array) -> tuple[Array, Array]:
    """Return mean (2,) and covariance (2, 2) of a drift of so much mass (D, D)."""
    mass = np.exp(log_mass - log_mass.max())
    mean, second = ambiguity.moments_of(mass / mass.sum(), drifts_mps, drifts_mps)
    return mean, second - np.outer(mean, mean) + np.eye(2) * _STEP_MPS**2 / 12.0
