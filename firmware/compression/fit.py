"""The fit of pseudo points through the leader's own decoder, for the losses to expect."""

import dataclasses
from collections.abc import Callable, Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware.compression.expected import Evaluation, ExpectedError
from firmware.compression.initial import Outline, dealt_fragments, initial_point_steps, main_axis
from firmware.compression.kernels import Kernel
from firmware.compression.lbfgs import Improvement, Trial, minimise_steps
from firmware.compression.losses import LossPatterns, loss_patterns
from firmware.compression.settings import CompressionSettings
from firmware.compression.steps import Steps
from firmware.geometry import Array
from firmware.submaps import BinnedSoundings

_FIRST_SCALE = {Kernel.SQUARED_EXPONENTIAL: 0.6, Kernel.MATERN32: 1.2, Kernel.EXPONENTIAL: 2.4}
"""Length scale at first, in spacings of the points; the search soon finds a better one."""
_TRIAL_ROWS = 1024  # rows that choose the kernel: a third, for a third of the time
_OUTSIDE_PRICE = 1.0  # of leaving the cells' outline by a spacing, in shares of the variance
_SHORTEST, _LONGEST = 0.2, 30.0  # length scale in spacings: between no and full correlation


@dataclass(frozen=True, slots=True, kw_only=True)
class FittedPoints:
    """A state of the fit: positions (M, 2) and depths (M,) about the frame, and their kernel."""

    position_m: Array
    depth_m: Array
    fragment: NDArray[np.intp]
    patterns: LossPatterns
    b_per_m: float
    kernel: Kernel
    error_m2: float
    evaluations: int
    failed_factorisations: int
    c_m2: float = 1.0
    sigma2_m2: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FitFrame:
    """The cells to be fitted, centred: position (K, 2), depth (K,), weight (K,)."""

    position_m: Array
    depth_m: Array
    weight: Array
    origin_m: Array
    mean_depth_m: float
    ridge: float


def fit_frame(bins: BinnedSoundings, max_rows: int, about: FitFrame | None = None) -> FitFrame:
    """Return the cells about their centre, or another frame's, weighted by how well each is known.

    The ridge is the noise of a cell over the variance of depth, as in the regression of Eq. 5.
    """
    position_m = np.column_stack([bins.north_m, bins.east_m])
    every = max(1, -(-len(position_m) // max_rows))
    position_m, depth_m = position_m[::every], bins.depth_m[::every]
    variance_m2 = np.maximum(bins.variance_m2[::every], 1e-6)
    origin_m = about.origin_m if about else np.median(position_m, axis=0)
    mean_depth_m = about.mean_depth_m if about else float(np.float32(depth_m.mean()))
    typical = float(np.median(variance_m2))
    spread = max(float(depth_m.var()), 1e-6)
    return FitFrame(
        position_m=position_m - origin_m,
        depth_m=depth_m - mean_depth_m,
        weight=2.0 / (1.0 + np.minimum(variance_m2 / typical, 20.0)),
        origin_m=origin_m,
        mean_depth_m=mean_depth_m,
        ridge=min(typical / spread, 1.0) / len(depth_m),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Dealing:
    """Which fragment (M,) each point travels in, and which of them may be lost."""

    fragment: NDArray[np.intp]
    patterns: LossPatterns


Dealer = Callable[[Array], Dealing]


def dealt_evenly(fragments: int, settings: CompressionSettings) -> Dealer:
    """Return a dealer of neighbours to different fragments, any of which may be lost.

    With parity, losses leave no trace on the points, so none are trained for.
    """
    loss = 0.0 if settings.parity else settings.expected_loss

    def deal(position_m: Array) -> Dealing:
        return Dealing(
            fragment=dealt_fragments(position_m, fragments),
            patterns=loss_patterns(loss, fragments),
        )

    return deal


_State = tuple[Array, float, Evaluation]  # positions (M, 2), log b, and what they give


class _Search:
    """Positions and length scale as one vector in spacings and e-folds, and the error there."""

    def __init__(
        self,
        frame: FitFrame,
        start_m: Array,
        held: NDArray[np.bool_],
        dealing: Dealing,
        kernel: Kernel,
        log_b: float,
        reach_share: float,
    ) -> None:
        self._start_m, self._free, self._dealing, self._kernel = start_m, ~held, dealing, kernel
        self._spacing_m = spacing_of(start_m)
        self._lowest = float(np.log(1.0 / (_LONGEST * self._spacing_m)))
        self._highest = float(np.log(1.0 / (_SHORTEST * self._spacing_m)))
        self._outline = Outline.of(frame.position_m)
        self._problem = ExpectedError(
            frame.position_m,
            frame.depth_m,
            frame.weight,
            kernel,
            dealing.patterns,
            dealing.fragment,
            frame.ridge,
            reach_share=reach_share,
        )
        self.start = np.append(np.zeros(2 * np.count_nonzero(~held)), log_b)

    def _unpacked(self, x: Array) -> tuple[Array, float]:
        point_m = self._start_m.copy()
        point_m[self._free] += self._spacing_m * x[:-1].reshape(-1, 2)
        return point_m, float(np.clip(x[-1], self._lowest, self._highest))

    def objective(self, x: Array) -> Generator[None, None, Trial[_State]]:
        """Evaluate the expected error, and the price of points that left the cells' outline."""
        point_m, log_b = self._unpacked(x)
        result = yield from self._problem.steps(point_m, log_b)
        outside, by_outside = self._outline.excess(point_m[self._free])
        price = self._problem.total_m2 * _OUTSIDE_PRICE / self._spacing_m**2 / len(point_m)
        by_position = result.by_position[self._free] + price * by_outside
        by_x = np.append(self._spacing_m * by_position.ravel(), result.by_log_b)
        if not self._lowest < x[-1] < self._highest:
            by_x[-1] = 0.0
        value = result.error_m2 + price * outside
        return Trial(value=value, gradient=by_x, payload=(point_m, log_b, result))

    def fitted(self, step: Improvement[_State]) -> FittedPoints:
        """Return the points of an improvement."""
        point_m, log_b, result = step.payload
        return FittedPoints(
            position_m=point_m,
            depth_m=result.depth_m,
            fragment=self._dealing.fragment,
            patterns=self._dealing.patterns,
            b_per_m=float(np.exp(log_b)),
            kernel=self._kernel,
            error_m2=step.value,
            evaluations=step.evaluations,
            failed_factorisations=self._problem.failed_factorisations,
        )


def fit_steps(
    frame: FitFrame,
    count: int,
    settings: CompressionSettings,
    deal: Dealer,
    iterations: int | None = None,
    reach_share: float = 1.0,
) -> Generator[FittedPoints | None, None, str]:
    """Yield ever better fits, and None between small steps; the value says why it ended.

    The search may look at a share of the kernel's reach only: the shorter, the sooner an
    evaluation is done and the sooner more of them bring nothing.
    """
    start_m, on_rim = yield from initial_point_steps(frame.position_m, frame.depth_m, count)
    yield None
    order = np.argsort(start_m @ main_axis(frame.position_m), kind="stable")
    start_m, held = start_m[order], order < on_rim
    dealing = deal(start_m)
    yield None
    kernel, log_b = yield from _choose(frame, start_m, dealing, settings)
    search = _Search(frame, start_m, held, dealing, kernel, log_b, reach_share)
    steps = Steps(
        minimise_steps(
            search.objective,
            search.start,
            evaluations=max(settings.iterations if iterations is None else iterations, 1),
            first_move=0.2,
            largest_move=0.5,
        )
    )
    for step in steps:
        yield None if step is None else search.fitted(step)
    return steps.value


def moved_steps(
    fitted: FittedPoints, position_m: Array, frame: FitFrame, reach_share: float = 1.0
) -> Generator[None, None, FittedPoints]:
    """Move the points to positions (M, 2); the generator's value has the best depths there."""
    problem = ExpectedError(
        frame.position_m,
        frame.depth_m,
        frame.weight,
        fitted.kernel,
        fitted.patterns,
        fitted.fragment,
        frame.ridge,
        keep_rows=False,
        reach_share=reach_share,
    )
    log_b = float(np.log(fitted.b_per_m))
    result = yield from problem.steps(position_m, log_b, gradient=False)
    return dataclasses.replace(
        fitted, position_m=position_m, depth_m=result.depth_m, error_m2=result.error_m2
    )


def _choose(
    frame: FitFrame, point_m: Array, dealing: Dealing, settings: CompressionSettings
) -> Generator[None, None, tuple[Kernel, float]]:
    """Return the kernel, of several that of least expected error, and its first log b."""
    spacing_m = spacing_of(point_m)
    kernels = list(Kernel) if settings.kernel == "auto" else [Kernel[settings.kernel.upper()]]
    log_b = {kernel: -np.log(_FIRST_SCALE[kernel] * spacing_m) for kernel in kernels}
    if len(kernels) == 1:
        return kernels[0], log_b[kernels[0]]
    every = max(1, len(frame.depth_m) // _TRIAL_ROWS)
    best = np.inf, kernels[0]
    for kernel in kernels:
        problem = ExpectedError(
            frame.position_m[::every],
            frame.depth_m[::every],
            frame.weight[::every],
            kernel,
            dealing.patterns,
            dealing.fragment,
            frame.ridge * every,
        )
        result = yield from problem.steps(point_m, log_b[kernel], gradient=False)
        best = min(best, (result.error_m2, kernel))
    return best[1], log_b[best[1]]


def spacing_of(point_m: Array) -> float:
    """Return the spacing in m of the points (M, 2) if they were spread evenly."""
    span_m = np.maximum(np.ptp(point_m, axis=0), 1e-3)
    return max(float(np.sqrt(span_m[0] * span_m[1] / len(point_m))), 0.05)
