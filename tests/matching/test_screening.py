import dataclasses

import numpy as np
import pytest

from firmware.geometry import Array
from firmware.leader.alignment import fields_of
from firmware.leader.screening import Layer, error_at, error_surface, prepare
from firmware.submaps import GriddedSubmap
from tests.matching.scenes import Scene


def layer_of(grid: GriddedSubmap, *, reconstructed: bool = False) -> Layer:
    layer = prepare(dataclasses.replace(grid, reconstructed=reconstructed))
    assert layer is not None
    return layer


def with_holes(grid: GriddedSubmap, rng: np.random.Generator, share: float) -> GriddedSubmap:
    depth = np.where(rng.random(grid.depth_m.shape) < share, np.nan, grid.depth_m)
    variance = rng.uniform(0.001, 0.1, grid.depth_m.shape)
    return dataclasses.replace(grid, depth_m=depth, variance_m2=variance)


def brute_force(reference: Layer, query: Layer, minimum_cells: float, ridge: float) -> Array:
    """Return E by two loops over shifts and nothing clever."""
    rows, cols = reference.known.shape
    q_rows, q_cols = query.known.shape
    errors = np.full((rows + q_rows - 1, cols + q_cols - 1), np.inf)
    for k in range(1 - q_rows, rows):
        for j in range(1 - q_cols, cols):
            r = np.s_[max(0, k) : min(rows, k + q_rows), max(0, j) : min(cols, j + q_cols)]
            q = np.s_[max(0, -k) : min(q_rows, rows - k), max(0, -j) : min(q_cols, cols - j)]
            both = (reference.known[r] > 0) & (query.known[q] > 0)
            if both.sum() <= minimum_cells:
                continue
            d = (reference.grid.depth_m[r] - query.grid.depth_m[q])[both]
            w = (reference.weight[r] * query.weight[q])[both]
            d = d - (w @ d) / (w.sum() + ridge)
            errors[k + q_rows - 1, j + q_cols - 1] = (w @ d**2) / both.sum()
    return errors


@pytest.mark.parametrize("reconstructed", [False, True])
@pytest.mark.parametrize("ridge", [np.inf, 0.0, 3.0])
def test_fft_surface_equals_brute_force(scene: Scene, reconstructed: bool, ridge: float) -> None:
    rng = np.random.default_rng(1)
    reference = layer_of(with_holes(scene.submap(100, 100, (24, 31)), rng, 0.2))
    query = layer_of(
        with_holes(scene.submap(110, 120, (17, 22)), rng, 0.1), reconstructed=reconstructed
    )
    surface = error_surface(reference, query, 60.0, ridge)
    expected = brute_force(reference, query, 60.0, ridge)
    assert np.array_equal(np.isfinite(surface.residual_m2), np.isfinite(expected))
    known = np.isfinite(expected)
    assert np.abs(surface.residual_m2[known] - expected[known]).max() < 1e-9
    assert np.argmin(surface.residual_m2) == np.argmin(expected)


def test_depths_of_kilometres_do_not_cost_precision(scene: Scene) -> None:
    shallow = scene.submap(100, 100, (20, 20))
    deep = dataclasses.replace(shallow, depth_m=shallow.depth_m + 6000.0)
    query = scene.submap(104, 108, (20, 20))
    deep_query = dataclasses.replace(query, depth_m=query.depth_m + 6000.0)
    near = error_surface(layer_of(shallow), layer_of(query), 60.0, 0.0).residual_m2
    far = error_surface(layer_of(deep), layer_of(deep_query), 60.0, 0.0).residual_m2
    known = np.isfinite(near)
    assert np.allclose(near[known], far[known], atol=1e-8)


def test_interpolated_error_agrees_with_the_surface_on_the_lattice(scene: Scene) -> None:
    reference = layer_of(scene.submap(100, 100, (24, 31)))
    query = layer_of(scene.submap(110, 120, (17, 22)), reconstructed=True)
    surface = error_surface(reference, query, 60.0, 2.0)
    for row, col in [(20, 25), (28, 30), (15, 40)]:
        shift = np.array([surface.north_m[row], surface.east_m[col]])
        error, count, offset = error_at(reference, query, shift, 60.0, 2.0)
        assert error == pytest.approx(surface.residual_m2[row, col], abs=1e-9)
        assert count == surface.overlap_cells[row, col]
        assert offset == pytest.approx(surface.depth_offset_m[row, col], abs=1e-9)


def test_overlap_at_the_threshold_is_infinite(scene: Scene) -> None:
    reference = layer_of(scene.submap(100, 100, (20, 20)))
    query = layer_of(scene.submap(100, 100, (10, 12)))
    aligned = np.zeros(2)
    assert error_at(reference, query, aligned, 120.0, 0.0)[0] == np.inf
    assert np.isfinite(error_at(reference, query, aligned, 119.0, 0.0)[0])


def test_absolute_norm_is_the_mean_distance(scene: Scene) -> None:
    reference = layer_of(scene.submap(100, 100, (20, 20), sigma_m=0.0))
    query = layer_of(scene.submap(100, 100, (20, 20), sigma_m=0.0, offset_m=0.3))
    error, _, _ = error_at(reference, query, np.zeros(2), 120.0, np.inf, absolute=True)
    assert error == pytest.approx(0.3)


def test_empty_grid_has_no_layer(scene: Scene) -> None:
    grid = scene.submap(100, 100, (20, 20))
    empty = dataclasses.replace(grid, depth_m=np.full((20, 20), np.nan))
    assert prepare(empty) is None


def test_slopes_at_an_edge_are_those_of_the_seabed(scene: Scene) -> None:
    def tilted(north: Array, east: Array) -> Array:
        return 40.0 + 0.03 * north - 0.1 * east

    ragged = scene.submap(200, 200, (21, 30), sigma_m=0.0, relief=tilted)
    ragged = dataclasses.replace(ragged, variance_m2=np.full((21, 30), 1e-4))
    ragged.depth_m[18:, 10:20] = np.nan
    ragged.depth_m[:, :2] = np.nan
    fields = fields_of(layer_of(ragged), 2.0)
    slopes = fields[3:7, np.isfinite(fields[0])]
    assert slopes.shape == (4, 558)
    assert np.abs(slopes - np.array([[0.03], [-0.1], [0.03], [-0.1]])).max() < 1e-6
