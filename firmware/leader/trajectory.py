"""One vehicle's estimated trajectory, between and beyond the nodes of the pose graph."""

from dataclasses import dataclass

import numpy as np

from firmware.geometry import Array

_WINDOW_S = 40.0  # over which drift is the slope of the correction: a sub-map


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
        near = self._around(time_s)
        nodes_s = self.time_s[near]
        correction_m = self.position_m[near] - self.reckoned_m[near]
        ahead_s = np.maximum(time_s - self.time_s[-1], 0.0)
        axes = [
            np.interp(time_s, nodes_s, correction_m[:, axis]) - ahead_s * self.bias_mps[-1, axis]
            for axis in (0, 1)
        ]
        return np.asarray(reckoned_m + np.stack(axes, axis=-1))

    def bias_at(self, time_s: float) -> Array:
        """Return the dead-reckoning bias (2,) in m/s at the time."""
        near = self._around(np.asarray(time_s))
        return np.array(
            [np.interp(time_s, self.time_s[near], self.bias_mps[near, a]) for a in (0, 1)]
        )

    def drift_at(self, time_s: float) -> Array:
        """Return the velocity (2,) in m/s by which dead reckoning ran away around the time.

        It is the slope of the correction over a window, so that heading bias, log scale and what
        the smoothed random part tells are in it beside the bias.
        """
        start_s = max(time_s - _WINDOW_S / 2, float(self.time_s[0]))
        end_s = min(time_s + _WINDOW_S / 2, float(self.time_s[-1]))
        if end_s - start_s < _WINDOW_S / 4:
            return np.asarray(self.bias_mps[-1] if time_s > self.time_s[0] else self.bias_mps[0])
        ends_s = np.array([start_s, end_s])
        at_m = self.correct(ends_s, np.zeros((2, 2)))
        return np.asarray((at_m[0] - at_m[1]) / (end_s - start_s))

    def until(self, time_s: float) -> "Trajectory":
        """Return the part up to and with the first node at or after a time."""
        rows = slice(int(np.searchsorted(self.time_s, time_s)) + 1)
        return Trajectory(
            time_s=self.time_s[rows],
            reckoned_m=self.reckoned_m[rows],
            position_m=self.position_m[rows],
            bias_mps=self.bias_mps[rows],
        )

    def carried_by(self, nodes: "Trajectory") -> "Trajectory":
        """Return this trajectory moved with some of its nodes, and gone on with the others.

        What lies between two of the nodes keeps its shape and shares their changes.
        """
        again = nodes.time_s <= self.time_s[-1]
        rows = np.searchsorted(self.time_s, nodes.time_s[again])
        moved = [
            [
                np.interp(self.time_s, nodes.time_s[again], now[again, axis] - old[rows, axis])
                for axis in (0, 1)
            ]
            for now, old in (
                (nodes.position_m, self.position_m),
                (nodes.bias_mps, self.bias_mps),
            )
        ]
        return Trajectory(
            time_s=np.concatenate([self.time_s, nodes.time_s[~again]]),
            reckoned_m=np.concatenate([self.reckoned_m, nodes.reckoned_m[~again]]),
            position_m=np.concatenate(
                [self.position_m + np.stack(moved[0], axis=-1), nodes.position_m[~again]]
            ),
            bias_mps=np.concatenate(
                [self.bias_mps + np.stack(moved[1], axis=-1), nodes.bias_mps[~again]]
            ),
        )

    def _around(self, time_s: Array) -> slice:
        """Return the nodes between which times are interpolated: few of a whole day."""
        if not time_s.size:
            return slice(None)
        first = int(self.time_s.searchsorted(time_s.min(), side="right")) - 1
        last = int(self.time_s.searchsorted(time_s.max(), side="left"))
        return slice(min(max(first, 0), len(self.time_s) - 1), last + 1)
