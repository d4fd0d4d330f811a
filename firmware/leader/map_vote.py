"""Whether the map that a closure builds agrees with itself where the match did not look.

The paper rejects invalid closures by the consistency of the map they build (its MCM; the reference
is not available, so this is designed from the paper's description). A closure between two sub-maps
moves their neighbours along with it. Where neighbours then overlap, a valid closure lays
like on like, and an invalid one does not. Each such window votes with a log-likelihood ratio of
agreement against unrelated seabed, averaged over what dead reckoning leaves open; a flat seabed
and a window without overlap abstain.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from firmware.geometry import Array
from firmware.leader.ambiguity import Relief
from firmware.leader.matches import ANY_PAIR, MatchingSettings, PairSigmas
from firmware.leader.pair_problem import PairProblem, pair_problem, relief_of
from firmware.leader.screening import ErrorSurface
from firmware.submaps import GriddedSubmap
from protocol.settings import Settings, setting

_LEAST_BACKGROUND = 1.5  # of the noise; where blind shifts fit as well, agreement says nothing
_MISFIT_RANGE = (0.5, 2.0)  # outside, the match was lucky or the noise model is wrong


@dataclass(frozen=True, slots=True, kw_only=True)
class VoteSettings(Settings):
    """How windows vote."""

    tolerance: float = setting(
        1.5, "", "misfit over the noise model that a true window may have", minimum=1.0
    )
    pivot: float = setting(
        2.0, "", "excess over the tolerated misfit that speaks neither for nor against", minimum=1.1
    )
    window_limit: float = setting(
        6.0, "", "most that one window may add to the log ratio", minimum=0.1
    )
    reach_sigmas: float = setting(
        2.5, "", "of the predicted shift, within which each window is searched", minimum=0.5
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class VoteWindow:
    """Two neighbours of a closure's sub-maps, drift removed, each in its raw dead reckoning.

    shift_m (2,) is what the closure says is to be added to the query's coordinates so that it lies
    on the reference; covariance_m2 (2, 2) is its covariance and that of the dead reckoning in
    between (`carried`).
    """

    reference: GriddedSubmap
    query: GriddedSubmap
    shift_m: Array
    covariance_m2: Array
    matching: MatchingSettings
    sigmas: PairSigmas = ANY_PAIR


@dataclass(frozen=True, slots=True, kw_only=True)
class Vote:
    """Sum of the windows' log ratios: above zero the map agrees, below it contradicts.

    informed counts the windows that did not abstain.
    """

    log_ratio: float
    informed: int


def vote(
    windows: Iterable[VoteWindow],
    settings: VoteSettings,
    matched_misfit: float = 1.0,
) -> Vote:
    """Return the vote of the windows on a closure.

    matched_misfit is that of the closure's own match (`Match.misfit`): its neighbours should fit
    about as well.
    """
    tolerated = settings.tolerance * float(np.clip(matched_misfit, *_MISFIT_RANGE))
    ratios = [_ratio(window, settings, tolerated) for window in windows]
    return Vote(log_ratio=float(sum(ratios)), informed=sum(ratio != 0.0 for ratio in ratios))


def carried(
    shift_m: Array,
    covariance_m2: Array,
    ages_s: tuple[float, float],
    drifts_mps: tuple[Array, Array],
    settings: MatchingSettings,
) -> tuple[Array, Array]:
    """Return shift and covariance for neighbours of a pair.

    ages_s are the reference neighbour's time minus the reference's and the same for the query;
    drifts_mps the velocity errors (2,) that were removed from each vehicle's grids. Dead reckoning
    that drifts by D lays a grid D too far: the shift is D of the reference minus D of the query.
    """
    shift = shift_m + ages_s[0] * drifts_mps[0] - ages_s[1] * drifts_mps[1]
    walk_m2 = sum(
        settings.walk_m2_per_s * abs(age_s) + (settings.drift_sigma_mps * age_s) ** 2
        for age_s in ages_s
    )
    return shift, covariance_m2 + walk_m2 * np.eye(2)


def _ratio(window: VoteWindow, settings: VoteSettings, tolerated: float) -> float:
    problem = pair_problem(window.reference, window.query, window.matching, window.sigmas)
    if problem is None:
        return 0.0
    surface = problem.surface()
    predicted = _predicted(surface, window, settings.reach_sigmas)
    if predicted is None:
        return 0.0
    relief = relief_of(problem, surface, window.shift_m)
    if relief is None or relief.background < _LEAST_BACKGROUND * tolerated:
        return 0.0
    allowed, weight = predicted
    ratio = _log_ratio(allowed, problem, relief, settings.pivot, tolerated)
    mean = float(np.log(np.sum(weight * np.exp(ratio))))
    return float(np.clip(mean, -settings.window_limit, settings.window_limit))


def _predicted(
    surface: ErrorSurface, window: VoteWindow, reach_sigmas: float
) -> tuple[ErrorSurface, Array] | None:
    """Return the shifts that the prediction allows, if any, and their weights (sum 1)."""
    cell_m = window.query.cell_m
    spread = window.covariance_m2 + np.eye(2) * cell_m**2 / 12.0
    half = np.maximum(reach_sigmas * np.sqrt(np.diag(spread)), cell_m)
    ranges = []
    for axis_m, centre_m, half_m in zip(
        (surface.north_m, surface.east_m), window.shift_m, half, strict=True
    ):
        inside = np.flatnonzero(np.abs(axis_m - centre_m) <= half_m)
        if not inside.size:
            return None
        ranges.append(slice(int(inside[0]), int(inside[-1]) + 1))
    allowed = surface.window(*ranges)
    weight = np.exp(-0.5 * allowed.squares_from(window.shift_m, spread))
    return allowed, weight / weight.sum()


def _log_ratio(
    surface: ErrorSurface, problem: PairProblem, relief: Relief, pivot: float, tolerated: float
) -> Array:
    """Return the log ratio of agreement over unrelated seabed at each shift, zero without overlap.

    It falls with log(E / noise): +N I where E is what the noise makes, zero at the pivot or half
    way to the background, -N I as far beyond.
    """
    usable = np.isfinite(surface.residual_m2)
    misfit = np.where(usable, surface.misfit, 1.0) / tolerated
    level = relief.background / tolerated
    half_way = min(np.log(pivot), 0.5 * np.log(level))
    share = 1.0 - np.log(np.maximum(misfit, 1.0)) / half_way
    cells = np.minimum(surface.overlap_cells, relief.coherent_cells)
    information = problem.information(noise_scale=tolerated)
    ratio = cells * information * np.maximum(share, -1.0)
    return np.where(usable, np.clip(ratio, -50.0, 50.0), 0.0)
