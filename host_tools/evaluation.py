"""How good a mission was: errors of trajectories, closures and map against the truth."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware.geometry import Array
from host_tools.mapping import DepthMap, displaced_sigma_m
from host_tools.registration import (
    RegistrationError,
    TileShifts,
    registration_error,
    tile_shifts,
)
from host_tools.results import (
    STAGES,
    ClosureResult,
    MissionResult,
    SoundingPatch,
    VehicleResult,
)

VALID_CLOSURE_M = 5.0
FILL_M = 1.5  # half the diagonal of the 2 m cells that soundings are kept in


@dataclass(frozen=True, slots=True, kw_only=True)
class TrajectoryErrors:
    """Unaligned horizontal errors over the whole mission, or the part of it that is named.

    share_of_dead_reckoning is mean over mean; percent_of_distance is the mean error relative to
    the distance travelled meanwhile.
    """

    mean_m: float
    rmse_m: float
    max_m: float
    end_m: float
    share_of_dead_reckoning: float
    percent_of_distance: float
    nees: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleErrors:
    """One vehicle's errors by kind of estimate."""

    distance_m: float
    live: TrajectoryErrors
    final: TrajectoryErrors
    dead_reckoning: TrajectoryErrors
    live_during_survey: TrajectoryErrors


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgedClosure:
    """A closure beside the truth; error_m is along the axis for a one-axis closure."""

    closure: ClosureResult
    true_north_m: float
    true_east_m: float
    error_m: float

    @property
    def is_valid(self) -> bool:
        """Whether it is right within 5 m."""
        return self.error_m <= VALID_CLOSURE_M


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """Everything that the outputs and the report say about a mission."""

    vehicles: Mapping[str, VehicleErrors]
    closures: Sequence[JudgedClosure]
    map_depth_m: Array
    map_sigma_m: Array
    truth_depth_m: Array
    truth_sigma_m: Array
    registration: RegistrationError
    tiles: TileShifts


def evaluate(result: MissionResult) -> Evaluation:
    """Return the evaluation of a mission; draws the leader's map on the way."""
    drawn = draw_map(result.patches, result.vehicles, DepthMap(result.site.window))
    map_m, sigma_m = drawn.grids(FILL_M)
    truth_m, truth_sigma_m = result.truth_map.grids(FILL_M)
    window = result.site.window
    sigma_m = displaced_sigma_m(map_m, sigma_m, _position_m2(result), window)
    return Evaluation(
        vehicles={
            vehicle.name: vehicle_errors(vehicle, result.scenario.survey_s(vehicle.vehicle))
            for vehicle in result.vehicles
        },
        closures=judge_closures(result.closures, result.vehicles),
        map_depth_m=map_m,
        map_sigma_m=sigma_m,
        truth_depth_m=truth_m,
        truth_sigma_m=truth_sigma_m,
        registration=registration_error(map_m, truth_m),
        tiles=tile_shifts(map_m, truth_m, window.cell_north_m, window.cell_east_m),
    )


def _position_m2(result: MissionResult) -> Array:
    """Return the mean covariance (2, 2) of where the final estimate has its soundings."""
    told = [
        vehicle.final_covariance_m2[
            vehicle.truth.time_s <= result.scenario.survey_s(vehicle.vehicle)
        ]
        for vehicle in result.vehicles
        if vehicle.final_covariance_m2 is not None
    ]
    known = [c for covariances in told for c in covariances if np.isfinite(c).all()]
    return np.mean(known, axis=0) if known else np.zeros((2, 2))


def vehicle_errors(vehicle: VehicleResult, survey_s: float) -> VehicleErrors:
    """Return the errors of one vehicle's estimates."""
    truth_m = vehicle.truth.position_m
    sailed_m = np.hypot(*np.diff(truth_m, axis=0, prepend=truth_m[:1]).T)
    reckoned_m = np.hypot(*(vehicle.dead_reckoning_m - truth_m).T)
    during = vehicle.truth.time_s <= survey_s

    def errors(
        estimate_m: Array,
        covariance_m2: Array | None,
        used: NDArray[np.bool_] | slice = slice(None),
    ) -> TrajectoryErrors:
        return _trajectory_errors(
            (estimate_m - truth_m)[used],
            None if covariance_m2 is None else covariance_m2[used],
            reckoned_m[used],
            float(sailed_m[used].sum()),
        )

    return VehicleErrors(
        distance_m=float(sailed_m.sum()),
        live=errors(vehicle.live_m, vehicle.live_covariance_m2),
        final=errors(vehicle.final_m, vehicle.final_covariance_m2),
        dead_reckoning=errors(vehicle.dead_reckoning_m, None),
        live_during_survey=errors(vehicle.live_m, vehicle.live_covariance_m2, during),
    )


def _trajectory_errors(
    error_m: Array, covariance_m2: Array | None, reckoned_m: Array, distance_m: float
) -> TrajectoryErrors:
    length_m = np.hypot(*error_m.T)
    reckoned_mean_m = float(reckoned_m.mean())
    return TrajectoryErrors(
        mean_m=float(length_m.mean()),
        rmse_m=float(np.sqrt(np.mean(length_m**2))),
        max_m=float(length_m.max()),
        end_m=float(length_m[-1]),
        share_of_dead_reckoning=_ratio(float(length_m.mean()), reckoned_mean_m),
        percent_of_distance=100.0 * _ratio(float(length_m.mean()), distance_m),
        nees=None if covariance_m2 is None else mean_nees(error_m, covariance_m2),
    )


def mean_nees(error_m: Array, covariance_m2: Array) -> float | None:
    """Return the time average of e' P^-1 e over the known covariances (2 when they are honest)."""
    finite = np.isfinite(np.column_stack([error_m, covariance_m2.reshape(-1, 4)])).all(axis=1)
    determinant_m4 = np.linalg.det(np.where(np.reshape(finite, (-1, 1, 1)), covariance_m2, 0.0))
    known = np.flatnonzero(finite & (determinant_m4 > 1e-12))
    if known.size == 0:
        return None
    weighted = np.linalg.solve(covariance_m2[known], error_m[known][:, :, None])[:, :, 0]
    return float(np.mean(np.sum(error_m[known] * weighted, axis=1)))


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole > 0.0 else float("nan")


def judge_closures(
    closures: Iterable[ClosureResult], vehicles: Sequence[VehicleResult]
) -> list[JudgedClosure]:
    """Return the closures beside the true displacement of the states that they link."""
    truths = {vehicle.vehicle: vehicle.truth for vehicle in vehicles}
    judged = []
    for closure in closures:
        from_m = truths[closure.from_vehicle].position_at(closure.from_time_s)
        true_m = truths[closure.to_vehicle].position_at(closure.to_time_s) - from_m
        error_m = np.array([closure.measured_north_m, closure.measured_east_m]) - true_m
        if closure.axis_deg is None:
            size_m = float(np.hypot(*error_m))
        else:
            axis_rad = np.radians(closure.axis_deg)
            size_m = float(abs(error_m @ [np.cos(axis_rad), np.sin(axis_rad)]))
        judged.append(
            JudgedClosure(
                closure=closure,
                true_north_m=float(true_m[0]),
                true_east_m=float(true_m[1]),
                error_m=size_m,
            )
        )
    return judged


def draw_map(
    patches: Iterable[SoundingPatch], vehicles: Sequence[VehicleResult], canvas: DepthMap
) -> DepthMap:
    """Return the canvas with every patch moved from raw dead reckoning to the final trajectory."""
    corrections = {
        vehicle.vehicle: (vehicle.truth.time_s, vehicle.final_m - vehicle.dead_reckoning_m)
        for vehicle in vehicles
    }
    for patch in patches:
        time_s, correction_m = corrections[patch.vehicle]
        moved_m = np.stack(
            [
                patch.north_m + np.interp(patch.time_s, time_s, correction_m[:, 0]),
                patch.east_m + np.interp(patch.time_s, time_s, correction_m[:, 1]),
                patch.depth_m,
            ],
            axis=1,
        )
        canvas.add(moved_m, patch.variance_m2)
    return canvas


def closure_counts(closures: Sequence[JudgedClosure]) -> dict[str, dict[str, float]]:
    """Return number, valid ones and their share: of each stage reached, and of active closures."""
    counts = {}
    for rank, stage in enumerate(STAGES):
        reached = [c for c in closures if STAGES.index(c.closure.stage) >= rank]
        counts[stage] = _count(reached)
    counts["active"] = _count([c for c in closures if c.closure.active_at_end])
    return counts


def _count(closures: Sequence[JudgedClosure]) -> dict[str, float]:
    valid = sum(closure.is_valid for closure in closures)
    return {
        "number": len(closures),
        "valid": valid,
        "valid_share": _ratio(valid, len(closures)),
        "one_axis": sum(closure.closure.axis_deg is not None for closure in closures),
    }


def as_plain(value: object) -> object:
    """Return dataclasses as dictionaries, NaN as None: what JSON can hold."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in dataclasses.fields(value)]
        return {name: as_plain(getattr(value, name)) for name in names}
    if isinstance(value, Mapping):
        return {str(key): as_plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [as_plain(item) for item in value]
    if isinstance(value, np.generic):
        return as_plain(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
