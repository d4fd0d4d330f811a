"""FITC (SPGP), the paper's own compression: Eq. 1-6 with the sparse posterior, O(chunk x M) memory.

The likelihood of Eq. (1) is N(0, Q + D) with Q = K_NM K_M^-1 K_MN and D = diag(c - Q_nn) + sigma^2.
Positions, b, c and sigma^2 are found by its analytic gradient; the depths of the pseudo points are
the posterior means there (Eq. 4 with the sparse posterior in the place of Eq. 5's full matrix).
Source: Snelson and Ghahramani, "Sparse Gaussian processes using pseudo-inputs", 2006.
"""

from collections.abc import Generator, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve, solve_triangular

from firmware.compression.decoder import factorised
from firmware.compression.kernels import Kernel, correlation_and_slope, squared_distance
from firmware.geometry import Array

_ROWS = 1024  # kernel rows per step
_JITTER = 1e-6  # of c, in float64


@dataclass(frozen=True, slots=True, kw_only=True)
class FitcParameters:
    """Positions (M, 2) about the cells' centre and the hyperparameters of Eq. (3) and (1)."""

    point_m: Array
    log_b: float
    log_c: float
    log_sigma2: float


@dataclass(frozen=True, slots=True, kw_only=True)
class FitcEvaluation:
    """The negative log likelihood per cell, its gradient, and the points' posterior depths."""

    value: float
    by_point: Array
    by_log_b: float
    by_log_c: float
    by_log_sigma2: float
    depth_m: Array


class Fitc:
    """The likelihood of Eq. (1) for centred cells: position (N, 2), depth (N,)."""

    def __init__(self, position_m: Array, depth_m: Array, kernel: Kernel) -> None:
        self._position_m, self._depth_m, self._kernel = position_m, depth_m, kernel
        self.failed_factorisations = 0

    def steps(self, p: FitcParameters) -> Generator[None, None, FitcEvaluation]:
        """Evaluate in small steps; the generator's value is the evaluation.

        Raises
        ------
        EstimationError
            When the points' covariance cannot be factorised.
        """
        b, c, sigma2 = np.exp([p.log_b, p.log_c, p.log_sigma2])
        count, size = len(self._depth_m), len(p.point_m)
        squared = squared_distance(p.point_m, p.point_m, b)
        k_m, slope_m = correlation_and_slope(self._kernel, squared)
        k_m = c * k_m
        lower, nugget, failed = factorised(k_m / c, _JITTER)
        self.failed_factorisations += failed
        lower = np.sqrt(c) * lower
        k_m = k_m + c * nugget * np.eye(size)
        gram, moment = k_m.copy(), np.zeros(size)
        value = 0.5 * count * np.log(2.0 * np.pi)
        for part in self._parts():
            a = c * correlation_and_slope(self._kernel, self._squared(part, p.point_m, b))[0]
            white = solve_triangular(lower, a.T, lower=True)
            noise = np.maximum(c - np.einsum("mn,mn->n", white, white), 0.0) + sigma2
            depth_m = self._depth_m[part]
            gram += (a / noise[:, None]).T @ a
            moment += a.T @ (depth_m / noise)
            value += 0.5 * float(np.log(noise).sum() + (depth_m**2 / noise).sum())
            yield
        factor, _, failed = factorised(gram / np.trace(gram), 0.0)
        self.failed_factorisations += failed
        factor = factor * np.sqrt(np.trace(gram))
        posterior = cho_solve((factor, True), moment)
        value += float(np.log(np.diag(factor)).sum() - np.log(np.diag(lower)).sum())
        value -= 0.5 * float(moment @ posterior)
        inverse_m = cho_solve((lower, True), np.eye(size))
        inverse_g = cho_solve((factor, True), np.eye(size))
        u_alpha, outer, by_noise_sum = np.zeros(size), np.zeros((size, size)), 0.0
        gradient = _Gradient.zero(size)
        for part in self._parts():
            squared_n = self._squared(part, p.point_m, b)
            a, slope = correlation_and_slope(self._kernel, squared_n)
            a = c * a
            u = a @ inverse_m
            noise = np.maximum(c - np.einsum("nm,nm->n", u, a), 0.0) + sigma2
            half = (a @ inverse_g) / noise[:, None]
            alpha = (self._depth_m[part] - a @ posterior) / noise
            variance = 1.0 / noise - np.einsum("nm,nm->n", half, a) / noise
            by_noise = 0.5 * (alpha**2 - variance)
            # alpha' U over all cells equals K_M^-1 (moment - (gram - K_M) posterior) = posterior
            by_a = np.outer(alpha, posterior) - half - 2.0 * by_noise[:, None] * u
            u_alpha += u.T @ alpha
            outer += u.T @ (by_noise[:, None] * u)
            by_noise_sum += float(by_noise.sum())
            gradient.add(by_a * a, c * by_a * slope, squared_n, self._position_m[part], p.point_m)
            yield
        inner = inverse_m @ (gram - k_m) @ inverse_g
        by_k = -0.5 * (np.outer(u_alpha, u_alpha) - 0.5 * (inner + inner.T)) + outer
        gradient.add(by_k * k_m, 2.0 * c * by_k * slope_m, 0.5 * squared, p.point_m, p.point_m)
        return FitcEvaluation(
            value=value / count,
            by_point=-(b * b) * gradient.by_point / count,
            by_log_b=-gradient.by_log_b / count,
            by_log_c=-(gradient.by_log_c + c * by_noise_sum) / count,
            by_log_sigma2=-sigma2 * by_noise_sum / count,
            depth_m=k_m @ posterior,
        )

    def _squared(self, part: slice, point_m: Array, b: float) -> Array:
        return squared_distance(self._position_m[part], point_m, b)

    def _parts(self) -> Iterator[slice]:
        for start in range(0, len(self._depth_m), _ROWS):
            yield slice(start, start + _ROWS)


@dataclass(slots=True)
class _Gradient:
    """Sums of the log likelihood's derivative over kernel entries."""

    by_point: Array
    by_log_b: float
    by_log_c: float

    @classmethod
    def zero(cls, size: int) -> "_Gradient":
        return cls(np.zeros((size, 2)), 0.0, 0.0)

    def add(
        self, by_log: Array, by_slope: Array, squared: Array, left_m: Array, point_m: Array
    ) -> None:
        """Add entries between left (N, 2) and the points (M, 2)."""
        self.by_log_c += float(by_log.sum())
        self.by_log_b -= float(np.vdot(by_slope, squared))
        self.by_point += by_slope.T @ left_m - by_slope.sum(axis=0)[:, None] * point_m
