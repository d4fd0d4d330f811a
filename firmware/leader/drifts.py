"""What the offset of two sub-maps tells of their drifts, and a match in which it does.

Cells of a sub-map are older or younger than its middle, and drift strains it. What ran away farther
than expected has drifted faster: a shift far from the expected one says by how much, and is to be
judged with sub-maps from which that drift was taken.
"""

import dataclasses
import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware.geometry import Array
from firmware.leader.ambiguity import Prior
from firmware.leader.pair_problem import PairProblem
from firmware.leader.screening import ErrorSurface
from firmware.leader.warping import remove_drift
from firmware.submaps import GriddedSubmap

AGE_S = 40.0 / np.sqrt(12.0)  # of the cells of a sub-map, root mean square
_REACH_SIGMAS = 2.5  # of the prior, beyond which the outermost drift has to do
_APART_M = 3.0  # cells of two sub-maps, between one drift and the next: a cell off at the most
UNRESOLVED_M = _APART_M / np.sqrt(12.0)
_MOST = 7  # drifts along an axis; an odd number, so that the expected one is among them

_FIELDS = ("residual_m2", "noise_m2", "overlap_cells", "depth_offset_m")
_NO_OVERLAP = np.array([np.inf, 1.0, 0.0, 0.0])  # in the same order


@dataclass(frozen=True, slots=True, kw_only=True)
class Drifts:
    """How well the drifts of two sub-maps are known, and what their offset would tell of them.

    gain (4, 2) is by how much they grow, the origin's first, for each metre that the offset is more
    than expected; left (4, 4) in (m/s)^2 is their covariance once the offset is known.
    """

    gain: Array
    left: Array

    def covariance(self, offset_m2: Array) -> Array:
        """Return their covariance (4, 4) in (m/s)^2 where the offset is known to (2, 2)."""
        return np.asarray(self.left + self.gain @ offset_m2 @ self.gain.T)


NO_DRIFT = Drifts(gain=np.zeros((4, 2)), left=np.zeros((4, 4)))


def screened_by_drift(
    problem: PairProblem,
    grids: tuple[GriddedSubmap, GriddedSubmap],
    drifts: Drifts,
    prior: Prior,
) -> ErrorSurface | None:
    """Return E at every lattice shift, each with the drift taken out that the shift implies.

    The grids of reference and query come without the drift that is expected. None where that
    drift serves for all shifts that the prior leaves.
    """
    values, axes = np.linalg.eigh(prior.covariance_m2)
    steps = [_steps(drifts.gain @ axes[:, k], float(np.sqrt(values[k]))) for k in (0, 1)]
    if len(steps[0]) * len(steps[1]) == 1:
        return None
    whole = problem.surface()
    shifts_m = np.stack(np.meshgrid(whole.north_m, whole.east_m, indexing="ij"), axis=-1)
    along_m = (shifts_m - prior.mean_m) @ axes
    nearest = [np.abs(along_m[..., k, None] - steps[k]).argmin(axis=-1) for k in (0, 1)]
    fields = _fields(whole)
    for i, j in itertools.product(range(len(steps[0])), range(len(steps[1]))):
        change_mps = drifts.gain @ axes @ np.array([steps[0][i], steps[1][j]])
        wanted = (nearest[0] == i) & (nearest[1] == j)
        if np.any(change_mps) and wanted.any():
            part = problem.surface_of(
                _without(grids[0], change_mps[:2]), _without(grids[1], change_mps[2:])
            )
            _fill(fields, whole, part, wanted)
    return dataclasses.replace(whole, **dict(zip(_FIELDS, fields, strict=True)))


def _steps(gain: Array, sigma_m: float) -> Array:
    """Return shifts (S,) along an axis, about the expected one, at which drift is taken anew."""
    apart_m = _REACH_SIGMAS * sigma_m * AGE_S * float(np.hypot(*gain[:2]) + np.hypot(*gain[2:]))
    each_way = min(int(np.ceil(apart_m / _APART_M - 0.5)), _MOST // 2)
    if each_way <= 0:
        return np.zeros(1)
    return np.asarray(_REACH_SIGMAS * sigma_m * np.arange(-each_way, each_way + 1) / each_way)


def _without(grid: GriddedSubmap, drift_mps: Array) -> GriddedSubmap:
    middle_s = float(np.nanmedian(grid.time_s))
    return remove_drift(grid, float(drift_mps[0]), float(drift_mps[1]), middle_s)


def _fields(surface: ErrorSurface) -> Array:
    """Return what a surface says of its shifts, (4, K, L)."""
    return np.stack([getattr(surface, name) for name in _FIELDS])


def _fill(
    fields: Array, whole: ErrorSurface, part: ErrorSurface | None, wanted: NDArray[np.bool_]
) -> None:
    """Write a surface into fields (4, K, L) on the lattice of the whole, where it is wanted."""
    fields[:, wanted] = _NO_OVERLAP[:, None]
    if part is None:
        return
    row, column = np.nonzero(wanted)
    cell_m = float(whole.north_m[1] - whole.north_m[0])
    part_row = row + round((whole.north_m[0] - part.north_m[0]) / cell_m)
    part_column = column + round((whole.east_m[0] - part.east_m[0]) / cell_m)
    inside = (part_row >= 0) & (part_row < part.north_m.size)
    inside &= (part_column >= 0) & (part_column < part.east_m.size)
    values = _fields(part)[:, part_row[inside], part_column[inside]]
    fields[:, row[inside], column[inside]] = values
