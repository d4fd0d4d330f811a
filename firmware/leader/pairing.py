"""A pair of sub-maps made ready for its match: drift, roll bias and smile taken out of both.

What calibration does not know yet of the pair's swath errors, and how far tide and depth sensor
may have wandered between the passes, goes into the match as prior sigmas.
"""

from dataclasses import dataclass

import numpy as np

from firmware.geometry import Array
from firmware.leader.alignment import NoiseModel
from firmware.leader.atlas import Sheet
from firmware.leader.calibration import Calibration, Overlap
from firmware.leader.displacement import Look
from firmware.leader.drifts import AGE_S
from firmware.leader.matches import MatchingSettings, PairSigmas
from firmware.leader.pair_problem import noise_model
from firmware.leader.swath import Swath, levelled, swath_of
from firmware.leader.trajectory import Trajectory
from firmware.submaps import GriddedSubmap

_TILT_FLOOR = 5e-4  # attitude drifts by 0.03 degree
_BEND_FLOOR_PER_M = 3e-6  # sound speed differs by 0.2 m/s across a survey
_OFFSET_FLOOR_M = 0.02  # heave and squat that do not average out


@dataclass(frozen=True, slots=True, kw_only=True)
class Side:
    """One sub-map without its drift, and where in the swath its cells lie."""

    sheet: Sheet
    grid: GriddedSubmap
    drift_mps: Array
    swath: Swath
    starboard: Array  # (2,) unit vector, north and east
    track_m: Array  # (2,) middle of the track, raw dead reckoning


def side_of(sheet: Sheet, trajectory: Trajectory) -> Side:
    """Return a sheet as a side of a pair."""
    grid, drift_mps = sheet.without_drift(trajectory)
    yaw_rad = float(np.interp(sheet.time_s, sheet.track.time_s, np.unwrap(sheet.track.yaw_rad)))
    return Side(
        sheet=sheet,
        grid=grid,
        drift_mps=drift_mps,
        swath=swath_of(grid, sheet.track, drift_mps, sheet.time_s),
        starboard=np.array([-np.sin(yaw_rad), np.cos(yaw_rad)]),
        track_m=sheet.reckoned_at(sheet.time_s),
    )


def strain_m(origin: Side, target: Side, drift_m2ps2: Array) -> float:
    """Return how far drift of a covariance (4, 4) may lay cells of two sides apart.

    Where lines of opposite heading lie side by side, old cells meet young ones. It is the root mean
    square along each axis.
    """
    alike = float(origin.starboard @ target.starboard)
    own = np.trace(drift_m2ps2) / 2.0
    between = np.trace(drift_m2ps2[:2, 2:]) / 2.0
    return float(AGE_S * np.sqrt(max(own - 2.0 * alike * between, 0.0)))


class Calibrations:
    """The calibration of every vehicle, and what it makes of pairs."""

    def __init__(self, matching: MatchingSettings) -> None:
        self._settings, self.matching = matching.calibration, matching
        self._noise: NoiseModel = noise_model(matching, 0.0)
        self._vehicles: dict[int, Calibration] = {}

    def of(self, vehicle: int) -> Calibration:
        """Return the calibration of a vehicle."""
        return self._vehicles.setdefault(vehicle, Calibration(self._settings))

    def learn(self, origin: Side, target: Side, shift_m: Array, covariance_m2: Array) -> None:
        """Learn from a pair whose shift the graph knows well: own overlaps, or a known partner."""
        sides = (origin, target)
        now_s = max(side.sheet.time_s for side in sides)
        vehicles = [side.sheet.id.vehicle for side in sides]
        for vehicle in dict.fromkeys(vehicles):
            mine = [side.sheet.id.vehicle == vehicle for side in sides]
            if not all(mine) and not self._known(vehicles[mine.index(False)]):
                continue
            grids = [
                side.grid if own else self.level(side)
                for side, own in zip(sides, mine, strict=True)
            ]
            overlap = Overlap(
                reference=grids[0],
                query=grids[1],
                reference_swath=origin.swath if mine[0] else None,
                query_swath=target.swath if mine[1] else None,
                shift_m=shift_m,
                covariance_m2=covariance_m2,
            )
            self.of(vehicle).learn(overlap, self._noise, now_s)

    def level(self, side: Side) -> GriddedSubmap:
        """Return the grid of a side without the errors that its vehicle is known to make."""
        return levelled(side.grid, side.swath, self.of(side.sheet.id.vehicle).errors)

    def look_of(self, side: Side) -> Look:
        """Return how a side's vehicle looks at the seabed, and what is known of how it errs."""
        calibration, half_width_m = self.of(side.sheet.id.vehicle), side.swath.half_width_m
        return Look(
            vehicle=side.sheet.id.vehicle,
            starboard=side.starboard,
            altitude_m=half_width_m / np.tan(np.radians(self._settings.opening_deg / 2.0)),
            half_width_m=half_width_m,
            errors=calibration.errors,
            covariance=calibration.covariance,
        )

    def sigmas_of(self, origin: Side, target: Side, shift_m: Array) -> PairSigmas:
        """Return what is left of the swath errors of a pair, and how far depths may differ."""
        tilt, bend = self._remaining(origin, target, shift_m)
        offset_m = self._wander_m(origin, target)
        return PairSigmas(offset_m=offset_m, tilt=tilt, bend_per_m=bend)

    def _known(self, vehicle: int) -> bool:
        calibration, s = self.of(vehicle), self._settings
        sigmas = np.sqrt(np.diag(calibration.covariance))
        return bool(sigmas[0] < 0.3 * s.roll_sigma and sigmas[1] < 0.3 * s.smile_sigma)

    def _wander_m(self, origin: Side, target: Side) -> float:
        s = self._settings
        share = 1.0
        if origin.sheet.id.vehicle == target.sheet.id.vehicle:
            apart_s = target.sheet.time_s - origin.sheet.time_s
            share = 1.0 - float(np.exp(-0.5 * (apart_s / s.wander_time_s) ** 2))
        return float(np.hypot(s.wander_m * np.sqrt(share), _OFFSET_FLOOR_M))

    def _remaining(self, origin: Side, target: Side, shift_m: Array) -> tuple[float, float]:
        """Return sigmas of tilt and bend of the pair's difference half way between the tracks.

        A vehicle errs alike on both of its lines, two vehicles err each on their own.
        """
        half_m = 0.5 * (target.track_m + shift_m - origin.track_m)
        slopes = []
        for side, sign in ((origin, 1.0), (target, -1.0)):
            across_m = float(side.starboard @ half_m) * sign
            bend = 2.0 * np.clip(across_m / side.swath.half_width_m, -1.0, 1.0)
            slopes.append(sign * np.outer(side.starboard, [1.0, bend]))
        covariances = [self.of(side.sheet.id.vehicle).covariance for side in (origin, target)]
        if origin.sheet.id.vehicle == target.sheet.id.vehicle:
            slopes, covariances = [slopes[0] + slopes[1]], covariances[:1]
        tilt = sum(g @ p @ g.T for g, p in zip(slopes, covariances, strict=True))
        alike = float(origin.starboard @ target.starboard) ** 2
        unlike = 1.0 - alike if len(covariances) == 1 else 1.0 + alike
        width_m = min(origin.swath.half_width_m, target.swath.half_width_m)
        bend_m2 = unlike * max(p[1, 1] for p in covariances) / width_m**2
        return (
            float(np.sqrt(np.linalg.eigvalsh(tilt)[-1] + _TILT_FLOOR**2)),
            float(np.sqrt(bend_m2 + _BEND_FLOOR_PER_M**2)),
        )
