"""One vehicle's estimated trajectory, between and beyond the nodes of the pose graph."""

from dataclasses import dataclass

import numpy as np

from firmware.geometry import Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Trajectory:
    """The estimate at the nodes: time (K,), dead reckoning, position and bias (K, 2)."""

    time_s: Array
    reckoned_m: Array
    position_m: Array
    bias_mps: Array

    def correct(self, time_s: Array | float, reckoned_m: Array) -> Array:
        """Return estimated positions (..., 2) for dead-reckoned ones (..., 2) at the times.

        The correction is interpolated between nodes, and carried on with the newest bias.
        """
        time_s = np.asarray(time_s, dtype=np.float64)
        correction_m = self.position_m - self.reckoned_m
        ahead_s = np.maximum(time_s - self.time_s[-1], 0.0)
        axes = [
            np.interp(time_s, self.time_s, correction_m[:, axis])
            - ahead_s * self.bias_mps[-1, axis]
            for axis in (0, 1)
        ]
        return np.asarray(reckoned_m + np.stack(axes, axis=-1))

    def bias_at(self, time_s: float) -> Array:
        """Return the dead-reckoning bias (2,) in m/s at the time."""
        return np.array([np.interp(time_s, self.time_s, self.bias_mps[:, a]) for a in (0, 1)])

    def drift_at(self, time_s: float, window_s: float = 40.0) -> Array:
        """Return the velocity (2,) in m/s by which dead reckoning ran away around the time.

        It is the slope of the correction over a window, so that heading bias, log scale and what
        the smoothed random part tells are in it beside the bias.
        """
        correction_m = self.position_m - self.reckoned_m
        start_s = max(time_s - window_s / 2, float(self.time_s[0]))
        end_s = min(time_s + window_s / 2, float(self.time_s[-1]))
        if end_s - start_s < window_s / 4:
            return np.asarray(self.bias_mps[-1] if time_s > self.time_s[0] else self.bias_mps[0])
        at = [
            np.array([np.interp(t, self.time_s, correction_m[:, axis]) for axis in (0, 1)])
            for t in (start_s, end_s)
        ]
        return np.asarray((at[0] - at[1]) / (end_s - start_s))
