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


@dataclass(frozen=True, slots=True)
class _Rays:
    """Where each of N rays begins, and its unit vector, in NED; all arrays are (N,)."""

    north_m: Array
    east_m: Array
    depth_m: Array
    to_north: Array
    to_east: Array
    to_down: Array

    def part(self, rays: NDArray[np.intp]) -> "_Rays":
        """Return some of the rays."""
        return _Rays(*(getattr(self, name).take(rays) for name in self.__slots__))

    def gap_m(self, seabed: Seabed, ranges_m: Array) -> Array:
        """Return the height above the seabed at the ranges (N,)."""
        return seabed.filled_depth_at(*self.at(ranges_m)) - self.depth_m - ranges_m * self.to_down

    def at(self, ranges_m: Array) -> tuple[Array, Array]:
        """Return north and east (N,) at the ranges (N,)."""
        return self.north_m + ranges_m * self.to_north, self.east_m + ranges_m * self.to_east


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
    shape, downward = directions.shape[1:], np.flatnonzero(directions[2] > 0.05)
    distances_m = np.full(shape, np.nan)
    if not downward.size:
        return distances_m
    origins = (np.repeat(v, shape[1]) for v in (poses.north_m, poses.east_m, poses.depth_m))
    rays = _Rays(*origins, *directions.reshape(3, -1)).part(downward)
    across = np.hypot(rays.to_north, rays.to_east)
    reach_m = _reach(seabed, poses, across / rays.to_down)
    shallowest_m, slope = seabed.shallowest_and_steepest(
        (poses.north_m.min() - reach_m, poses.north_m.max() + reach_m),
        (poses.east_m.min() - reach_m, poses.east_m.max() + reach_m),
    )
    pace = 1.0 / (rays.to_down + min(slope, STEEPEST) * across)
    ranges_m = np.maximum(shallowest_m - rays.depth_m, 0.0) * pace
    _trace(seabed, rays, pace, ranges_m)
    _refine(seabed, rays, ranges_m)
    ranges_m[np.isnan(seabed.depth_at(*rays.at(ranges_m)))] = np.nan
    distances_m.ravel()[downward] = ranges_m
    return distances_m


def _reach(seabed: Seabed, poses: Poses, across_per_down: Array) -> float:
    """Return how far to the side the beams can reach: to the deepest seabed of all."""
    deepest_m = float(np.nanmax(seabed.depth_m)) if seabed.depth_m.size else 0.0
    return max(0.0, deepest_m - float(poses.depth_m.min())) * float(across_per_down.max())


def _trace(seabed: Seabed, rays: _Rays, pace: Array, ranges_m: Array) -> None:
    """Move the ranges (N,) of rays to within NEAR_M of the seabed by their paces (N,), in place."""
    active = np.arange(ranges_m.size)
    along_m, step_m, longest_m = ranges_m, np.zeros(active.size), np.full(active.size, np.inf)
    for _ in range(MOST_STEPS):
        gap_m = rays.gap_m(seabed, along_m)
        inside = gap_m < -NEAR_M
        longest_m = np.where(inside, 0.5 * np.abs(step_m), longest_m)
        step_m = np.where(inside, -longest_m, np.minimum(gap_m * pace, longest_m))
        along_m = along_m + step_m
        ranges_m[active] = along_m
        far = np.flatnonzero(np.abs(gap_m) > NEAR_M)
        if far.size == 0:
            break
        rays, active, pace = rays.part(far), active.take(far), pace.take(far)
        along_m, step_m, longest_m = along_m.take(far), step_m.take(far), longest_m.take(far)


def _refine(seabed: Seabed, rays: _Rays, ranges_m: Array) -> None:
    """Move the ranges (N,) of rays onto the seabed by secant steps, in place."""
    before_m = ranges_m.copy()
    gap_before_m = rays.gap_m(seabed, ranges_m)
    ranges_m += gap_before_m / rays.to_down
    for _ in range(SECANT_STEPS):
        gap_m = rays.gap_m(seabed, ranges_m)
        change_m = gap_before_m - gap_m
        safe = np.abs(change_m) > 1e-9
        step_m = np.where(safe, gap_m * (ranges_m - before_m) / np.where(safe, change_m, 1.0), 0.0)
        before_m, gap_before_m = ranges_m.copy(), gap_m
        ranges_m += np.clip(step_m, -1.0, 1.0)
