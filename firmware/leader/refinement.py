"""The sub-cell optimum of one candidate shift, by Gauss-Newton over shift and nuisances."""

import numpy as np

from firmware.geometry import Array
from firmware.leader.alignment import Aligned, NoiseModel, align, design_of
from firmware.leader.screening import Layer

_ITERATIONS = 8  # from the lattice's best cell it settles in three to five
_SETTLED_M = 0.02  # a tenth of the best sigma
_LONGEST_STEP_M = 3.0  # gradients are not believed further than their smoothing


def refine(
    reference: Layer,
    query: Layer,
    fields: tuple[Array, Array],
    start_m: Array,
    noise: NoiseModel,
) -> Aligned | None:
    """Return the overlap at the optimum near `start_m`, None where the fit leaves it or diverges.

    The shift refers to the mean times of the overlap, where the fit is best determined.
    """
    shift = np.array(start_m, dtype=np.float64)
    for _ in range(_ITERATIONS):
        field = align(reference, query, fields, shift, noise)
        if field is None:
            return None
        unknowns = solve(field, *design_of(field, noise))
        step = -unknowns[:2]
        length = float(np.hypot(*step))
        if not np.isfinite(length):
            return None
        shift = shift + step * min(1.0, _LONGEST_STEP_M / max(length, 1e-12))
        if length < _SETTLED_M:
            break
    if np.hypot(*(shift - start_m)) > 4.0 * reference.grid.cell_m + _LONGEST_STEP_M:
        return None
    return align(reference, query, fields, shift, noise)


def solve(field: Aligned, columns: Array, prior: Array) -> Array:
    """Return the unknowns (p,) that explain the difference."""
    design = columns.reshape(columns.shape[0], -1)
    weighted = design * field.weight.ravel()
    information = weighted @ design.T + np.diag(prior)
    information[:2, :2] += np.eye(2) * 1e-9
    return np.asarray(np.linalg.solve(information, weighted @ field.difference_m.ravel()))
