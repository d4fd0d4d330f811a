"""The straight way of sound between two depths: how fast it is, and how far it goes across."""

import itertools
import math
from dataclasses import dataclass

import numpy as np

from protocol.errors import ConfigError
from protocol.settings import Settings, setting

_SLOWEST_MPS, _FASTEST_MPS = 1300.0, 1700.0  # no sea is beyond, from ice to the deepest trench


@dataclass(frozen=True, slots=True, kw_only=True)
class SoundProfile(Settings):
    """Sound speed over depth, linear between its points and constant beyond them."""

    points: tuple[float, ...] | None = setting(
        None, "m,m/s", "depth,speed,depth,speed and so on, downwards; none: sound_speed_mps"
    )

    def __post_init__(self) -> None:
        # super() does not survive the new class that slots=True makes
        Settings.__post_init__(self)
        if not self.points:
            return
        if len(self.points) % 2:
            raise ConfigError(
                f"points are {len(self.points)} numbers; give pairs of depth in m and speed in m/s"
            )
        depths_m, speeds_mps = self.points[::2], self.points[1::2]
        if not all(map(math.isfinite, depths_m)):
            raise ConfigError(f"depths of points are {depths_m} m; they must be finite")
        if any(below <= above for above, below in itertools.pairwise(depths_m)):
            raise ConfigError(f"depths of points are {depths_m} m; they must increase")
        if not all(_SLOWEST_MPS <= speed <= _FASTEST_MPS for speed in speeds_mps):
            raise ConfigError(
                f"speeds of points are {speeds_mps} m/s; they must be from {_SLOWEST_MPS:g}"
                f" to {_FASTEST_MPS:g}"
            )

    def speed_mps(self, from_m: float, to_m: float, otherwise_mps: float) -> float:
        """Return path over travel time of sound between two depths in m.

        That is the harmonic mean over depth, whatever the path's slope; without points it is
        otherwise_mps.
        """
        if not self.points:
            return otherwise_mps
        known_m, known_mps = self.points[::2], self.points[1::2]
        above_m, below_m = sorted((from_m, to_m))
        between_m = [depth_m for depth_m in known_m if above_m < depth_m < below_m]
        depths_m = [above_m, *between_m, below_m]
        speeds_mps = [float(speed) for speed in np.interp(depths_m, known_m, known_mps)]
        if above_m == below_m:
            return speeds_mps[0]
        travel_s = sum(
            (depths_m[k + 1] - depths_m[k]) * _slowness(speeds_mps[k], speeds_mps[k + 1])
            for k in range(len(depths_m) - 1)
        )
        return (below_m - above_m) / travel_s


def horizontal_m(slant_m: float, depth_difference_m: float) -> float:
    """Return how far a slant range goes across; NaN if its ends differ by more than it in depth."""
    if not slant_m >= abs(depth_difference_m):
        return math.nan
    return math.sqrt((slant_m - depth_difference_m) * (slant_m + depth_difference_m))


def _slowness(above_mps: float, below_mps: float) -> float:
    """Return the mean of 1 / speed, in s/m, over a layer in which speed is linear."""
    gradient = (below_mps - above_mps) / above_mps
    return (math.log1p(gradient) / gradient if gradient else 1.0) / above_mps
