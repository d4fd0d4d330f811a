"""All closures weighed at once by graduated non-convexity, beside the live estimate.

A few false closures that agree with each other bend an estimate until it contradicts the true ones:
then an audit, which goes by the estimate, takes back the wrong side. Here all of them are asked
again, those that were taken back among them, by a solution that is convex at first and forgives
large innovations more and more: what it ends with has few contradictions, and those are thrown out.

Source: Yang, Antonante, Tzoumas and Carlone, Graduated non-convexity for robust spatial perception,
RA-L 2020: truncated least squares, Eq. 12 to 15. gtsam has it, too, but cannot clone our factors.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from firmware.geometry import Array
from firmware.leader.factors import factor_of, values_of
from firmware.leader.ledger import ClosureRecord, Record

_STEEPER = 1.4  # from round to round, as in the source
_ROUNDS = 60
_FIRST_STEPS, _STEPS = 5, 1  # of Gauss and Newton
_SURE = 0.01  # weights this near to zero or one are taken for it
_LEAST_WEIGHT = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class Doubt:
    """A ledger with closures in doubt, as plain values that a worker may solve.

    believed are the records that are not in doubt, estimate the variables of both. A closure is
    false beyond reject_chi_square; of those that were taken back, beyond accept_chi_square.
    """

    believed: tuple[Record, ...]
    doubted: Mapping[int, ClosureRecord]
    taken_back: frozenset[int]
    estimate: Mapping[int, Array]
    robust_kernel: float
    accept_chi_square: float
    reject_chi_square: float

    def run(self) -> list[int] | None:
        """Return the numbers of the false closures, None if there is no solution."""
        try:
            return self._false()
        except (RuntimeError, ValueError, IndexError):  # gtsam's, of an indeterminate system
            return None

    def _false(self) -> list[int]:
        certain = [factor_of(record, self.robust_kernel) for record in self.believed]
        weights = dict.fromkeys(self.doubted, 1.0)
        values = values_of(self.estimate)
        values = self._solved(certain, weights, values, self.robust_kernel, _FIRST_STEPS)
        squares = self._squares(values)
        if max(squares.values()) > self.reject_chi_square:
            limit = self.reject_chi_square
            convexity = limit / (2.0 * max(squares.values()) - limit)
            for _ in range(_ROUNDS):
                weights = {n: self._weight(square, convexity) for n, square in squares.items()}
                values = self._solved(certain, weights, values, np.inf, _STEPS)
                squares = self._squares(values)
                if all(weight < _SURE or weight > 1.0 - _SURE for weight in weights.values()):
                    break
                convexity *= _STEEPER
        return [
            number
            for number, weight in weights.items()
            if weight < 0.5
            or (number in self.taken_back and squares[number] > self.accept_chi_square)
        ]

    def _weight(self, square: float, convexity: float) -> float:
        """Return the weight of a squared innovation (Eq. 14 of the source)."""
        limit = self.reject_chi_square
        if square <= convexity / (convexity + 1.0) * limit:
            return 1.0
        if square >= (convexity + 1.0) / convexity * limit:
            return 0.0
        return float(np.sqrt(limit * convexity * (convexity + 1.0) / square) - convexity)

    def _solved(
        self,
        certain: list[gtsam.NonlinearFactor],
        weights: Mapping[int, float],
        values: gtsam.Values,
        robust_kernel: float,
        steps: int,
    ) -> gtsam.Values:
        graph = gtsam.NonlinearFactorGraph()
        for factor in certain:
            graph.push_back(factor)
        for number, weight in weights.items():
            if weight > _LEAST_WEIGHT:
                record = self.doubted[number]
                wider = replace(record, covariance_m2=record.covariance_m2 / weight)
                graph.push_back(factor_of(wider, robust_kernel))
        parameters = gtsam.GaussNewtonParams()
        parameters.setLinearSolverType("MULTIFRONTAL_QR")
        parameters.setMaxIterations(steps)
        return gtsam.GaussNewtonOptimizer(graph, values, parameters).optimize()

    def _squares(self, values: gtsam.Values) -> dict[int, float]:
        return {n: record.chi_square(values.atVector) for n, record in self.doubted.items()}
