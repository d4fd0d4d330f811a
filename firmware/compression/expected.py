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

from firmware.compression.initial import main_axis
from firmware.compression.kernel_rows import Float32, Room, Rows, change_by_points, moment_terms
from firmware.compression.kernels import (
    Kernel,
    correlation_and_slope,
    squared_distance,
    subtrahends,
)
from firmware.compression.losses import LossPatterns
from firmware.compression.steps import run
from firmware.compression.weights import LossyWeights, Weights, weights_without_losses
from firmware.geometry import Array

_STEP_WORK = 10240 * 150**2  # rows x points^2 of a step: under 10 ms
_ROOM_ENTRIES = 192 * 150  # rows x points held at once: they stay in the cache
_FEWEST_ROWS = 192  # for which it pays to add to the Gram matrix
_KEPT_BYTES = 4 << 20  # of kernel rows between two passes; beyond it they are made twice


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
        reach_share: float = 1.0,
    ) -> None:
        weight = weight / weight.sum()
        self.total_m2 = float(np.dot(weight, depth_m**2))
        points = len(fragment)
        height = max(_FEWEST_ROWS, _ROOM_ENTRIES // points)
        self._rows_a_step = max(1, _STEP_WORK // (height * points**2))
        self._kept = keep_rows and 8 * len(depth_m) * points <= _KEPT_BYTES
        self._height = height
        room = self._room = Room.of(height * points)
        self._axis = main_axis(position_m)
        along_m = position_m @ self._axis
        order = np.argsort(along_m, kind="stable")
        self._rows = [
            Rows(
                position_m[part],
                depth_m[part],
                weight[part],
                along_m[part],
                room.with_own_rows() if self._kept else room,
            )
            for part in (order[start : start + height] for start in range(0, len(order), height))
        ]
        self._kernel, self._reach = kernel, reach_share * kernel.reach
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

        Strips of cells count as uncorrelated with the points beyond the kernel's reach. Points in
        the order of the cells' main axis save most.

        Raises
        ------
        EstimationError
            When the points' covariance cannot be factorised.
        """
        self.evaluations += 1
        b = float(np.exp(log_b))
        points = subtrahends(point_m.astype(np.float32))
        gram, moment = np.zeros((len(point_m), len(point_m))), np.zeros(len(point_m))
        along_m, reach_m = point_m @ self._axis, self._reach / b
        parts = [(rows, rows.near(along_m, reach_m)) for rows in self._rows]
        for done, (rows, near) in enumerate(parts, 1):
            rows.measure(self._kernel, points[:, :, near], b)
            weighted = rows.weighted()
            gram[near, near] += weighted.T @ weighted
            moment[near] += weighted.T @ rows.target
            if done % self._rows_a_step == 0:
                yield
        yield
        k, slope = self._among_points(point_m, b)
        if self._lossy is None:
            found = weights_without_losses(gram, moment, k, self._ridge)
        else:
            found = yield from self._lossy.steps(gram, moment, k)
        del gram  # the fit's largest, and used up
        self.failed_factorisations += found.failed_factorisations
        evaluation = Evaluation(
            error_m2=self.total_m2 + found.error_m2,
            by_position=np.zeros_like(point_m),
            by_log_b=0.0,
            depth_m=k @ found.beta,
        )
        if not gradient:
            return evaluation
        del k
        yield
        moments = yield from self._moment_steps(found, points, b, parts)
        by_position, by_log_b = change_by_points(moments, point_m, b)
        own = self._own_moments(found, slope, point_m)
        by_own_position, by_own_log_b = change_by_points(own, point_m, b)
        return dataclasses.replace(
            evaluation,
            by_position=by_position + by_own_position,
            by_log_b=by_log_b + 0.5 * by_own_log_b,  # each pair pulls on both of its points
        )

    def _moment_steps(
        self, found: Weights, points: Float32, b: float, parts: list[tuple[Rows, slice]]
    ) -> Generator[None, None, Array]:
        """Return the moments (M, 4) of the cells' pull on each point."""
        stack = found.stack.astype(np.float32)
        low_rank = (2.0 * found.stack * found.probability).astype(np.float32).T
        moments = np.zeros((len(stack), 4))
        for done, (rows, near) in enumerate(parts, 1):
            if not self._kept:
                rows.measure(self._kernel, points[:, :, near], b)
            moments[near] += rows.pull(rows.misfit(stack[near]), low_rank[:, near])
            if done % self._rows_a_step == 0:
                yield
        return moments

    def _among_points(self, point_m: Array, b: float) -> tuple[Float32, Float32]:
        """Return the points' own correlation K (M, M) and its slope.

        The rounding of float32 is a hundred times less than the nugget.
        """
        local_m, size = point_m.astype(np.float32), len(point_m)
        k, slope = (np.empty((size, size), dtype=np.float32) for _ in range(2))
        for start in range(0, size, self._height):
            part = slice(start, start + self._height)
            room = self._room.shaped(len(local_m[part]), size)
            squared = squared_distance(local_m[part], local_m, b, room.k, room.slope)
            k[part], slope[part] = correlation_and_slope(self._kernel, squared, room.k, room.slope)
        return k, slope

    def _own_moments(self, found: Weights, slope: Float32, point_m: Array) -> Array:
        """Return the moments (M, 4) of the points' pull on each other through their own K."""
        terms = moment_terms(point_m)
        if not found.by_k.size:
            pull = (self._ridge * found.beta[:, None] * terms).astype(np.float32)
            return np.asarray((slope @ pull) * (2.0 * found.beta[:, None]), dtype=np.float64)
        moments = np.empty_like(terms)
        for start in range(0, len(point_m), self._height):
            part = slice(start, start + self._height)
            moments[part] = (slope[part] * (found.by_k[part] + found.by_k[:, part].T)) @ terms
        return moments
