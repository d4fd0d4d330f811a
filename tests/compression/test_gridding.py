"""A fine grid costs no more than the points can tell apart, and says the same."""

import tracemalloc

import numpy as np
import pytest

from firmware.compression.decoder import PointDecoder, point_decoder
from firmware.compression.kernels import Hyperparameters, Kernel
from firmware.geometry import Array
from firmware.leader.gridding import gridded
from tests.compression.conftest import relief_m


@pytest.fixture(scope="module")
def decoder() -> PointDecoder:
    even_m = np.stack(np.meshgrid(np.arange(-38, 39, 5), np.arange(-58, 59, 6)), -1).reshape(-1, 2)
    places_m = even_m + np.random.default_rng(4).uniform(-1.5, 1.5, even_m.shape)
    points = np.column_stack([places_m, relief_m(*places_m.T)])
    hyper = Hyperparameters(
        b_per_m=0.1, c_m2=0.1, sigma2_m2=0.02, mean_depth_m=40.0, kernel=Kernel.MATERN32
    )
    return point_decoder(points, hyper)


@pytest.mark.parametrize("cell_m", [0.5, 1.0, 2.0])
def test_grid_is_that_of_asking_every_cell(decoder: PointDecoder, cell_m: float) -> None:
    north_m = np.arange(-38.0, 38.0, cell_m)
    east_m = np.arange(-57.0, 57.0, cell_m)
    inside = np.hypot(*np.meshgrid(north_m, east_m, indexing="ij")) < 36.0
    depth_m, variance_m2 = gridded(decoder, north_m, east_m, inside)
    row, column = np.nonzero(inside)
    asked = decoder.predict(np.column_stack([north_m[row], east_m[column]]))
    assert np.sqrt(np.mean((depth_m[inside] - asked[0]) ** 2)) < 0.02  # m, of a sigma of 0.2
    np.testing.assert_allclose(np.sqrt(variance_m2[inside]), np.sqrt(asked[1]), rtol=0.1)
    assert np.isnan(depth_m[~inside]).all()
    assert np.isinf(variance_m2[~inside]).all()


def test_a_fine_grid_asks_the_points_far_less_often_than_it_has_cells(
    decoder: PointDecoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = 0
    predict = PointDecoder.predict

    def counting(self: PointDecoder, position_m: Array) -> tuple[Array, Array]:
        nonlocal asked
        asked += len(position_m)
        return predict(self, position_m)

    monkeypatch.setattr(PointDecoder, "predict", counting)
    axis_m: Array = np.arange(-30.0, 30.0, 0.5)
    gridded(decoder, axis_m, axis_m, np.ones((120, 120), dtype=bool))
    assert 0 < asked < 120 * 120 / 5


@pytest.mark.parametrize(
    "kernel", [Kernel.SQUARED_EXPONENTIAL, Kernel.MATERN32, Kernel.EXPONENTIAL]
)
@pytest.mark.parametrize("spacings", [0.2, 0.5, 1.0, 2.0])
def test_kernels_shorter_than_the_spacing_are_asked_as_often_as_they_vary(
    decoder: PointDecoder, kernel: Kernel, spacings: float
) -> None:
    hyper = Hyperparameters(
        b_per_m=1.0 / (5.5 * spacings), c_m2=0.25, sigma2_m2=0.02, mean_depth_m=40.0, kernel=kernel
    )
    rough = point_decoder(np.column_stack([decoder.points_m, relief_m(*decoder.points_m.T)]), hyper)
    axis_m: Array = np.arange(-30.0, 30.0, 1.0)
    inside = np.ones((60, 60), dtype=bool)
    depth_m, variance_m2 = gridded(rough, axis_m, axis_m, inside)
    row, column = np.nonzero(inside)
    asked = rough.predict(np.column_stack([axis_m[row], axis_m[column]]))
    assert np.abs(depth_m[inside] - asked[0]).max() < 0.06
    np.testing.assert_allclose(np.sqrt(variance_m2[inside]), np.sqrt(asked[1]), rtol=0.4)


def test_a_point_far_away_costs_no_memory_for_the_way_there(decoder: PointDecoder) -> None:
    north_m: Array = np.arange(0.0, 60_000.0, 1.0)
    tracemalloc.start()
    gridded(decoder, north_m, np.array([0.0]), np.ones((60_000, 1), dtype=bool))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 400e6  # a dense matrix of 60,000 cells and 20,000 nodes has 9.6 GB


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1)])
def test_a_grid_of_one_row_is_whole(decoder: PointDecoder, shape: tuple[int, int]) -> None:
    north_m: Array = 0.7 * np.arange(shape[0], dtype=np.float64)
    east_m: Array = 0.7 * np.arange(shape[1], dtype=np.float64)
    everywhere = np.ones(shape, dtype=bool)
    depth_m, _ = gridded(decoder, north_m, np.asarray(east_m), everywhere)
    assert np.isfinite(depth_m).all()
