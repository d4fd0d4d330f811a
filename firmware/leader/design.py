"""What may explain how two aligned sub-maps differ, and the fit of it by weighted least squares."""

from dataclasses import dataclass

import numpy as np

from firmware.geometry import Array
from firmware.leader.alignment import Aligned, NoiseModel

_UNKNOWN_MPS = 1e-4  # least sigma of a drift: two millimetres at the ends of a sub-map


@dataclass(frozen=True, slots=True, kw_only=True)
class Design:
    """Columns (p, N) by unknown, and their Gaussian prior: information (p, p) and its vector (p,).

    The columns are made of smooth slopes: a fit is consistent where it says of the shift that it is
    right, and `curvature` tells what a change of the unknowns does. The unknowns are how far the
    shift (2,) is too large, the drift (2,) of the reference and of the query, and those of depth
    offset, tilt and bend whose sigma is not zero, in this order.
    """

    columns: Array
    information: Array
    vector: Array


def design_of(field: Aligned, noise: NoiseModel) -> Design:
    """Return the design of an overlap.

    The shift has no prior of its own: only what it implies of the drifts speaks of it.
    """
    nuisances = [
        (field.basis[:1], noise.offset_sigma_m),
        (field.basis[1:3], noise.tilt_sigma),
        (field.basis[3:], noise.bend_sigma_per_m),
    ]
    active = [(columns, sigma) for columns, sigma in nuisances if sigma > 0.0]
    still = np.concatenate([np.empty((0, field.cells)), *(columns for columns, _ in active)])
    slope = 0.5 * (field.smooth_r + field.smooth_q)
    drift_information, drift_vector = _of_drifts(field, noise)
    own = [1.0 / sigma**2 for columns, sigma in active for _ in columns]
    information = np.diag(np.concatenate([np.zeros(6), own]))
    information[:6, :6] = drift_information
    return Design(
        columns=np.concatenate([_moved(slope, field), still]),
        information=information,
        vector=np.concatenate([drift_vector, np.zeros(len(own))]),
    )


def _moved(slope: Array, field: Aligned) -> Array:
    """Return the columns (6, N) of shift and drifts by the slopes (2, N)."""
    first, second = field.spans
    return np.concatenate([slope, -slope * first.age_s, slope * second.age_s])


def curvature(field: Aligned, design: Design) -> Array:
    """Return how the weighted differences change with the unknowns, (p, p).

    Smooth slopes of each grid meet slopes of the other, whose noise is independent: noise makes no
    information then, nor does smoothing take any away. They are instrumental variables for them
    (Wooldridge, Econometric Analysis of Cross Section and Panel Data, chapter 5).
    """
    still, weight = design.columns[6:], 1.0 / field.variance_m2
    pairs = ((field.smooth_r, field.slope_q), (field.smooth_q, field.slope_r))
    halves = [
        (np.concatenate([_moved(smooth, field), still]) * weight)
        @ np.concatenate([_moved(slope, field), still]).T
        for smooth, slope in pairs
    ]
    both = 0.5 * (halves[0] + halves[1])
    return np.asarray(0.5 * (both + both.T))


def _of_drifts(field: Aligned, noise: NoiseModel) -> tuple[Array, Array]:
    """Return information (6, 6) and vector (6,) that both drifts are those that the shift implies.

    A shift too large by u implies the drifts gain (shift - u - mean).
    """
    coupling, (first, second) = noise.coupling, field.spans
    gain, left = coupling.drifts_at((first.mean_s, second.mean_s))
    alone = max(noise.drift_sigma_mps, _UNKNOWN_MPS)
    implied = np.hstack([gain, np.eye(4)])
    weighted = implied.T @ np.linalg.inv(left + alone**2 * np.eye(4))
    return weighted @ implied, weighted @ gain @ (field.shift_m - coupling.mean_m)


def solve(field: Aligned, design: Design) -> Array:
    """Return the unknowns (p,) that explain the difference."""
    weighted = design.columns / field.variance_m2
    information = weighted @ design.columns.T + design.information
    information[:2, :2] += np.eye(2) * 1e-9
    return np.asarray(np.linalg.solve(information, weighted @ field.difference_m + design.vector))
