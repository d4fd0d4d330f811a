"""The sub-cell optimum of one candidate shift, by Gauss-Newton over shift and nuisances."""

import numpy as np

from firmware.geometry import Array
from firmware.leader.alignment import Aligned, NoiseModel, align
from firmware.leader.design import design_of, solve
from firmware.leader.screening import Layer

_ITERATIONS = 8  # from the lattice's best cell it settles in four to six
SETTLED_M = 0.05  # an eighth of the strain that no match can see
_FARTHEST = 4.0  # of a step: how far it may be believed to lead on
_LONGEST_STEP_M = 3.0  # gradients are not believed further than their smoothing


def refine(
    reference: Layer,
    query: Layer,
    fields: tuple[Array, Array],
    start_m: Array,
    noise: NoiseModel,
) -> Aligned | None:
    """Return the overlap at the optimum near `start_m`, None where the fit leaves it or diverges.

    The shift refers to the mean times of the overlap, where the fit is best determined. Noise in
    the slopes makes steps too short, by about a half and always alike: Anderson's acceleration of
    depth one (J. ACM 12, 1965) sees that in two of them and goes all the way.
    """
    shift, last, moved = np.array(start_m, dtype=np.float64), None, np.zeros(2)
    for _ in range(_ITERATIONS):
        field = align(reference, query, fields, shift, noise)
        if field is None:
            return None
        unknowns = solve(field, design_of(field, noise))
        step = -unknowns[:2]
        length = float(np.hypot(*step))
        if not np.isfinite(length):
            return None
        moved = limited(step if last is None else _accelerated(step, last, moved))
        shift, last = shift + moved, step
        if length < SETTLED_M:
            break
    if np.hypot(*(shift - start_m)) > 4.0 * reference.grid.cell_m + _LONGEST_STEP_M:
        return None
    return align(reference, query, fields, shift, noise)


def _accelerated(step: Array, last: Array, moved: Array) -> Array:
    """Return where the last step and this one, with the move between them, lead, (2,)."""
    change = step - last
    share = float(change @ step) / max(float(change @ change), 1e-12)
    return np.asarray(step - np.clip(share, 1.0 - _FARTHEST, 0.5) * (change + moved))


def limited(move_m: Array) -> Array:
    """Return a move (2,) no longer than gradients are believed."""
    return np.asarray(move_m * min(1.0, _LONGEST_STEP_M / max(float(np.hypot(*move_m)), 1e-12)))
