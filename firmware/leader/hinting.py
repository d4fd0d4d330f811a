"""What a pair that gave no closure still says: the hint that its ambiguous posterior leaves."""

from dataclasses import replace

import numpy as np

from firmware.leader import ambiguity
from firmware.leader.ambiguity import Prior, Relief
from firmware.leader.matches import Hint
from firmware.leader.pair_problem import PairProblem
from firmware.leader.screening import ErrorSurface

_WARPED_NOISE = 0.35  # of the cells' variance: taking drift out of a grid averages neighbours
_TOLERANCE = 1.2  # of the best misfit: a hint tells a region of shifts, not one
_NOTHING_GAINED = 0.95  # share of the prior's variance left: that axis is as unknown as before
_LONGEST_SIGMAS = np.pi  # of the prior: the longest wave that tells its shifts apart
_NO_INFORMATION = 1e4  # variances of the prior


def hint_of(
    problem: PairProblem, surface: ErrorSurface, relief: Relief, prior: Prior
) -> Hint | None:
    """Return the factor between prior and moments of the posterior, widened; None if it is weak."""
    if not np.isfinite(surface.residual_m2).any():
        return None
    settings, surface = problem.settings, problem.strained(surface)
    evidence = ambiguity.tempered_evidence(
        surface, _cautious(problem, surface, relief, prior), problem.correlated_cells
    )
    found = ambiguity.posterior(surface, evidence, prior, settings.null_share)
    mean_m, covariance_m2 = ambiguity.moments(found, prior)
    root = np.linalg.cholesky(prior.covariance_m2)
    inverse = np.linalg.inv(root)
    left, axes = np.linalg.eigh(inverse @ covariance_m2 @ inverse.T)  # shares of the prior
    if left[0] > settings.hint_gain:
        return None
    gained = left < _NOTHING_GAINED
    share = np.where(gained, left / np.maximum(1.0 - left, 1e-3), 1.0)
    moved = axes.T @ inverse @ (mean_m - prior.mean_m)
    away = np.where(gained, moved / np.maximum(1.0 - left, 1e-3), 0.0)
    sigmas = np.where(gained, share, _NO_INFORMATION)
    frame = root @ axes
    told_m2 = settings.hint_scale * frame @ np.diag(sigmas) @ frame.T
    return Hint(
        shift_m=prior.mean_m + frame @ away,
        covariance_m2=told_m2 + settings.hint_floor_m**2 * np.eye(2),
    )


def _cautious(problem: PairProblem, surface: ErrorSurface, relief: Relief, prior: Prior) -> Relief:
    """Return the scale of a hint's evidence: the best misfit's noise, and a cap of its own.

    Waves longer than what the prior leaves open look alike at all of its shifts: that they fit
    would confirm the prior, whatever it says.
    """
    misfit = surface.residual_m2 / surface.noise_m2
    is_own = not (problem.reference.reconstructed or problem.query.reconstructed)
    least = _WARPED_NOISE if is_own else ambiguity.LEAST_MISFIT
    scale = max(_TOLERANCE * float(misfit.min()), least)
    return replace(
        relief,
        noise_scale=scale,
        information_per_cell=problem.information(
            scale,
            strain_m=problem.settings.strain_sigma_m,
            longest_m=_LONGEST_SIGMAS * float(np.sqrt(np.linalg.eigvalsh(prior.covariance_m2)[-1])),
        ),
        coherent_cells=problem.settings.hint_overlap_m2 / problem.query.grid.cell_m**2,
    )
