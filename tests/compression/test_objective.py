"""Gradients and expectations, held against differences and against brute force."""

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from firmware.compression.decoder import point_decoder
from firmware.compression.expected import ExpectedError
from firmware.compression.fitc import Fitc, FitcParameters
from firmware.compression.initial import dealt_fragments
from firmware.compression.kernels import Hyperparameters, Kernel
from firmware.compression.losses import loss_patterns
from firmware.compression.steps import run
from tests.compression.conftest import relief_m

CELLS_M, POINTS_M = np.split(np.random.default_rng(5).uniform(-30.0, 30.0, (540, 2)), [500])
DEPTH_M = relief_m(*CELLS_M.T) - 40.0
FRAGMENT = dealt_fragments(POINTS_M, 10)


def objective(kernel: Kernel, loss: float) -> ExpectedError:
    patterns = loss_patterns(loss, 10)
    return ExpectedError(CELLS_M, DEPTH_M, np.ones(500), kernel, patterns, FRAGMENT, 1e-6)


@pytest.mark.parametrize("loss", [0.0, 0.14])
@pytest.mark.parametrize("kernel", [Kernel.SQUARED_EXPONENTIAL, Kernel.MATERN32])
def test_gradient_of_the_expected_error_is_that_of_differences(kernel: Kernel, loss: float) -> None:
    problem, log_b = objective(kernel, loss), float(np.log(1.0 / 6.0))
    found = problem.evaluate(POINTS_M, log_b)
    turn = np.random.default_rng(7).normal(size=POINTS_M.shape) * 0.02
    ahead, behind = (problem.evaluate(POINTS_M + s * turn, log_b).error_m2 for s in (1.0, -1.0))
    slope = float(np.sum(turn * found.by_position))
    assert (ahead - behind) / 2.0 == pytest.approx(slope, rel=0.05, abs=1e-7)
    ahead, behind = (problem.evaluate(POINTS_M, log_b + s).error_m2 for s in (0.01, -0.01))
    assert (ahead - behind) / 0.02 == pytest.approx(found.by_log_b, rel=0.02, abs=1e-6)


def test_expected_error_is_the_mean_over_all_patterns_of_the_decoder_itself() -> None:
    patterns = loss_patterns(0.14, 10)
    found = objective(Kernel.MATERN32, 0.14).evaluate(POINTS_M, float(np.log(0.08)))
    points = np.column_stack([POINTS_M, found.depth_m])
    hyper = Hyperparameters(
        b_per_m=0.08, c_m2=1.0, sigma2_m2=0.0, mean_depth_m=0.0, kernel=Kernel.MATERN32
    )

    def error_m2(kept: NDArray[np.bool_]) -> float:
        depth_m, _ = point_decoder(points[kept], hyper).predict(CELLS_M)
        return float(np.mean((depth_m - DEPTH_M) ** 2))

    expected = patterns.no_loss * error_m2(np.ones(40, dtype=bool))
    for lost, probability in zip(patterns.lost, patterns.probability, strict=True):
        expected += probability * error_m2(~np.isin(FRAGMENT, lost))
    assert found.error_m2 == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("kernel", list(Kernel))
def test_points_beyond_the_kernels_reach_hardly_change_the_error(kernel: Kernel) -> None:
    rng = np.random.default_rng(8)
    cells_m, points_m = (rng.uniform([0.0, 0.0], [30.0, 600.0], (n, 2)) for n in (2000, 200))
    points_m = points_m[np.argsort(points_m[:, 1])]
    depth_m = relief_m(*cells_m.T) - 40.0
    none = loss_patterns(0.0, 10)
    fragment = np.zeros(200, dtype=np.intp)
    problem = ExpectedError(cells_m, depth_m, np.ones(2000), kernel, none, fragment, 1e-6)
    log_b = float(np.log(kernel.reach / 60.0))
    searched = problem.evaluate(points_m, log_b)
    exact = run(problem.steps(points_m, log_b, gradient=False))
    assert searched.error_m2 == pytest.approx(exact.error_m2, rel=0.01)


def test_probabilities_of_the_patterns_sum_to_one() -> None:
    patterns = loss_patterns(0.2, 10)
    assert patterns.no_loss + patterns.probability.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("kernel", list(Kernel))
def test_fitc_likelihood_is_that_of_the_dense_covariance(kernel: Kernel) -> None:
    parameters = FitcParameters(
        point_m=POINTS_M, log_b=float(np.log(0.1)), log_c=-0.3, log_sigma2=float(np.log(0.02))
    )
    problem = Fitc(CELLS_M, DEPTH_M, kernel)
    found = run(problem.steps(parameters))
    for name, slope in (
        ("log_b", found.by_log_b),
        ("log_c", found.by_log_c),
        ("log_sigma2", found.by_log_sigma2),
    ):
        values = []
        for step in (1e-3, -1e-3):
            moved = dataclasses.replace(parameters, **{name: getattr(parameters, name) + step})
            values.append(run(problem.steps(moved)).value)
        assert (values[0] - values[1]) / 2e-3 == pytest.approx(slope, rel=1e-3, abs=1e-6)
    turn = np.random.default_rng(9).normal(size=POINTS_M.shape) * 1e-3
    values = [
        run(problem.steps(dataclasses.replace(parameters, point_m=POINTS_M + s * turn))).value
        for s in (1.0, -1.0)
    ]
    slope = float(np.sum(turn * found.by_point))
    assert (values[0] - values[1]) / 2.0 == pytest.approx(slope, rel=1e-2)
