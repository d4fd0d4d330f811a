"""What the offset of two sub-maps tells of their drifts, and matching that makes use of it.

Cells of a sub-map are older or younger than its middle, and drift strains it. A shift far from the
expected one implies another drift than the expected one, and has to be judged with sub-maps from
which that other drift was taken.
"""

import dataclasses
import itertools
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from firmware.geometry import Array
from firmware.leader.alignment import Coupling
from firmware.leader.ambiguity import Prior
from firmware.leader.pair_problem import PairProblem
from firmware.leader.screening import ErrorSurface
from firmware.leader.warping import remove_drift
from firmware.submaps import GriddedSubmap

SUBMAP_S = 40.0  # in which a sub-map is measured
AGE_S = SUBMAP_S / np.sqrt(12.0)  # of the cells of a sub-map, root mean square
_REACH_SIGMAS = 2.5  # of the prior, beyond which the outermost drift has to do
_APART_M = 3.0  # cells of two sub-maps, between one drift and the next
_MOST_EACH_WAY = 3  # of drifts along an axis, beside the expected one
_ROUNDED_M = 0.8  # between cells of two sub-maps, each to the nearest of two metres

_FIELDS = ("residual_m2", "noise_m2", "overlap_cells", "depth_offset_m")
_NO_OVERLAP = np.array([np.inf, 1.0, 0.0, 0.0])  # in the same order


@dataclass(frozen=True, slots=True, kw_only=True)
class Drifts:
    """How well the drifts of two sub-maps are known, and what their offset would tell of them.

    gain (4, 2) is how much they change, the origin's first, per metre of offset beyond expected_m
    (2,), beside which they are what the estimate says; left (4, 4) in (m/s)^2 is their covariance
    once the offset is known.
    """

    gain: Array
    left: Array
    expected_m: Array = field(default_factory=lambda: np.zeros(2))

    def covariance(self, offset_m2: Array) -> Array:
        """Return their covariance (4, 4) in (m/s)^2 where the offset is known to (2, 2)."""
        return np.asarray(self.left + self.gain @ offset_m2 @ self.gain.T)

    def coupling(self, prior: Prior, reference: GriddedSubmap, query: GriddedSubmap) -> Coupling:
        """Return how the shift of two grids goes with the drifts that were not taken out of them.

        The prior is that of the shift between the middles of their times.
        """
        told = self.gain @ prior.covariance_m2
        return Coupling(
            mean_m=self.expected_m,
            covariance=np.block(
                [[prior.covariance_m2, told.T], [told, self.covariance(prior.covariance_m2)]]
            ),
            times_s=(_middle_s(reference), _middle_s(query)),
        )

    def unresolved_m(self, offset_m2: Array) -> float:
        """Return how far cells may still lie apart when every shift has the nearest drift."""
        reaches_m = [self._reach_m(direction) for direction in _directions(offset_m2)]
        steps = [max(_each_way(reach_m), 0.5) for reach_m in reaches_m]
        spacings_m = [reach_m / step for reach_m, step in zip(reaches_m, steps, strict=True)]
        coarse_m = max(spacings_m) / np.sqrt(12.0)
        return float(coarse_m if max(steps) < 1.0 else np.hypot(coarse_m, _ROUNDED_M))

    def steps_m(self, offset_m2: Array) -> list[Array]:
        """Return vectors (S, 2) along both axes of an offset, each implying a drift of its own."""
        steps = []
        for direction in _directions(offset_m2):
            each_way = _each_way(self._reach_m(direction))
            parts = np.arange(-each_way, each_way + 1) / max(each_way, 1)
            steps.append(np.outer(parts, direction))
        return steps

    def _reach_m(self, direction_m: Array) -> float:
        """Return how far drift drives cells apart when an offset lies so far from the expected."""
        drifts_mps = self.gain @ direction_m
        return float(AGE_S * (np.hypot(*drifts_mps[:2]) + np.hypot(*drifts_mps[2:])))


NO_DRIFT = Drifts(gain=np.zeros((4, 2)), left=np.zeros((4, 4)))


def screened_by_drift(
    problem: PairProblem,
    surface: ErrorSurface,
    grids: tuple[GriddedSubmap, GriddedSubmap],
    drifts: Drifts,
    prior: Prior,
) -> ErrorSurface:
    """Return a surface with E at every lattice shift for the drift that the shift implies.

    The expected drift has been taken out of both grids, reference and query. `surface` is theirs,
    or a window of it, and is returned as it is where that drift serves for all shifts that the
    prior allows.
    """
    steps_m = drifts.steps_m(prior.covariance_m2)
    if all(len(steps) == 1 for steps in steps_m):
        return surface
    fields = _fields(surface)
    shifts_m = np.stack(np.meshgrid(surface.north_m, surface.east_m, indexing="ij"), axis=-1)
    nearest = [_nearest(shifts_m - prior.mean_m, steps) for steps in steps_m]
    for i, j in itertools.product(range(len(steps_m[0])), range(len(steps_m[1]))):
        change_mps = drifts.gain @ (steps_m[0][i] + steps_m[1][j])
        wanted = (nearest[0] == i) & (nearest[1] == j)
        if np.any(change_mps) and wanted.any():
            part = problem.surface_of(
                _without(grids[0], change_mps[:2]), _without(grids[1], change_mps[2:])
            )
            _fill(fields, surface, part, wanted)
    return dataclasses.replace(surface, **dict(zip(_FIELDS, fields, strict=True)))


def _directions(offset_m2: Array) -> Array:
    """Return the vectors (2, 2) to the edge of what is likely, along the axes of a covariance."""
    values, axes = np.linalg.eigh(offset_m2)
    return np.asarray(_REACH_SIGMAS * np.sqrt(np.maximum(values, 0.0))[:, None] * axes.T)


def _each_way(reach_m: float) -> int:
    return min(int(np.ceil(reach_m / _APART_M - 0.5)), _MOST_EACH_WAY)


def _nearest(away_m: Array, steps_m: Array) -> Array:
    """Return which of the steps (S, 2) along one axis is nearest to each shift (K, L, 2)."""
    longest_m = float(np.hypot(*steps_m[-1]))
    if longest_m == 0.0:
        return np.zeros(away_m.shape[:2], dtype=np.intp)
    axis = steps_m[-1] / longest_m
    return np.asarray(np.abs((away_m @ axis)[..., None] - steps_m @ axis).argmin(axis=-1))


def _without(grid: GriddedSubmap, drift_mps: Array) -> GriddedSubmap:
    """Return a grid warped anew. Its cells are not averaged: else any other drift fitted better."""
    return remove_drift(
        grid, float(drift_mps[0]), float(drift_mps[1]), _middle_s(grid), nearest=True
    )


def _middle_s(grid: GriddedSubmap) -> float:
    known_s = grid.time_s[np.isfinite(grid.time_s)]
    return float(np.median(known_s)) if known_s.size else 0.0


def _fields(surface: ErrorSurface) -> Array:
    """Return what a surface says of its shifts, (4, K, L)."""
    return np.stack([getattr(surface, name) for name in _FIELDS])


def _fill(
    fields: Array, surface: ErrorSurface, part: ErrorSurface | None, wanted: NDArray[np.bool_]
) -> None:
    """Write a surface into fields (4, K, L) on the lattice of another, where it is wanted."""
    fields[:, wanted] = _NO_OVERLAP[:, None]
    if part is None:
        return
    row, column = np.nonzero(wanted)
    cell_m = float(surface.north_m[1] - surface.north_m[0])
    part_row = row + round((surface.north_m[0] - part.north_m[0]) / cell_m)
    part_column = column + round((surface.east_m[0] - part.east_m[0]) / cell_m)
    inside = (part_row >= 0) & (part_row < part.north_m.size)
    inside &= (part_column >= 0) & (part_column < part.east_m.size)
    values = _fields(part)[:, part_row[inside], part_column[inside]]
    fields[:, row[inside], column[inside]] = values
