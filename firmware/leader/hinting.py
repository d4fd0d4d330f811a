"""What a pair that gave no closure still says: the hint that its ambiguous posterior leaves."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from firmware.geometry import Array
from firmware.leader import ambiguity
from firmware.leader.ambiguity import Prior, Relief
from firmware.leader.matches import Hint
from firmware.leader.pair_problem import PairProblem
from firmware.leader.screening import ErrorSurface

_WARPED_NOISE = 0.35  # of the cells' variance: taking drift out of a grid averages neighbours
_TOLERANCE = 1.2  # of the best misfit: a hint tells a region of shifts, not one
_NOTHING_GAINED = 0.95  # share of the prior's variance left: that axis is as unknown as before
_LONGEST_SIGMAS = np.pi  # of the prior: the longest wave that tells its shifts apart
_PROFILE_SIGMAS = 0.25  # of a region, between shifts that are held side by side
_MOST_BINS = 160  # of a profile, however far it reaches
_LEAST_SHARE = 1e-6  # of the prior's variance that a region has left, for its own scale
_CONTRADICTION = 2.0  # nats against a shift, beyond which a region does not go on there
_DATUM_FLOOR_M = 0.1  # of a depth offset: slopes and decoding shift the mean of an overlap
_ASKEW_RAD = 0.03  # sigma of the axis of a hint along one only
_UNLIKE = 0.1  # of the misfit of unrelated seabed: drift makes so much of the relief itself
_FAINT = 30.0  # misfit of unrelated seabed up to which depth ends regions, too: a plain has 1 to 20
_NO_INFORMATION = 1e4  # variances of the prior


def hint_of(
    problem: PairProblem, surface: ErrorSurface, relief: Relief, prior: Prior
) -> Hint | None:
    """Return the factor between prior and moments of the posterior, widened; None if it is weak."""
    if not np.isfinite(surface.residual_m2).any():
        return None
    settings, surface = problem.settings, problem.strained(surface)
    cautious = _cautious(problem, surface, relief, prior)
    evidence = ambiguity.tempered_evidence(surface, cautious, problem.correlated_cells)
    depth_nats = depth_misfit(problem, surface, _DATUM_FLOOR_M)
    evidence -= depth_nats
    found = ambiguity.posterior(surface, evidence, prior, settings.null_share)
    mean_m, covariance_m2 = ambiguity.moments(found, prior)
    root = np.linalg.cholesky(prior.covariance_m2)
    inverse = np.linalg.inv(root)
    left, axes = np.linalg.eigh(inverse @ covariance_m2 @ inverse.T)  # shares of the prior
    contradicted = _contradicted(problem, surface, cautious, depth_nats)
    sigmas = np.sqrt(np.maximum(left, _LEAST_SHARE))
    away = axes.T @ inverse @ _shifts_from(surface, mean_m) / sigmas[:, None]
    closed = np.array([_is_closed(away[k], away[1 - k], contradicted) for k in (0, 1)])
    gained = closed & (left < _NOTHING_GAINED)
    if not gained.any() or left[gained].min() > settings.hint_gain:
        return None
    share = np.where(gained, left / np.maximum(1.0 - left, 1e-3), 1.0)
    moved = axes.T @ inverse @ (mean_m - prior.mean_m)
    steps = np.where(gained, moved / np.maximum(1.0 - left, 1e-3), 0.0)
    frame = root @ axes
    told = np.where(gained, settings.hint_scale * share, _NO_INFORMATION)
    if not gained.all():  # an axis a little askew would tell of what slides along
        (k,) = np.flatnonzero(gained)
        slide_m = ambiguity.PRIOR_DOUBTED * np.hypot(*frame[:, 1 - k])
        told[k] += (_ASKEW_RAD * slide_m * np.hypot(*(inverse.T @ axes[:, k]))) ** 2
    return Hint(
        shift_m=prior.mean_m + frame @ steps,
        covariance_m2=frame @ np.diag(told) @ frame.T + settings.hint_floor_m**2 * np.eye(2),
    )


def _shifts_from(surface: ErrorSurface, mean_m: Array) -> Array:
    """Return the shifts (2, S) of a surface at which there is overlap, from a mean."""
    row, column = np.nonzero(np.isfinite(surface.residual_m2))
    return np.stack([surface.north_m[row], surface.east_m[column]]) - mean_m[:, None]


def depth_misfit(problem: PairProblem, surface: ErrorSurface, floor_m: float) -> Array:
    """Return what the depth offset between the sub-maps speaks against each shift, in nats.

    On a slope that goes on, it alone tells how far along they lie. Tide and sensor may have
    wandered: a t-distribution of three degrees of freedom forgives them a few sigmas.
    """
    told_m = problem.noise.offset_sigma_m
    if told_m == 0.0:
        return np.zeros(surface.overlap_cells.shape)
    variance_m2 = told_m**2 + problem.strained_m2 + floor_m**2
    offset_m = np.where(np.isfinite(surface.residual_m2), surface.depth_offset_m, 0.0)
    return np.asarray(2.0 * np.log1p(offset_m**2 / (3.0 * variance_m2)))


def _contradicted(
    problem: PairProblem, surface: ErrorSurface, relief: Relief, depth_misfit: Array
) -> NDArray[np.bool_]:
    """Return at which shifts (K L,) that overlap the two sub-maps contradict each other.

    Misfit grows with the overlap wherever drift bends what is compared: it has to be a good part of
    what unrelated seabed shows as well, lest it end a ridge that goes on. Where relief is faint
    depth tells as well. Elsewhere it does not: drift moves the mean depth of what overlaps of a
    ridge.
    """
    least = float(surface.misfit.min())
    unlike = least + _UNLIKE * max(relief.background - least, 0.0)
    against = ambiguity.misfit_of(surface, relief.noise_scale, problem.correlated_cells)
    contradicted = (against >= _CONTRADICTION) & (surface.misfit >= unlike)
    if relief.background <= _FAINT:
        contradicted |= depth_misfit >= _CONTRADICTION
    return np.asarray(contradicted[np.isfinite(against)])


def _is_closed(along: Array, across: Array, contradicted: NDArray[np.bool_]) -> bool:
    """Return whether the region of likely shifts ends on both its sides along an axis.

    along and across (S,) are in sigmas of the region; it ends where all shifts abreast are
    contradicted (S,). Where it goes on as far as the sub-maps overlap, as along a ridge, it may go
    on beyond as well: that they overlap at all is then no more than a guess.
    """
    band = np.abs(across) <= 1.0
    for side in (along, -along):
        ahead = band & (side > 0.0)
        step = max(_PROFILE_SIGMAS, float(side.max()) / (_MOST_BINS - 1))
        bins = (side / step).astype(np.intp)
        ended, going_on = np.zeros((2, _MOST_BINS), dtype=bool)
        ended[bins[ahead & contradicted]] = True
        going_on[bins[ahead & ~contradicted]] = True
        if not np.any(ended & ~going_on):
            return False
    return True


def _cautious(problem: PairProblem, surface: ErrorSurface, relief: Relief, prior: Prior) -> Relief:
    """Return the scale of a hint's evidence: the best misfit's noise, and a cap of its own.

    Waves longer than what the prior leaves open look alike at all of its shifts: that they fit
    would confirm the prior, whatever it says.
    """
    is_own = not (problem.reference.grid.reconstructed or problem.query.grid.reconstructed)
    least = _WARPED_NOISE if is_own else ambiguity.LEAST_MISFIT
    scale = max(_TOLERANCE * float(surface.misfit.min()), least)
    return replace(
        relief,
        noise_scale=scale,
        information_per_cell=problem.information(
            scale,
            strain_m=problem.sigmas.strain_m,
            longest_m=_LONGEST_SIGMAS * float(np.sqrt(np.linalg.eigvalsh(prior.covariance_m2)[-1])),
        ),
        coherent_cells=problem.settings.hint_overlap_m2 / problem.query.grid.cell_m**2,
    )
