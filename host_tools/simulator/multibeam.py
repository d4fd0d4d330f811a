"""A virtual multibeam sonar: beams cast into the seabed, with the errors of a real survey."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware.geometry import Array
from host_tools.scenario import ScenarioSettings
from host_tools.simulator.seabed import Seabed

SOUND_SPEED_MPS = 1500.0
NEAR_M = 0.05  # where sphere tracing hands over to the secant
MOST_STEPS = 300  # grazing beams over steep ground; 20 do elsewhere
SECANT_STEPS = 2
STEEPEST = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Poses:
    """Where the vehicle truly was at each of P pings; all arrays are (P,)."""

    north_m: Array
    east_m: Array
    depth_m: Array
    roll_rad: Array
    pitch_rad: Array
    yaw_rad: Array

    def part(self, pings: NDArray[np.bool_] | slice) -> "Poses":
        """Return the poses of some of the pings."""
        return Poses(**{name: getattr(self, name)[pings] for name in self.__slots__})


def beam_angles(scenario: ScenarioSettings) -> Array:
    """Return the beams' angles (B,) from the vertical, positive to starboard."""
    half_rad = math.radians(scenario.swath_deg) / 2.0
    return np.linspace(-half_rad, half_rad, scenario.beams)


class Multibeam:
    """Measured slant ranges of many pings at once."""

    def __init__(
        self,
        scenario: ScenarioSettings,
        seabed: Seabed,
        roll_bias_deg: float,
        rng: np.random.Generator,
    ) -> None:
        self._scenario = scenario
        self._seabed = seabed
        self._rng = rng
        self._roll_bias_rad = math.radians(roll_bias_deg)
        self.angles_rad = beam_angles(scenario)
        # A sonar that assumes too slow a sound steers its beams farther out (Snell's law).
        speed = 1.0 + scenario.sound_speed_error_mps / SOUND_SPEED_MPS
        self._true_angles_rad = np.arcsin(np.clip(np.sin(self.angles_rad) * speed, -1.0, 1.0))
        self._range_scale = 1.0 / speed

    def measure(self, poses: Poses) -> tuple[Array, NDArray[np.bool_]]:
        """Return slant ranges (P, B), NaN where no echo came back, and which of them are fliers."""
        roll_rad = poses.roll_rad + self._roll_bias_rad
        directions = _beam_directions(roll_rad, poses, self._true_angles_rad)
        ranges_m = cast_rays(self._seabed, poses, directions) * self._range_scale
        sigma_m = np.hypot(
            self._scenario.sounding_sigma_m, self._scenario.sounding_sigma_share * ranges_m
        )
        ranges_m += sigma_m * self._rng.standard_normal(ranges_m.shape)
        fliers = np.zeros(ranges_m.shape, dtype=np.bool_)
        if self._scenario.flier_share > 0.0:
            fliers = self._rng.random(ranges_m.shape) < self._scenario.flier_share
            ranges_m[fliers] *= self._rng.uniform(0.3, 1.7, int(fliers.sum()))
        return ranges_m, fliers

    def soundings(self, poses: Poses, ranges_m: Array) -> Array:
        """Return soundings (N, 3) north, east, depth of the ranges (P, B) at the poses."""
        directions = _beam_directions(poses.roll_rad, poses, self.angles_rad)
        origin = np.stack([poses.north_m, poses.east_m, poses.depth_m])
        points_m: Array = (origin[:, :, None] + directions * ranges_m).reshape(3, -1).T
        return points_m[np.isfinite(ranges_m).ravel()]


def _beam_directions(roll_rad: Array, poses: Poses, angles_rad: Array) -> Array:
    """Return unit vectors (3, P, B) of the beams in NED."""
    cr, sr = np.cos(roll_rad), np.sin(roll_rad)
    cp, sp = np.cos(poses.pitch_rad), np.sin(poses.pitch_rad)
    cy, sy = np.cos(poses.yaw_rad), np.sin(poses.yaw_rad)
    starboard = np.stack([cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr])
    down = np.stack([cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr])
    directions: Array = starboard[:, :, None] * np.sin(angles_rad) + down[:, :, None] * np.cos(
        angles_rad
    )
    return directions


def cast_rays(seabed: Seabed, poses: Poses, directions: Array) -> Array:
    """Return the distance (P, B) along each ray to the seabed's first surface, NaN for no-data.

    Sphere tracing: with the steepest slope L under the swath, a ray at a height g above the seabed
    can go on by g / (down + L across) without passing through it. Where a wall is steeper than
    `STEEPEST`, a ray that came into it goes back by half its step, and steps no farther from then
    on. The last metres are left to the secant. Rays pass over no-data as if it were filled from the
    nearest cell; one that ends there is lost.
    """
    shape = directions.shape[1:]
    d_north, d_east, d_down = (np.ascontiguousarray(d).ravel() for d in directions)
    origin = [np.repeat(v, shape[1]) for v in (poses.north_m, poses.east_m, poses.depth_m)]
    across = np.hypot(d_north, d_east)
    going_down = d_down > 0.05
    reach_m = 0.0
    if going_down.any():
        reach_m = float(_reach(seabed, poses, across[going_down] / d_down[going_down]))
    shallowest_m, slope = seabed.shallowest_and_steepest(
        (poses.north_m.min() - reach_m, poses.north_m.max() + reach_m),
        (poses.east_m.min() - reach_m, poses.east_m.max() + reach_m),
    )
    pace = 1.0 / (d_down + min(slope, STEEPEST) * across)
    ranges_m = np.maximum(shallowest_m - origin[2], 0.0) * pace
    ranges_m[~going_down] = np.nan
    active = np.flatnonzero(going_down)
    step_m, longest_m = np.zeros(ranges_m.size), np.full(ranges_m.size, np.inf)
    for _ in range(MOST_STEPS):
        gap_m = _gap(seabed, origin, (d_north, d_east, d_down), ranges_m, active)
        inside = gap_m < -NEAR_M
        into = active[inside]
        longest_m[into] = 0.5 * np.abs(step_m[into])
        step_m[active] = np.minimum(gap_m * pace[active], longest_m[active])
        step_m[into] = -longest_m[into]
        ranges_m[active] += step_m[active]
        active = active[np.abs(gap_m) > NEAR_M]
        if active.size == 0:
            break
    rays = np.flatnonzero(going_down)
    _refine(seabed, origin, (d_north, d_east, d_down), ranges_m, rays)
    hit_m = ranges_m[rays]
    known = seabed.depth_at(
        origin[0][rays] + hit_m * d_north[rays], origin[1][rays] + hit_m * d_east[rays]
    )
    ranges_m[rays[np.isnan(known)]] = np.nan
    distances_m: Array = ranges_m.reshape(shape)
    return distances_m


def _reach(seabed: Seabed, poses: Poses, across_per_down: Array) -> float:
    """Return how far to the side the beams can reach: to the deepest seabed of all."""
    deepest_m = float(np.nanmax(seabed.depth_m)) if seabed.depth_m.size else 0.0
    return max(0.0, deepest_m - float(poses.depth_m.min())) * float(across_per_down.max())


def _gap(
    seabed: Seabed,
    origin: list[Array],
    direction: tuple[Array, Array, Array],
    ranges_m: Array,
    rays: NDArray[np.intp],
) -> Array:
    """Return the height above the seabed at the ranges of the rays."""
    along_m = ranges_m[rays]
    depth_m = seabed.filled_depth_at(
        origin[0][rays] + along_m * direction[0][rays],
        origin[1][rays] + along_m * direction[1][rays],
    )
    return depth_m - origin[2][rays] - along_m * direction[2][rays]


def _refine(
    seabed: Seabed,
    origin: list[Array],
    direction: tuple[Array, Array, Array],
    ranges_m: Array,
    rays: NDArray[np.intp],
) -> None:
    """Move the ranges of the rays onto the seabed by secant steps, in place."""
    before_m = ranges_m[rays].copy()
    gap_before_m = _gap(seabed, origin, direction, ranges_m, rays)
    ranges_m[rays] += gap_before_m / direction[2][rays]
    for _ in range(SECANT_STEPS):
        gap_m = _gap(seabed, origin, direction, ranges_m, rays)
        now_m = ranges_m[rays]
        change_m = gap_before_m - gap_m
        safe = np.abs(change_m) > 1e-9
        step_m = np.where(safe, gap_m * (now_m - before_m) / np.where(safe, change_m, 1.0), 0.0)
        before_m, gap_before_m = now_m, gap_m
        ranges_m[rays] = now_m + np.clip(step_m, -1.0, 1.0)
