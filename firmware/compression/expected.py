"""The error the leader must expect, averaged over the frames that may be lost, with its gradient.

The error is a quadratic form of the points' weights (`firmware.compression.weights`) in Gram
matrices that are formed once. By the envelope theorem the gradient in positions and length scale
needs only partial derivatives: no sampling, and two passes over the cells whatever the number of
patterns.
"""

import dataclasses
from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware.compression.kernel_rows import Room, Rows
from firmware.compression.kernels import (
    Kernel,
    correlation,
    correlation_and_slope,
    squared_distance,
)
from firmware.compression.losses import LossPatterns
from firmware.compression.steps import run
from firmware.compression.weights import LossyWeights, weights_without_losses
from firmware.geometry import Array

_STEP_WORK = 10240 * 150**2  # rows x points^2 of a step: under 10 ms
_ROOM_ROWS = 192 * 150  # rows x points held at once: they stay in the cache
_KEPT_BYTES = 4 << 20  # of kernel rows between two passes; beyond it they are made twice
_MANY_POINTS = 200  # whose covariance is a step of its own, and its slope another


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """The expected mean square error in m^2, its gradient, and the weights that reach it."""

    error_m2: float
    by_position: Array  # (M, 2) m^2 per m
    by_log_b: float
    depth_m: Array  # (M,), what is sent: (K + nugget I) beta


class ExpectedError:
    """The objective for one sub-map: positions (M, 2) and log b in, `Evaluation` out."""

    def __init__(
        self,
        position_m: Array,
        depth_m: Array,
        weight: Array,
        kernel: Kernel,
        patterns: LossPatterns,
        fragment: NDArray[np.intp],
        ridge: float,
        keep_rows: bool = True,
    ) -> None:
        weight = weight / weight.sum()
        self.total_m2 = float(np.dot(weight, depth_m**2))
        points = len(fragment)
        height = max(64, _ROOM_ROWS // points)
        self._rows_a_step = max(1, _STEP_WORK // (height * points**2))
        self._kept = keep_rows and 8 * len(depth_m) * points <= _KEPT_BYTES
        room = Room.of(min(height, len(depth_m)), points)
        self._rows = [
            Rows(
                position_m[start : start + height],
                depth_m[start : start + height],
                weight[start : start + height],
                room.with_own_rows() if self._kept else room,
            )
            for start in range(0, len(depth_m), height)
        ]
        self._kernel = kernel
        self._lossy = LossyWeights(patterns, fragment, ridge) if patterns.lost else None
        self._ridge = ridge
        self.failed_factorisations = 0
        self.evaluations = 0

    def evaluate(self, point_m: Array, log_b: float) -> Evaluation:
        """Return the evaluation at once."""
        return run(self.steps(point_m, log_b))

    def steps(
        self, point_m: Array, log_b: float, gradient: bool = True
    ) -> Generator[None, None, Evaluation]:
        """Evaluate in small steps; the generator's value is the `Evaluation`.

        Raises
        ------
        EstimationError
            When the points' covariance cannot be factorised.
        """
        self.evaluations += 1
        b = float(np.exp(log_b))
        points = point_m.astype(np.float32)
        gram, moment = np.zeros((len(points), len(points))), np.zeros(len(points))
        for done, rows in enumerate(self._rows, 1):
            rows.measure(self._kernel, points, b)
            gram += rows.weighted.T @ rows.weighted
            moment += rows.weighted.T @ rows.target
            if done % self._rows_a_step == 0:
                yield
        if not gradient and self._lossy is None:
            return self._value(point_m, b, gram, moment)
        inner = yield from self._solved_steps(point_m, b, gram, moment)
        if not gradient:
            return inner.evaluation
        yield
        by_position, by_log_b = inner.evaluation.by_position, inner.evaluation.by_log_b
        stack = inner.stack.astype(np.float32)
        low_rank = (2.0 * inner.stack * inner.probability).astype(np.float32).T
        for done, rows in enumerate(self._rows, 1):
            if not self._kept:
                rows.measure(self._kernel, points, b)
            by_point, by_scale = rows.pulled(stack, low_rank, points)
            by_position += (b * b) * by_point
            by_log_b -= (b * b) * by_scale
            if done % self._rows_a_step == 0:
                yield
        return dataclasses.replace(inner.evaluation, by_position=by_position, by_log_b=by_log_b)

    def _value(self, point_m: Array, b: float, gram: Array, moment: Array) -> Evaluation:
        """Return the error and the depths without losses, and no gradient: less memory."""
        k = correlation(self._kernel, squared_distance(point_m, point_m, b))
        found = weights_without_losses(gram, moment, k, self._ridge)
        self.failed_factorisations += found.failed_factorisations
        return Evaluation(
            error_m2=self.total_m2 + found.error_m2,
            by_position=np.zeros_like(point_m),
            by_log_b=0.0,
            depth_m=k @ found.beta,
        )

    def _solved_steps(
        self, point_m: Array, b: float, gram: Array, moment: Array
    ) -> Generator[None, None, "_Inner"]:
        """Return the best weights, their error, and the gradient through the points' own K."""
        if self._lossy is not None:
            squared = squared_distance(point_m, point_m, b)
            k, slope = correlation_and_slope(self._kernel, squared, squared)
            if slope is k:  # which is changed below
                slope = k.copy()
            found = yield from self._lossy.steps(gram, moment, k)
            by_k = np.add(found.by_k, found.by_k.T)
            by_k *= slope
            depth_m = k @ found.beta
        else:
            k = correlation(self._kernel, squared_distance(point_m, point_m, b))
            found = weights_without_losses(gram, moment, k, self._ridge)
            depth_m = k @ found.beta
            if len(point_m) > _MANY_POINTS:
                yield
            squared = squared_distance(point_m, point_m, b, gram)  # whose room is free now
            _, by_k = correlation_and_slope(self._kernel, squared, k, squared)
            by_k *= (2.0 * self._ridge) * found.beta
            by_k *= found.beta[:, None]
        self.failed_factorisations += found.failed_factorisations
        mass, moved = by_k.sum(axis=1), by_k @ point_m
        by_scale = mass @ np.sum(point_m**2, axis=1) - float(np.vdot(moved, point_m))
        evaluation = Evaluation(
            error_m2=self.total_m2 + found.error_m2,
            by_position=(b * b) * (moved - mass[:, None] * point_m),
            by_log_b=-(b * b) * float(by_scale),
            depth_m=depth_m,
        )
        return _Inner(evaluation=evaluation, stack=found.stack, probability=found.probability)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Inner:
    """What is known between the passes: weights under each pattern (M, P), and the rest."""

    evaluation: Evaluation
    stack: Array
    probability: Array
