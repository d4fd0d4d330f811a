"""The fit of the paper: positions and hyperparameters by the likelihood of Eq. (1)."""

from collections.abc import Generator

import numpy as np

from firmware.compression.fit import Dealer, FitFrame, FittedPoints, spacing_of
from firmware.compression.fitc import Fitc, FitcEvaluation, FitcParameters
from firmware.compression.initial import initial_point_steps
from firmware.compression.kernels import Kernel
from firmware.compression.lbfgs import Trial, minimise_steps
from firmware.compression.settings import CompressionSettings
from firmware.compression.steps import Steps
from firmware.geometry import Array

_LOG_RANGE = 12.0  # of c and sigma^2 about the variance of depth: e^-12 of it is below any noise


_State = tuple[FitcParameters, FitcEvaluation]


class _Search:
    """Positions and hyperparameters as one vector, and the likelihood there."""

    def __init__(self, frame: FitFrame, start_m: Array, settings: CompressionSettings) -> None:
        self._start_m = start_m
        self._spacing_m = spacing_of(start_m)
        self.kernel = Kernel.SQUARED_EXPONENTIAL
        if settings.kernel != "auto":
            self.kernel = Kernel[settings.kernel.upper()]
        self.problem = Fitc(frame.position_m, frame.depth_m, self.kernel)
        log_c = float(np.log(max(frame.depth_m.var(), 1e-8)))
        self._logs = np.array([-np.log(2.0 * self._spacing_m), log_c, log_c - np.log(20.0)])
        self.start = np.zeros(2 * len(start_m) + 3)

    def _parameters(self, x: Array) -> FitcParameters:
        logs = self._logs + np.clip(x[-3:], [-3.0, -_LOG_RANGE, -_LOG_RANGE], [3.0, 3.0, 3.0])
        return FitcParameters(
            point_m=self._start_m + self._spacing_m * x[:-3].reshape(-1, 2),
            log_b=float(logs[0]),
            log_c=float(logs[1]),
            log_sigma2=float(logs[2]),
        )

    def objective(self, x: Array) -> Generator[None, None, Trial[_State]]:
        """Evaluate the negative log likelihood."""
        parameters = self._parameters(x)
        result = yield from self.problem.steps(parameters)
        logs = [result.by_log_b, result.by_log_c, result.by_log_sigma2]
        gradient = np.concatenate([self._spacing_m * result.by_point.ravel(), logs])
        return Trial(value=result.value, gradient=gradient, payload=(parameters, result))


def fitc_steps(
    frame: FitFrame, count: int, settings: CompressionSettings, deal: Dealer
) -> Generator[FittedPoints | None, None, str]:
    """Yield ever likelier fits, and None between small steps; the value says why it ended."""
    start_m, _ = yield from initial_point_steps(frame.position_m, frame.depth_m, count)
    yield None
    search, dealing = _Search(frame, start_m, settings), deal(start_m)
    steps = Steps(
        minimise_steps(
            search.objective,
            search.start,
            evaluations=max(settings.iterations, 1),
            first_move=0.1,
            largest_move=0.5,
            tolerance=1e-5,
        )
    )
    for step in steps:
        if step is None:
            yield None
            continue
        found, result = step.payload
        yield FittedPoints(
            position_m=found.point_m,
            depth_m=result.depth_m,
            fragment=dealing.fragment,
            patterns=dealing.patterns,
            b_per_m=float(np.exp(found.log_b)),
            kernel=search.kernel,
            error_m2=step.value,
            evaluations=step.evaluations,
            failed_factorisations=search.problem.failed_factorisations,
            c_m2=float(np.exp(found.log_c)),
            sigma2_m2=float(np.exp(found.log_sigma2)),
        )
    return steps.value
