"""What the residual error surface says about where the shift may be, and how surely.

Every lattice shift is compared with the hypothesis that the two sub-maps show unrelated seabed.
Let x = E / v be the mean square difference over the overlap in units of the noise there. Under a
match x is about 1, of partly unknown scale; under no match it is as large as at shifts chosen
blindly: the background b. With I the information per cell that the relief's spectrum offers
(`relief`), the log evidence of N cells is

    I [min(N, C) - N (1 - f(x) / f(1))],
    f(x) = log(b / max(1, x)) - x / max(1, x) + x / b  for x < b, else 0,

and never below zero. Misfit counts on all cells, but fit on C of them at most: ripples repeat, and
more of them beneath a larger overlap prove nothing new.

It grows with relief and overlap, is zero on a flat seabed, and falls off as a power of E rather
than exponentially, so that misfit beyond the noise model cannot let a small, lucky overlap win.
"""

import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from firmware.geometry import Array
from firmware.leader.screening import ErrorSurface

_LEAST_BACKGROUND = 20  # shifts; fewer say nothing about the background
_FLUCTUATIONS = 1.5  # sigmas of a mean square by which two right shifts may differ
_LEAST_FLUCTUATION = 0.2  # noise is not known to better than that
_UNSTRAINED_MISFIT = 0.8  # what the noise model alone leaves at the best shift, or less
LEAST_MISFIT = 0.5  # noise is seldom less than half of what is assumed
_LEAST_RIDGE = 5  # shifts that fit; fewer have no direction
_RIDGE_SIGMA_RAD = 0.01  # of its direction: half a degree of heading between two passes
_UNTRACED_RAD = 0.3  # where too few shifts fit to follow it: slopes at the winner tell little
PRIOR_DOUBTED = 3.0  # sigmas of it, where a ridge's direction still has to hold
_LEAST_GAIN = 0.3  # f(1) of a background of 2.3; below it the surface hardly has a minimum


class Ridge(NamedTuple):
    """A line along which shifts fit equally well, by the axis across it, and how surely."""

    axis: Array  # (2,) unit vector across the ridge
    sigma_rad: float
    strayed_m2: float  # mean square distance of the ridge from its line


class Prior(NamedTuple):
    """What the graph believes of the shift before the match."""

    mean_m: Array  # (2,)
    covariance_m2: Array  # (2, 2)


@dataclass(frozen=True, slots=True, kw_only=True)
class Relief:
    """What sets the scale of the evidence.

    background is the median of x; information_per_cell that of the relief; noise_scale how far the
    best match exceeds the noise model, by which all others are measured too; coherent_cells is C.
    """

    background: float
    information_per_cell: float
    coherent_cells: float
    noise_scale: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Posterior:
    """Probability mass on the lattice shifts (K, L) and outside them (no or too little overlap)."""

    north_m: Array
    east_m: Array
    mass: Array
    outside: float


@dataclass(frozen=True, slots=True, kw_only=True)
class MassElsewhere:
    """How much mass lies away from the winner, in the plane and away from its line.

    axis_rad is the direction from north across the line: the one in which the shift is known.
    """

    false_mass: float
    axis_rad: float
    false_mass_off_line: float


def background(surface: ErrorSurface, best_m: Array, away_m: float) -> float | None:
    """Return the median E / noise of shifts beyond away_m of the best, None if there are few."""
    north, east = surface.north_m - best_m[0], surface.east_m - best_m[1]
    far = north[:, None] ** 2 + east[None, :] ** 2 > away_m**2
    far &= np.isfinite(surface.residual_m2)
    if np.count_nonzero(far) < _LEAST_BACKGROUND:
        return None
    return float(np.median(surface.residual_m2[far] / surface.noise_m2[far]))


def tolerated_misfit(misfit: float, independent_cells: float) -> float:
    """Return the E / noise up to which a shift counts as good as the best, given the best one's.

    Mean squares of so many independent cells fluctuate, by a fifth at least; neighbours in a
    reconstruction err together, and few are independent. Where even the best fits worse than the
    noise allows, something unmodelled with few degrees of freedom is at work (strain within a
    sub-map), and differences of its own size mean nothing.
    """
    fluctuation = _FLUCTUATIONS * math.sqrt(2.0 / max(independent_cells, 1.0))
    strained = max(misfit - _UNSTRAINED_MISFIT, 0.0)
    return max(misfit * (1.0 + max(fluctuation, _LEAST_FLUCTUATION) + strained), LEAST_MISFIT)


def log_evidence(
    residual_m2: Array, noise_m2: Array, overlap_cells: Array, relief: Relief
) -> Array:
    """Return the log Bayes factor of a match over unrelated seabed at each shift."""
    usable = np.isfinite(residual_m2)
    limit = max(relief.background / relief.noise_scale, 1.0)
    noise_m2 = noise_m2 * relief.noise_scale
    error = np.minimum(np.where(usable, residual_m2 / noise_m2, limit), limit)
    scale = np.maximum(error, 1.0)
    gain = np.log(limit / scale) - error / scale + error / limit
    best = max(np.log(limit) - 1.0 + 1.0 / limit, _LEAST_GAIN)
    share = np.minimum(np.maximum(gain, 0.0) / best, 1.0)
    cells = np.minimum(overlap_cells, relief.coherent_cells) - overlap_cells * (1.0 - share)
    return np.where(usable, np.maximum(cells, 0.0) * relief.information_per_cell, -np.inf)


def tempered_evidence(surface: ErrorSurface, relief: Relief, correlated_cells: float) -> Array:
    """Return a cautious log Bayes factor of a match at each shift, for pairs that decide nothing.

    Half of the information that the overlap offers, less the misfit, for which correlated_cells
    cells count as one. Unlike `log_evidence` it makes a larger overlap pay for every cell that
    does not fit, so that its moments stay honest where the relief is faint.
    """
    cells = np.minimum(surface.overlap_cells, relief.coherent_cells)
    misfit = misfit_of(surface, relief.noise_scale, correlated_cells)
    evidence = 0.5 * relief.information_per_cell * cells - misfit
    return np.where(np.isfinite(misfit), np.maximum(evidence, 0.0), -np.inf)


def misfit_of(surface: ErrorSurface, noise_scale: float, correlated_cells: float) -> Array:
    """Return what speaks against each shift, in nats; infinity where there is no overlap."""
    usable = np.isfinite(surface.residual_m2)
    error = np.where(usable, surface.residual_m2, 0.0) / surface.noise_m2 / noise_scale
    nats = surface.overlap_cells * np.maximum(error - 1.0, 0.0) / (2.0 * correlated_cells)
    return np.where(usable, nats, np.inf)


def moments(found: Posterior, prior: Prior) -> tuple[Array, Array]:
    """Return mean (2,) and covariance (2, 2) of the shift; what lies outside is as the prior."""
    north, east = found.north_m - prior.mean_m[0], found.east_m - prior.mean_m[1]
    mean, second = moments_of(found.mass, north, east)
    second += found.outside * prior.covariance_m2
    return prior.mean_m + mean, second - np.outer(mean, mean)


def moments_of(mass: Array, north: Array, east: Array) -> tuple[Array, Array]:
    """Return the first (2,) and second (2, 2) moments about zero of mass (K, L) at (K,), (L,)."""
    by_north, by_east = mass.sum(axis=1), mass.sum(axis=0)
    mean = np.array([by_north @ north, by_east @ east])
    crossed = float(north @ mass @ east)
    return mean, np.array([[by_north @ north**2, crossed], [crossed, by_east @ east**2]])


def posterior(surface: ErrorSurface, evidence: Array, prior: Prior, null_share: float) -> Posterior:
    """Return the probability mass of every shift, and of all that is no shift of the surface.

    The prior is the graph's Gaussian, of which null_share is withheld from all shifts: the pose
    graph may be wrong, and then none of them is right.
    """
    cell_m = float(surface.north_m[1] - surface.north_m[0]) if surface.north_m.size > 1 else 1.0
    spread = prior.covariance_m2 + np.eye(2) * cell_m**2 / 12.0
    square = surface.squares_from(prior.mean_m, spread)
    density = np.exp(-0.5 * np.minimum(square, 1400.0))
    density *= (1.0 - null_share) * cell_m**2 / (2.0 * np.pi * np.sqrt(np.linalg.det(spread)))
    reachable = np.isfinite(evidence) & (density > 0.0)
    elsewhere = max(1.0 - float(density[reachable].sum()), null_share)
    log_mass = np.where(reachable, np.log(np.maximum(density, 1e-300)) + evidence, -np.inf)
    top = max(float(log_mass.max(initial=-np.inf)), np.log(elsewhere))
    mass = np.exp(log_mass - top)
    outside = elsewhere * np.exp(-top)
    total = float(mass.sum()) + outside
    return Posterior(
        north_m=surface.north_m,
        east_m=surface.east_m,
        mass=mass / total,
        outside=outside / total,
    )


def ridge_of(
    surface: ErrorSurface,
    limit: float,
    prior: Prior,
    winner_m: Array,
    axis: Array,
    turned_rad: float = 0.0,
) -> Ridge:
    """Return the line along which shifts keep fitting from the winner, roughly across the axis.

    Of the shifts side by side across the line, the best belongs to the ridge if its misfit is
    within the limit. The line is fitted to as much of the ridge as a prior three times as wide
    allows, since its direction has to hold where the prior is wrong; how far the ridge strays from
    the line is weighted by the prior itself. turned_rad is the sigma of how far what is not known
    of drift turns the one sub-map against the other.
    """
    misfit = surface.misfit
    row, column = np.nonzero(np.isfinite(misfit) & (misfit <= limit))
    if row.size < _LEAST_RIDGE:
        return Ridge(axis=axis, sigma_rad=math.hypot(_UNTRACED_RAD, turned_rad), strayed_m2=0.0)
    cell_m = float(surface.north_m[1] - surface.north_m[0])
    shifts_m = np.stack([surface.north_m[row], surface.east_m[column]])
    from_winner_m = shifts_m - winner_m[:, None]
    line = np.array([-axis[1], axis[0]])
    abreast = np.round(line @ from_winner_m / cell_m)
    order = np.lexsort((misfit[row, column], abreast))
    ridge = order[np.unique(abreast[order], return_index=True)[1]]
    away_m = shifts_m[:, ridge] - prior.mean_m[:, None]
    square = np.sum(away_m * np.linalg.solve(prior.covariance_m2, away_m), axis=0)
    square -= square.min()
    along, across = line @ from_winner_m[:, ridge], axis @ from_winner_m[:, ridge]
    wide = np.exp(-0.5 * square / PRIOR_DOUBTED**2)
    spread_m2 = float(wide @ along**2)
    tilt = float(wide @ (along * across)) / max(spread_m2, cell_m**2)
    off_m = across - tilt * along
    sigma_rad = np.sqrt(float(wide @ off_m**2) / wide.sum() / max(spread_m2, cell_m**2))
    turned = axis - tilt * line
    strayed = float(np.average(off_m**2, weights=np.exp(-0.5 * square)))
    return Ridge(
        axis=turned / np.hypot(*turned),
        sigma_rad=math.hypot(sigma_rad, turned_rad, _RIDGE_SIGMA_RAD),
        strayed_m2=max(strayed - cell_m**2 / 6.0, 0.0),  # which the lattice itself makes
    )


def _falling_with(misfit: Array, shift: int) -> NDArray[np.bool_]:
    """Return the shifts (K, L) from which steepest descent ends where it ends from one of them."""
    rows, columns = misfit.shape
    walled = np.pad(misfit, 1, constant_values=np.inf)
    steps = sorted(itertools.product(range(3), repeat=2), key=lambda step: step != (1, 1))
    around = np.stack([walled[i : i + rows, j : j + columns] for i, j in steps])
    onward = np.array([columns * (i - 1) + j - 1 for i, j in steps])
    here = np.arange(misfit.size)
    lower = here + onward[np.argmin(around, axis=0)].ravel()
    falls = coo_array((np.ones(misfit.size), (here, lower)), shape=2 * (misfit.size,))
    basins = connected_components(falls, directed=False)[1]
    return np.asarray(basins == basins[shift]).reshape(misfit.shape)


def mass_elsewhere(
    found: Posterior, surface: ErrorSurface, winner_m: Array, radius_m: float
) -> MassElsewhere:
    """Return the mass outside the winner's basin, and outside the line through it.

    The basin has all shifts within the radius, and those from which misfit falls to where it falls
    from the winner. That may lie beside it, since the lattice's fit knows no tilt and no drift; how
    far up the slopes the truth may lie is what the match's covariance says.
    """
    north = (found.north_m - winner_m[0])[:, None]
    east = (found.east_m - winner_m[1])[None, :]
    square_m2 = north**2 + east**2
    basin = square_m2 <= radius_m**2
    basin |= _falling_with(surface.misfit, int(np.argmin(square_m2)))
    inside = found.mass[basin]
    crossed = np.sum(found.mass * north * east)
    second = [
        [np.sum(found.mass * north**2), crossed],
        [crossed, np.sum(found.mass * east**2)],
    ]
    _, vectors = np.linalg.eigh(second)
    across = vectors[:, 0]
    off = np.abs(across[0] * north + across[1] * east)
    return MassElsewhere(
        false_mass=1.0 - float(inside.sum()),
        axis_rad=float(np.arctan2(across[1], across[0]) % np.pi),
        false_mass_off_line=1.0 - float(found.mass[off <= radius_m].sum()),
    )
