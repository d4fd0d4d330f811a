"""Where in the swath each cell of a sub-map was measured, and what sonar errors make of it.

A roll bias tilts every swath about its track, a wrong sound speed bends it (the refraction smile):
depths err by roll * y + smile * y^2 / W at the across-track distance y of a swath of half width W.
Both belong to a vehicle, and are the same on all of its lines.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

from firmware.geometry import Array
from firmware.submaps import GriddedSubmap, Track

_EDGE = 0.98  # quantile of |y| taken for the half width: single outer beams do not make it
_PURE_SHARE = 0.06  # of the half width; cells farther fore or aft were seen from several headings


@dataclass(frozen=True, slots=True, kw_only=True)
class Swath:
    """Across-track geometry of a grid: basis (2, R, C) is y and y^2 / W, zero where unknown.

    pure (R, C) is False where soundings of several headings were averaged (in a turn), so that
    y means little.
    """

    basis: Array
    pure: Array
    half_width_m: float


def swath_of(grid: GriddedSubmap, track: Track, drift_mps: Array, time_s: float) -> Swath:
    """Return the geometry of a grid whose drift (2,) was taken out about `time_s`."""
    basis = np.zeros((2, *grid.depth_m.shape))
    pure = np.zeros(grid.depth_m.shape, dtype=bool)
    known = np.isfinite(grid.depth_m) & np.isfinite(grid.time_s)
    if not known.any():
        return Swath(basis=basis, pure=pure, half_width_m=1.0)
    row, column = np.nonzero(known)
    measured_s = grid.time_s[known]
    here_m = track.position_at(measured_s) - np.multiply.outer(measured_s - time_s, drift_mps)
    north_m = grid.north0_m + grid.cell_m * row - here_m[:, 0]
    east_m = grid.east0_m + grid.cell_m * column - here_m[:, 1]
    yaw_rad = np.interp(measured_s, track.time_s, np.unwrap(track.yaw_rad))
    sin, cos = np.sin(yaw_rad), np.cos(yaw_rad)
    across_m = cos * east_m - sin * north_m
    half_width_m = max(float(np.quantile(np.abs(across_m), _EDGE)), grid.cell_m)
    across_m = np.clip(across_m, -half_width_m, half_width_m)
    basis[0, row, column] = across_m
    basis[1, row, column] = across_m**2 / half_width_m
    along_m = np.abs(cos * north_m + sin * east_m)
    pure[row, column] = along_m < _PURE_SHARE * half_width_m + grid.cell_m
    return Swath(basis=basis, pure=pure, half_width_m=half_width_m)


def levelled(grid: GriddedSubmap, swath: Swath, errors: Array) -> GriddedSubmap:
    """Return the grid without the depth errors of roll and smile (2,)."""
    return dataclasses.replace(
        grid, depth_m=grid.depth_m - np.tensordot(errors, swath.basis, axes=1)
    )
