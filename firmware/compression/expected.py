"""The error the leader must expect, averaged over the frames that may be lost, with its gradient.

With all points the leader's map is f = K_N beta, beta = Q h, Q = (K + nugget I)^-1. When the points
B are lost, its weights become, exactly,

    beta_B = beta - Q[:, B] Q[B, B]^-1 beta[B],

so the error under every pattern of losses is a quadratic form of beta in the Gram matrices
G = K_N' W K_N and g = K_N' W y, which are formed once. The best beta therefore solves one M x M
system, and by the envelope theorem the gradient in positions and length scale needs only partial
derivatives: no sampling, and two passes over the soundings whatever the number of patterns.
"""

import dataclasses
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_triangular

from firmware.compression.decoder import NUGGET, factorised
from firmware.compression.kernel_rows import Room, Rows
from firmware.compression.kernels import (
    Kernel,
    correlation,
    correlation_and_slope,
    squared_distance,
)
from firmware.compression.losses import LossPatterns
from firmware.geometry import Array
from protocol.errors import EstimationError

_STEP_WORK = 10240 * 150**2  # rows x points^2 of a step: under 10 ms
_ROOM_ROWS = 192 * 150  # rows x points held at once: they stay in the cache
_KEPT_BYTES = 4 << 20  # of kernel rows between two passes; beyond it they are made twice
_MANY_POINTS = 200  # whose covariance is a step of its own, and its slope another
_ROUNDING = 1e-14  # of a Gram matrix in double precision

T = TypeVar("T")


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
        self._no_loss = patterns.no_loss
        self._groups = _groups(patterns, fragment)
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
        if not gradient and not self._groups:
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
        found = self._without_losses(gram, moment, k)
        return Evaluation(
            error_m2=found.error_m2,
            by_position=np.zeros_like(point_m),
            by_log_b=0.0,
            depth_m=k @ found.beta,
        )

    def _solved_steps(
        self, point_m: Array, b: float, gram: Array, moment: Array
    ) -> Generator[None, None, "_Inner"]:
        """Return the best weights, their error, and the gradient through the points' own K."""
        if self._groups:
            squared = squared_distance(point_m, point_m, b)
            k, slope = correlation_and_slope(self._kernel, squared, squared)
            if slope is k:  # which is changed below
                slope = k.copy()
            found = yield from self._under_losses(gram, moment, k)
            by_k = np.add(found.by_k, found.by_k.T)
            by_k *= slope
            depth_m = k @ found.beta
        else:
            k = correlation(self._kernel, squared_distance(point_m, point_m, b))
            found = self._without_losses(gram, moment, k)
            depth_m = k @ found.beta
            if len(point_m) > _MANY_POINTS:
                yield
            squared = squared_distance(point_m, point_m, b, gram)  # whose room is free now
            _, by_k = correlation_and_slope(self._kernel, squared, k, squared)
            by_k *= (2.0 * self._ridge) * found.beta
            by_k *= found.beta[:, None]
        mass, moved = by_k.sum(axis=1), by_k @ point_m
        by_scale = mass @ np.sum(point_m**2, axis=1) - float(np.vdot(moved, point_m))
        evaluation = Evaluation(
            error_m2=found.error_m2,
            by_position=(b * b) * (moved - mass[:, None] * point_m),
            by_log_b=-(b * b) * float(by_scale),
            depth_m=depth_m,
        )
        return _Inner(evaluation=evaluation, stack=found.stack, probability=found.probability)

    def _without_losses(self, gram: Array, moment: Array, k: Array) -> "_Solution":
        """Return the beta of least error when every point arrives; gram and k are used up."""
        k[np.diag_indices_from(k)] += NUGGET
        k *= self._ridge
        gram += k
        k /= self._ridge
        lower, _, failed = factorised(gram, _ROUNDING * float(np.trace(gram)), use_up=True)
        self.failed_factorisations += failed
        beta = np.asarray(cho_solve((lower.T, False), moment))
        return _Solution(
            beta=beta,
            stack=beta[:, None],
            probability=np.ones(1),
            error_m2=self.total_m2 - float(moment @ beta),
        )

    def _under_losses(
        self, gram: Array, moment: Array, k: Array
    ) -> Generator[None, None, "_Solution"]:
        """Return the beta of least expected error; k gets its nugget.

        The points' own K enters through Q, that is through the corrections of the weights.
        """
        lower, nugget, failed = factorised(k, NUGGET)
        self.failed_factorisations += failed
        k[np.diag_indices_from(k)] += nugget
        inverse = cho_solve((lower, True), np.eye(len(moment)))
        yield
        blocks = [_Block.of(group, inverse) for group in self._groups]
        beta = self._best_weights(gram, moment, inverse, lower, blocks)
        yield
        probability = np.concatenate([[self._no_loss], *(block.probability for block in blocks)])
        lost = [np.zeros((len(beta), 1)), *(block.weights_lost(beta) for block in blocks)]
        correction = inverse @ np.hstack(lost)
        stack = beta[:, None] - correction
        fitted = gram @ stack
        error = self.total_m2 + self._ridge * float(beta @ k @ beta)
        error += float(probability @ (np.einsum("mp,mp->p", stack, fitted) - 2.0 * moment @ stack))
        pull = 2.0 * probability * (fitted - moment[:, None])
        spread = inverse @ pull
        first = 1
        for block in blocks:
            columns = slice(first, first + len(block.probability))
            pull[:, columns] -= block.padded(block.solved(spread[:, columns]))
            first += len(block.probability)
        by_k = (inverse @ pull) @ correction.T + self._ridge * np.outer(beta, beta)
        return _Solution(beta=beta, stack=stack, probability=probability, error_m2=error, by_k=by_k)

    def _best_weights(
        self, gram: Array, moment: Array, inverse: Array, lower: Array, blocks: "list[_Block]"
    ) -> Array:
        """Return the beta of least expected error: one positive definite system, whitened."""
        size = len(moment)
        lost = np.zeros((size, size))
        mapped = gram @ inverse
        twice = inverse @ mapped
        quadratic = gram.copy()
        for block in blocks:
            lost += block.scattered(block.inverse, size)
            inner = block.gathered(twice)
            quadratic += block.scattered(block.inverse @ inner @ block.inverse, size)
        cross = mapped @ lost
        quadratic -= cross + cross.T
        right = moment - lost @ (inverse @ moment)
        white = solve_triangular(lower, quadratic, lower=True)
        white = solve_triangular(lower, white.T, lower=True)
        factor, _, failed = factorised(0.5 * (white + white.T), self._ridge)
        self.failed_factorisations += failed
        alpha = cho_solve((factor, True), solve_triangular(lower, right, lower=True))
        beta: Array = solve_triangular(lower, alpha, lower=True, trans=1)
        return beta


@dataclass(frozen=True, slots=True, kw_only=True)
class _Solution:
    """The best weights (M,), those under each pattern (M, P), the error, and its change by K."""

    beta: Array
    stack: Array
    probability: Array
    error_m2: float
    by_k: Array = dataclasses.field(default_factory=lambda: np.empty((0, 0)))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Inner:
    """What is known between the passes: weights under each pattern (M, P), and the rest."""

    evaluation: Evaluation
    stack: Array
    probability: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class _Block:
    """Patterns that lose equally many points: indices (G, m) and the inverses of Q there."""

    index: NDArray[np.intp]
    probability: Array  # (G,)
    inverse: Array  # (G, m, m)
    size: int

    @classmethod
    def of(cls, group: tuple[NDArray[np.intp], Array], inverse: Array) -> "_Block":
        index, probability = group
        inner = np.asarray(
            np.linalg.inv(inverse[index[:, :, None], index[:, None, :]]), dtype=np.float64
        )
        return cls(index=index, probability=probability, inverse=inner, size=len(inverse))

    def gathered(self, matrix: Array) -> Array:
        out: Array = matrix[self.index[:, :, None], self.index[:, None, :]]
        return out

    def scattered(self, blocks: Array, size: int) -> Array:
        """Return the probability-weighted sum of blocks (G, m, m) put where they belong."""
        flat = self.index[:, :, None] * size + self.index[:, None, :]
        values = blocks * self.probability[:, None, None]
        out = np.bincount(flat.ravel(), values.ravel(), size * size).astype(np.float64)
        return out.reshape(size, size)

    def solved(self, columns: Array) -> Array:
        """Return inverse times the lost rows of each pattern's column (M, G), as (G, m)."""
        rows = columns[self.index, np.arange(len(self.index))[:, None]]
        return np.asarray(np.einsum("gij,gj->gi", self.inverse, rows))

    def padded(self, values: Array) -> Array:
        """Return values (G, m) as columns (M, G) that are zero where nothing was lost."""
        out = np.zeros((self.size, len(self.index)))
        out[self.index, np.arange(len(self.index))[:, None]] = values
        return out

    def weights_lost(self, beta: Array) -> Array:
        return self.padded(np.einsum("gij,gj->gi", self.inverse, beta[self.index]))


def _groups(
    patterns: LossPatterns, fragment: NDArray[np.intp]
) -> list[tuple[NDArray[np.intp], Array]]:
    """Return indices (G, m) and probabilities (G,) of the patterns of each number lost."""
    by_size: dict[int, list[tuple[NDArray[np.intp], float]]] = {}
    for points, probability in zip(
        patterns.lost_points(fragment), patterns.probability, strict=True
    ):
        by_size.setdefault(len(points), []).append((points, float(probability)))
    return [
        (np.array([points for points, _ in group]), np.array([p for _, p in group]))
        for size, group in sorted(by_size.items())
        if size
    ]


def run(steps: Generator[None, None, T]) -> T:
    """Return the value of a generator of steps, taken all at once."""
    while True:
        try:
            next(steps)
        except StopIteration as stop:
            value: T = stop.value
            return value


def stepping(steps: Generator[None, None, T]) -> Iterator[T | None]:
    """Yield None after every small step of a generator, and its value at the end."""
    while True:
        try:
            next(steps)
        except StopIteration as stop:
            yield stop.value
            return
        yield None


class Watched(Generic[T]):
    """The steps of a fit, which may end by a factorisation that failed; `ended` then says how."""

    def __init__(self, steps: Generator[T, None, str]) -> None:
        self.ended = "not fitted"
        self._steps = steps

    def __iter__(self) -> Iterator[T]:
        try:
            self.ended = yield from self._steps
        except EstimationError as error:  # not to be factorised at any nugget
            self.ended = str(error)
