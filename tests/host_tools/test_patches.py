import numpy as np
import pytest

from firmware.submaps import GriddedSubmap
from host_tools.patches import patch_of_grid
from host_tools.simulator.placement import Window


def window(cell_m: float) -> Window:
    return Window(
        top_row=0,
        left_column=0,
        rows=50,
        columns=50,
        north0_m=0.0,
        east0_m=0.0,
        cell_north_m=cell_m,
        cell_east_m=cell_m,
    )


def grid() -> GriddedSubmap:
    north, east = np.meshgrid(np.arange(6.0), np.arange(5.0), indexing="ij")
    variance_m2 = np.full(north.shape, 0.02)
    variance_m2[5] = 0.2
    depth_m = 40 + north + 0.5 * east
    depth_m[:, 0] = np.nan
    return GriddedSubmap(
        north0_m=10.0,
        east0_m=20.0,
        cell_m=2.0,
        depth_m=depth_m,
        variance_m2=variance_m2,
        time_s=100 + north,
    )


def test_patch_of_a_coarse_map_holds_the_known_cells_as_they_are() -> None:
    patch = patch_of_grid(1, grid(), window(5.0))
    assert patch.depth_m.size == 6 * 4
    np.testing.assert_allclose(
        patch.depth_m, 40 + (patch.north_m - 10) / 2 + 0.25 * (patch.east_m - 20)
    )
    np.testing.assert_allclose(patch.time_s, 100 + (patch.north_m - 10) / 2)
    assert set(patch.variance_m2.tolist()) == {0.02, 0.2}  # as from high above the seabed


def test_patch_of_a_fine_map_is_interpolated_without_gaining_information() -> None:
    patch = patch_of_grid(1, grid(), window(0.5))
    assert np.diff(np.unique(patch.north_m)).max() == pytest.approx(0.5)
    np.testing.assert_allclose(
        patch.depth_m, 40 + (patch.north_m - 10) / 2 + 0.25 * (patch.east_m - 20)
    )
    coarse = patch_of_grid(1, grid(), window(5.0))
    assert np.sum(1 / patch.variance_m2) <= 1.01 * np.sum(1 / coarse.variance_m2)
