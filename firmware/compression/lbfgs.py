"""Limited-memory BFGS whose objective is a generator, so that a fit never holds up a ping."""

from collections import deque
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from firmware.geometry import Array

T = TypeVar("T")
_PAIRS = 30  # of past steps; more brings nothing within tens of evaluations
_SUFFICIENT = 1e-4  # Armijo
_SHORTENINGS = 8  # of one step, then the search has failed
_REMEMBERED = 0.8  # of the sums that tell each variable's curvature, from step to step
_LEAST_CURVATURE = 0.1  # of a variable, in medians: below it one step says too little
_MOST_CURVATURE = 1e4  # nor that a variable which hardly moved is stiff beyond measure


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial(Generic[T]):
    """One evaluation: the value, its gradient, and whatever the objective wants remembered."""

    value: float
    gradient: Array
    payload: T


@dataclass(frozen=True, slots=True, kw_only=True)
class Improvement(Generic[T]):
    """A lower value than any before, and the evaluations it took so far."""

    value: float
    payload: T
    evaluations: int


def minimise_steps(
    objective: Callable[[Array], Generator[None, None, Trial[T]]],
    start: Array,
    *,
    evaluations: int,
    first_move: float,
    largest_move: float,
    tolerance: float = 2e-4,
) -> Generator[Improvement[T] | None, None, str]:
    """Yield improvements, and None between small steps; the generator's value says why it ended.

    first_move and largest_move bound the change of any coordinate in the first step and in all.
    The end is "budget", "converged" (three steps in a row gained less than `tolerance` of the
    value) or "line search" (no step along the gradient helps: the numbers are exhausted).
    """
    current = yield from objective(start)
    x, used, idle = start, 1, 0
    yield Improvement(value=current.value, payload=current.payload, evaluations=used)
    past = _Past()
    while used < evaluations:
        direction = -past.times_inverse_hessian(current.gradient)
        slope = float(direction @ current.gradient)
        if slope >= 0.0:
            past.pairs.clear()
            direction, slope = -current.gradient, -float(current.gradient @ current.gradient)
        reach = float(np.abs(direction).max())
        if not np.isfinite(reach) or reach == 0.0:
            return "converged"
        step = min(1.0, largest_move / reach) if past.pairs else first_move / reach
        for _ in range(_SHORTENINGS):
            trial = yield from objective(x + step * direction)
            used += 1
            if trial.value <= current.value + _SUFFICIENT * step * slope:
                break
            if used >= evaluations:
                return "budget"
            curve = trial.value - current.value - step * slope
            shorter = -0.5 * slope * step / curve if np.isfinite(curve) and curve > 0 else 0.25
            step *= min(max(shorter, 0.1), 0.5)
        else:
            if not past.pairs:
                return "line search"
            past.pairs.clear()
            continue
        change, turn = step * direction, trial.gradient - current.gradient
        if change @ turn > 1e-12 * (turn @ turn):
            past.add(change, turn)
        gained = current.value - trial.value
        idle = idle + 1 if gained < tolerance * abs(trial.value) else 0
        x, current = x + change, trial
        yield Improvement(value=current.value, payload=current.payload, evaluations=used)
        if idle >= 3:
            return "converged"
    return "budget"


class _Past:
    """Steps and how the gradient turned in them, and the inverse Hessian that they tell of.

    What they leave open is taken for diagonal: in each variable the geometric mean of its own
    curvature, by the root mean squares of its turns and steps, and of one for all. Variables far
    stiffer than others otherwise cost half as many steps more.
    """

    def __init__(self) -> None:
        self.pairs: deque[tuple[Array, Array]] = deque(maxlen=_PAIRS)
        self._squares: Array | None = None  # (2, N) recent sums of turn^2 and change^2

    def add(self, change: Array, turn: Array) -> None:
        """Remember a step along which the curvature is positive."""
        self.pairs.append((change, turn))
        squares = np.stack([turn**2, change**2])
        before = 0.0 if self._squares is None else _REMEMBERED * self._squares
        self._squares = before + squares

    def times_inverse_hessian(self, gradient: Array) -> Array:
        """Return the two-loop product with the gradient."""
        out = gradient.copy()
        shares = []
        for change, turn in reversed(self.pairs):
            share = float(change @ out) / float(change @ turn)
            out -= share * turn
            shares.append(share)
        if self.pairs:
            change, turn = self.pairs[-1]
            diagonal = self._inverse_diagonal()
            out *= float(change @ turn) / float(turn @ (diagonal * turn)) * diagonal
        for (change, turn), share in zip(self.pairs, reversed(shares), strict=True):
            out += (share - float(turn @ out) / float(change @ turn)) * change
        return out

    def _inverse_diagonal(self) -> Array:
        """Return the inverse diagonal (N,) but for its scale."""
        assert self._squares is not None
        turned, changed = self._squares + np.finfo(float).tiny
        curvature = np.sqrt(turned / changed)
        usual = np.median(curvature)
        curvature = np.clip(curvature, _LEAST_CURVATURE * usual, _MOST_CURVATURE * usual)
        return np.asarray(1.0 / np.sqrt(curvature))
