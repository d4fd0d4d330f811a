import numpy as np
import pytest

from firmware.leader.warping import bilinear, remove_drift
from firmware.submaps import GriddedSubmap


def drifted_grid(drift_mps: tuple[float, float]) -> GriddedSubmap:
    """Return a smooth seabed as a drifting vehicle that sails north at 2 m/s lays it down."""
    rows, cols, cell = 50, 30, 2.0
    north, east = np.meshgrid(cell * np.arange(rows), cell * np.arange(cols), indexing="ij")
    time_s = north / (2.0 + drift_mps[0])
    true_n, true_e = north - drift_mps[0] * time_s, east - drift_mps[1] * time_s
    return GriddedSubmap(
        north0_m=0.0,
        east0_m=0.0,
        cell_m=cell,
        depth_m=seabed(true_n, true_e),
        variance_m2=np.full(north.shape, 0.01),
        time_s=time_s,
    )


def seabed(north: np.ndarray, east: np.ndarray) -> np.ndarray:
    return 40.0 + np.sin(north / 15.0) + np.cos(east / 11.0)


@pytest.mark.parametrize("drift_mps", [(0.14, 0.0), (0.0, -0.14), (-0.1, 0.1)])
def test_removed_drift_leaves_the_true_seabed(drift_mps: tuple[float, float]) -> None:
    mended = remove_drift(drifted_grid(drift_mps), *drift_mps, reference_time_s=0.0)
    rows, cols = mended.depth_m.shape
    north = mended.north0_m + mended.cell_m * np.arange(rows)
    east = mended.east0_m + mended.cell_m * np.arange(cols)
    truth = seabed(*np.meshgrid(north, east, indexing="ij"))
    known = np.isfinite(mended.depth_m)
    assert known.mean() > 0.85
    assert np.abs(mended.depth_m - truth)[known].max() < 0.02
    assert np.isfinite(mended.time_s[known]).all()


def test_no_drift_returns_the_same_grid() -> None:
    grid = drifted_grid((0.0, 0.0))
    assert remove_drift(grid, 0.0, 0.0, 20.0) is grid


def test_bilinear_returns_cells_beside_unknown_ones_and_nothing_between() -> None:
    values = np.array([[1.0, 2.0], [np.nan, 4.0]])
    row, col = np.array([0.0, 0.0, 0.5, -1.0]), np.array([0.0, 0.5, 0.5, 0.0])
    result = bilinear(values, row, col)
    assert result[0] == 1.0
    assert result[1] == 1.5
    assert np.isnan(result[2:]).all()
