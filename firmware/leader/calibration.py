"""Each vehicle's roll bias, refraction smile and depth wander, learned from its own overlaps.

A patch test that never ends: where a vehicle crosses its own soundings or runs beside them, and
dead reckoning still knows the way between the two passes, they differ by the sonar's errors. A fit
of depth offset, shift (with the graph's prior) and swath errors gives information on roll and
smile, which is summed recursively and slowly forgotten, because water changes.
"""

from dataclasses import dataclass, replace

import numpy as np

from firmware.geometry import Array
from firmware.leader.alignment import Aligned, NoiseModel, align, fields_of
from firmware.leader.refinement import SETTLED_M, limited
from firmware.leader.screening import prepare, sample
from firmware.leader.swath import Swath
from firmware.submaps import GriddedSubmap
from protocol.settings import Settings, setting

_SMOOTHING_CELLS = 0.5  # of slopes
_ITERATIONS = 4  # the shift's prior keeps the fit near its start


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationSettings(Settings):
    """What swath errors are expected and how fast evidence on them grows."""

    roll_sigma: float = setting(0.005, "rad", "mounting of a sonar head: 0.3 degree", minimum=1e-6)
    smile_sigma: float = setting(
        0.004, "1", "sound speed wrong by 3 m/s, seen at 60 degrees", minimum=1e-6
    )
    opening_deg: float = setting(
        120.0, "deg", "of the sonars, which tells altitude from width", minimum=10.0, maximum=170.0
    )
    wander_m: float = setting(
        0.3, "m", "tide and depth sensor between two distant passes", minimum=0.001
    )
    wander_time_s: float = setting(
        600.0, "s", "tide and depth sensor stay alike for ten minutes", minimum=1.0
    )
    memory_s: float = setting(
        7200.0, "s", "the water's sound speed changes within hours", minimum=60.0
    )
    reach_m: float = setting(
        12.0, "m", "sigma of a shift up to which seabed slopes still speak", minimum=0.1
    )
    redundancy: float = setting(
        30.0, "cells", "that err together: neighbours, and sheets that share soundings", minimum=1.0
    )
    misfit_limit: float = setting(
        3.0, "", "mean square residual over noise of an overlap that can be trusted", minimum=0.1
    )
    minimum_cells: int = setting(80, "cells", "fewer are a corner of the swath", minimum=20)


@dataclass(frozen=True, slots=True, kw_only=True)
class Overlap:
    """Two passes over the same ground; the shift's prior, (2,) and (2, 2), is the graph's.

    A side of a vehicle other than the one being calibrated comes levelled and without a swath.
    """

    reference: GriddedSubmap
    query: GriddedSubmap
    reference_swath: Swath | None
    query_swath: Swath | None
    shift_m: Array
    covariance_m2: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class _Evidence:
    """Information (2, 2) on roll and smile, and its vector (2,)."""

    information: Array
    vector: Array


class Calibration:
    """What is known of one vehicle's swath errors."""

    def __init__(self, settings: CalibrationSettings) -> None:
        self._settings = settings
        self._prior = np.diag([settings.roll_sigma**-2, settings.smile_sigma**-2])
        self._information = np.zeros((2, 2))
        self._vector = np.zeros(2)
        self._time_s: float | None = None

    @property
    def errors(self) -> Array:
        """Expected roll bias in rad and smile, (2,)."""
        return np.asarray(np.linalg.solve(self._information + self._prior, self._vector))

    @property
    def covariance(self) -> Array:
        """Covariance (2, 2) of the errors."""
        return np.asarray(np.linalg.inv(self._information + self._prior))

    def learn(self, overlap: Overlap, noise: NoiseModel, now_s: float) -> bool:
        """Use an overlap if it can be trusted; say whether."""
        if np.linalg.eigvalsh(overlap.covariance_m2)[-1] > self._settings.reach_m**2:
            return False
        found = _evidence_of(overlap, noise, self._settings, self._information + self._prior)
        if found is None:
            return False
        if self._time_s is not None:
            kept = float(np.exp(-max(now_s - self._time_s, 0.0) / self._settings.memory_s))
            self._information, self._vector = self._information * kept, self._vector * kept
        self._time_s = now_s if self._time_s is None else max(now_s, self._time_s)
        self._information = self._information + found.information
        self._vector = self._vector + found.vector
        return True


def _evidence_of(
    overlap: Overlap, noise: NoiseModel, settings: CalibrationSettings, known: Array
) -> _Evidence | None:
    """Return the information that an overlap adds once shift and offset are marginalised."""
    reference = prepare(_pure(overlap.reference, overlap.reference_swath))
    query = prepare(_pure(overlap.query, overlap.query_swath))
    if reference is None or query is None:
        return None
    fields = fields_of(reference, _SMOOTHING_CELLS), fields_of(query, _SMOOTHING_CELLS)
    tracks = (
        _basis(overlap.reference_swath, overlap.reference, reference.grid),
        _basis(overlap.query_swath, overlap.query, query.grid),
    )
    inverse = np.linalg.inv(overlap.covariance_m2)
    shift = np.array(overlap.shift_m, dtype=np.float64)
    for _ in range(_ITERATIONS):
        field = align(reference, query, fields, shift, noise)
        if field is None or field.cells < settings.minimum_cells:
            return None
        swath = (sample(tracks[0], field.at) - tracks[1][:, *field.at.query])[:, field.both]
        system = _system(field, swath, settings)
        system.normal[:2, :2] += inverse
        system.right[:2] += inverse @ (shift - overlap.shift_m)
        unknowns = system.solved(known)
        shift = shift - limited(unknowns[:2])
        if np.hypot(*unknowns[:2]) < SETTLED_M:
            break
    misfit = system.misfit(unknowns)
    if not misfit <= settings.misfit_limit:
        return None
    return system.evidence(max(misfit, 1.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class _System:
    """Normal equations of shift, offset, roll and smile (5), and what they were made from."""

    design: Array  # (5, N)
    weight: Array  # (N,)
    difference_m: Array  # (N,)
    normal: Array
    right: Array
    redundancy: float

    def solved(self, known: Array) -> Array:
        """Return the unknowns, with what is already known of roll and smile (2, 2)."""
        damped = self.normal.copy()
        damped[3:, 3:] += known
        return np.asarray(np.linalg.solve(damped, self.right))

    def misfit(self, unknowns: Array) -> float:
        """Return the mean of squared normalised residuals."""
        residual = self.difference_m - unknowns @ self.design
        return float(self.redundancy * np.mean(self.weight * residual**2))

    def evidence(self, misfit: float) -> _Evidence:
        """Return what is left for roll and smile when shift and offset are marginalised."""
        gain = np.linalg.solve(self.normal[:3, :3], self.normal[:3, 3:])
        return _Evidence(
            information=(self.normal[3:, 3:] - self.normal[3:, :3] @ gain) / misfit,
            vector=(self.right[3:] - gain.T @ self.right[:3]) / misfit,
        )


def _system(field: Aligned, swath: Array, settings: CalibrationSettings) -> _System:
    slope = 0.5 * (field.smooth_r + field.smooth_q)
    design = np.concatenate([slope, field.basis[:1], swath])
    weight = 1.0 / (field.variance_m2 * settings.redundancy)
    normal = (design * weight) @ design.T
    normal[2, 2] += settings.wander_m**-2
    return _System(
        design=design,
        weight=weight,
        difference_m=field.difference_m,
        normal=normal,
        right=(design * weight) @ field.difference_m,
        redundancy=settings.redundancy,
    )


def _pure(grid: GriddedSubmap, swath: Swath | None) -> GriddedSubmap:
    """Return the grid where its across-track distance means something, its variance whole."""
    depth_m = grid.depth_m if swath is None else np.where(swath.pure, grid.depth_m, np.nan)
    return replace(grid, depth_m=depth_m, reconstructed=False)


def _basis(swath: Swath | None, grid: GriddedSubmap, cropped: GriddedSubmap) -> Array:
    """Return the part of a grid's basis that a crop of it covers; zero without a swath."""
    rows, columns = cropped.depth_m.shape
    if swath is None:
        return np.zeros((2, rows, columns))
    row = round((cropped.north0_m - grid.north0_m) / grid.cell_m)
    column = round((cropped.east0_m - grid.east0_m) / grid.cell_m)
    return swath.basis[:, row : row + rows, column : column + columns]
