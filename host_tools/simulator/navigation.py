"""What dead reckoning, compass and depth sensor say of a true motion: Eq. 12 and more."""

import math

import numpy as np

from firmware.geometry import Array
from host_tools.scenario import ScenarioSettings


class NavigationErrors:
    """The errors of one vehicle's navigation, drawn once and then functions of time.

    Eq. 12 adds N(drift_mean_mps, drift_variance) to north and to east once a second; here it is
    spread evenly over that second. The current is the same for all vehicles of a seed.
    """

    def __init__(self, scenario: ScenarioSettings, vehicle: int, seed: int) -> None:
        rng = np.random.default_rng([seed, vehicle, 1])
        water = np.random.default_rng([seed, 0xC0])
        self._scenario = scenario
        seconds = math.ceil(scenario.duration_s) + 2
        noise = rng.normal(0.0, math.sqrt(scenario.drift_variance), (seconds, 2))
        mean = np.full(2, scenario.drift_mean_mps)
        signs = np.ones(3)
        turn_rad, phases = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.0, 2.0 * np.pi, 2)
        drawn_signs, periods_min = rng.choice([-1.0, 1.0], 3), rng.uniform(20.0, 90.0, 2)
        current_phase = water.uniform(0.0, 2.0 * np.pi)
        if scenario.drift_directions_drawn:
            mean = np.linalg.norm(mean) * np.array([math.cos(turn_rad), math.sin(turn_rad)])
            signs = drawn_signs
        self._wander_m = np.zeros((seconds + 1, 2))
        self._wander_m[1:] = np.cumsum(mean + noise, axis=0)
        self.heading_bias_rad = math.radians(scenario.heading_bias_deg) * float(signs[0])
        self.log_scale = scenario.log_scale * float(signs[1])
        self.roll_bias_deg = scenario.roll_bias_deg * float(signs[2])
        self._depth_waves = [
            (2.0 * np.pi / (60.0 * period_min), phase)
            for period_min, phase in zip(periods_min, phases, strict=True)
        ]
        self._current_phase = current_phase
        self._fix_rng = np.random.default_rng([seed, vehicle, 5])
        start = np.random.default_rng([seed, vehicle, 6])
        self.start_error_m: Array = scenario.start_error_m * start.standard_normal(2)

    def reckoned_steps(self, time_s: Array, true_m: Array) -> Array:
        """Return the steps (T - 1, 2) that dead reckoning measures between true positions."""
        steps_m = np.diff(true_m, axis=0) * (1.0 + self.log_scale)
        c, s = math.cos(self.heading_bias_rad), math.sin(self.heading_bias_rad)
        turned_m = np.stack(
            [c * steps_m[:, 0] - s * steps_m[:, 1], s * steps_m[:, 0] + c * steps_m[:, 1]], axis=1
        )
        return turned_m + np.diff(self._drift_at(time_s), axis=0)

    def _drift_at(self, time_s: Array) -> Array:
        """Return the accumulated displacement (T, 2) of Eq. 12 and of the unseen current."""
        whole_s = np.arange(len(self._wander_m))
        drift_m = np.stack(
            [np.interp(time_s, whole_s, self._wander_m[:, axis]) for axis in (0, 1)], axis=1
        )
        if self._scenario.current_mps:
            rate = 2.0 * np.pi / (60.0 * self._scenario.current_period_min)
            angle = rate * time_s + self._current_phase
            carried_m = self._scenario.current_mps / rate
            drift_m -= carried_m * np.stack([np.sin(angle), -np.cos(angle)], axis=1)
        return drift_m

    def fix_m(self, true_m: Array) -> Array:
        """Return a measured absolute position (2,) for the true one."""
        noise = self._fix_rng.standard_normal(2)
        return np.asarray(true_m + self._scenario.gnss_sigma_m * noise)

    def depth_offset_m(self, time_s: Array) -> Array:
        """Return measured less true depth (T,): tide and sensor, wandering over tens of minutes."""
        waves = [np.sin(rate * time_s + phase) for rate, phase in self._depth_waves]
        offset_m: Array = 0.5 * self._scenario.depth_wander_m * np.sum(waves, axis=0)
        return offset_m
