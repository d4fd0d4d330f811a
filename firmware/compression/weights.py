"""The points' weights of least expected error, from Gram matrices of the cells.

With all points the leader's map is f = K_N beta, beta = Q h, Q = (K + nugget I)^-1. When the points
B are lost, its weights become, exactly,

    beta_B = beta - Q[:, B] Q[B, B]^-1 beta[B],

so the error under every pattern of losses is a quadratic form of beta in G = K_N' W K_N and
g = K_N' W y. The best beta therefore solves one M x M system.
"""

from collections.abc import Generator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_triangular

from firmware.compression.decoder import NUGGET, factorised
from firmware.compression.kernels import FloatArray
from firmware.compression.losses import LossPatterns
from firmware.geometry import Array

_ROUNDING = 1e-14  # of a Gram matrix in double precision


@dataclass(frozen=True, slots=True, kw_only=True)
class Weights:
    """The best weights (M,), those under each pattern (M, P), and the error, m^2, less that of 0.

    by_k (M, M) is the error's change by the points' own K, where it is not ridge beta beta'.
    """

    beta: Array
    stack: Array
    probability: Array
    error_m2: float
    failed_factorisations: int
    by_k: Array = field(default_factory=lambda: np.empty((0, 0)))


def weights_without_losses(gram: Array, moment: Array, k: FloatArray, ridge: float) -> Weights:
    """Return the weights of least error when every point arrives; gram is used up.

    k gets its nugget.
    """
    np.einsum("ii->i", k)[...] += NUGGET
    gram /= ridge
    gram += k
    lower, _, failed = factorised(gram, _ROUNDING * float(np.trace(gram)), use_up=True)
    beta = np.asarray(cho_solve((lower.T, False), moment / ridge, check_finite=False))
    return Weights(
        beta=beta,
        stack=beta[:, None],
        probability=np.ones(1),
        error_m2=-float(moment @ beta),
        failed_factorisations=failed,
    )


class LossyWeights:
    """Finds the weights of least expected error for the patterns of frames that may be lost."""

    def __init__(self, patterns: LossPatterns, fragment: NDArray[np.intp], ridge: float) -> None:
        self._no_loss = patterns.no_loss
        self._groups = _groups(patterns, fragment)
        self._ridge = ridge

    def steps(self, gram: Array, moment: Array, k: FloatArray) -> Generator[None, None, Weights]:
        """Find them in small steps; the value is the weights. k gets its nugget.

        The points' own K enters through Q, that is through the corrections of the weights.
        """
        lower, nugget, failed = factorised(k, NUGGET)
        np.einsum("ii->i", k)[...] += nugget
        inverse = cho_solve((lower, True), np.eye(len(moment)))
        yield
        blocks = [_Block.of(group, inverse) for group in self._groups]
        beta, failed_again = self._best(gram, moment, inverse, lower, blocks)
        yield
        probability = np.concatenate([[self._no_loss], *(block.probability for block in blocks)])
        lost = [np.zeros((len(beta), 1)), *(block.weights_lost(beta) for block in blocks)]
        correction = inverse @ np.hstack(lost)
        stack = beta[:, None] - correction
        fitted = gram @ stack
        error = self._ridge * float(beta @ k @ beta)
        error += float(probability @ (np.einsum("mp,mp->p", stack, fitted) - 2.0 * moment @ stack))
        pull = 2.0 * probability * (fitted - moment[:, None])
        spread = inverse @ pull
        first = 1
        for block in blocks:
            columns = slice(first, first + len(block.probability))
            pull[:, columns] -= block.padded(block.solved(spread[:, columns]))
            first += len(block.probability)
        by_k = (inverse @ pull) @ correction.T + self._ridge * np.outer(beta, beta)
        return Weights(
            beta=beta,
            stack=stack,
            probability=probability,
            error_m2=error,
            failed_factorisations=failed + failed_again,
            by_k=by_k,
        )

    def _best(
        self, gram: Array, moment: Array, inverse: Array, lower: Array, blocks: "list[_Block]"
    ) -> tuple[Array, int]:
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
        alpha = cho_solve((factor, True), solve_triangular(lower, right, lower=True))
        beta: Array = solve_triangular(lower, alpha, lower=True, trans=1)
        return beta, failed


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
