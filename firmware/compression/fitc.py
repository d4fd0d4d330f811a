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
        points = _Points(p.point_m, float(b), float(c), self._kernel)
        forward = yield from self._forward_steps(points, float(sigma2))
        self.failed_factorisations += points.failed + forward.failed
        gradient, by_noise_sum = yield from self._backward_steps(points, forward, float(sigma2))
        count = len(self._depth_m)
        return FitcEvaluation(
            value=forward.value / count,
            by_point=-(b * b) * gradient.by_point / count,
            by_log_b=-gradient.by_log_b / count,
            by_log_c=-(gradient.by_log_c + c * by_noise_sum) / count,
            by_log_sigma2=-sigma2 * by_noise_sum / count,
            depth_m=points.k_m @ forward.posterior,
        )

    def _forward_steps(
        self, points: "_Points", sigma2: float
    ) -> Generator[None, None, "_Likelihood"]:
        """Return the likelihood's value and the points' posterior, in one pass over the cells."""
        gram, moment = points.k_m.copy(), np.zeros(len(points.point_m))
        value = 0.5 * len(self._depth_m) * np.log(2.0 * np.pi)
        for part in self._parts():
            a = points.c * correlation_and_slope(self._kernel, self._squared(part, points))[0]
            white = solve_triangular(points.lower, a.T, lower=True)
            noise = np.maximum(points.c - np.einsum("mn,mn->n", white, white), 0.0) + sigma2
            depth_m = self._depth_m[part]
            gram += (a / noise[:, None]).T @ a
            moment += a.T @ (depth_m / noise)
            value += 0.5 * float(np.log(noise).sum() + (depth_m**2 / noise).sum())
            yield
        factor, _, failed = factorised(gram / np.trace(gram), 0.0)
        factor = factor * np.sqrt(np.trace(gram))
        posterior = cho_solve((factor, True), moment)
        value += float(np.log(np.diag(factor)).sum() - np.log(np.diag(points.lower)).sum())
        value -= 0.5 * float(moment @ posterior)
        return _Likelihood(
            value=float(value), gram=gram, factor=factor, posterior=posterior, failed=failed
        )

    def _backward_steps(
        self, points: "_Points", forward: "_Likelihood", sigma2: float
    ) -> Generator[None, None, tuple["_Gradient", float]]:
        """Return the derivatives by kernel entries, and by each cell's noise, in a second pass."""
        size, c = len(points.point_m), points.c
        inverse_m = cho_solve((points.lower, True), np.eye(size))
        inverse_g = cho_solve((forward.factor, True), np.eye(size))
        u_alpha, outer, by_noise_sum = np.zeros(size), np.zeros((size, size)), 0.0
        gradient = _Gradient.zero(size)
        for part in self._parts():
            squared_n = self._squared(part, points)
            a, slope = correlation_and_slope(self._kernel, squared_n)
            a = c * a
            u = a @ inverse_m
            noise = np.maximum(c - np.einsum("nm,nm->n", u, a), 0.0) + sigma2
            half = (a @ inverse_g) / noise[:, None]
            alpha = (self._depth_m[part] - a @ forward.posterior) / noise
            variance = 1.0 / noise - np.einsum("nm,nm->n", half, a) / noise
            by_noise = 0.5 * (alpha**2 - variance)
            # alpha' U over all cells equals K_M^-1 (moment - (gram - K_M) posterior) = posterior
            by_a = np.outer(alpha, forward.posterior) - half - 2.0 * by_noise[:, None] * u
            u_alpha += u.T @ alpha
            outer += u.T @ (by_noise[:, None] * u)
            by_noise_sum += float(by_noise.sum())
            here_m = self._position_m[part]
            gradient.add(by_a * a, c * by_a * slope, squared_n, here_m, points.point_m)
            yield
        inner = inverse_m @ (forward.gram - points.k_m) @ inverse_g
        by_k = -0.5 * (np.outer(u_alpha, u_alpha) - 0.5 * (inner + inner.T)) + outer
        by_slope = 2.0 * c * by_k * points.slope_m
        half_squared = 0.5 * points.squared
        gradient.add(by_k * points.k_m, by_slope, half_squared, points.point_m, points.point_m)
        return gradient, by_noise_sum

    def _squared(self, part: slice, points: "_Points") -> Array:
        return squared_distance(self._position_m[part], points.point_m, points.b)

    def _parts(self) -> Iterator[slice]:
        for start in range(0, len(self._depth_m), _ROWS):
            yield slice(start, start + _ROWS)


class _Points:
    """The points' own covariance K_M, its slope and its factor."""

    def __init__(self, point_m: Array, b: float, c: float, kernel: Kernel) -> None:
        self.point_m, self.b, self.c = point_m, b, c
        self.squared = squared_distance(point_m, point_m, b)
        correlation, self.slope_m = correlation_and_slope(kernel, self.squared)
        k_m = c * correlation
        lower, nugget, self.failed = factorised(k_m / c, _JITTER)
        self.lower = np.sqrt(c) * lower
        self.k_m = k_m + c * nugget * np.eye(len(point_m))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Likelihood:
    """The value, and what the second pass takes from the first."""

    value: float
    gram: Array
    factor: Array
    posterior: Array
    failed: int


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
