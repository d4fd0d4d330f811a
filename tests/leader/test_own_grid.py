"""The leader's own soundings on its grid."""

import numpy as np
import pytest

from firmware.compression.binning import SoundingBins
from firmware.compression.settings import BinningSettings
from firmware.leader.own_grid import grid_of


@pytest.mark.parametrize("bin_m", [0.5, 1.0, 2.0])
def test_a_grid_has_no_holes_however_coarse_the_bins_are(bin_m: float) -> None:
    """Bins as coarse as the grid come of deep water, where their number is bounded."""
    rng = np.random.default_rng(4)
    north_m, east_m = rng.uniform(0.0, 60.0, (2, 60_000))
    bins = SoundingBins(BinningSettings(cell_m=bin_m))
    depth_m = 40.0 + 0.1 * north_m - 0.05 * east_m + 0.05 * rng.standard_normal(north_m.size)
    bins.add(np.column_stack([north_m, east_m, depth_m]), 5.0)
    grid = grid_of(bins.result(), 2.0)
    inner = np.s_[3:27, 3:27]
    at_m = 2.0 * np.arange(60)
    north0, east0 = (int(first_m / 2.0) for first_m in (grid.north0_m, grid.east0_m))
    rows, columns = (
        at_m[n : n + k] for n, k in zip((north0, east0), grid.depth_m.shape, strict=True)
    )
    true_m = 40.0 + 0.1 * rows[:, None] - 0.05 * columns
    assert np.isfinite(grid.depth_m[inner]).all()
    assert np.abs(grid.depth_m - true_m)[inner].max() < 0.1
    assert grid.time_s[inner] == pytest.approx(5.0)


def test_nothing_is_known_of_a_cell_beside_the_soundings() -> None:
    rng = np.random.default_rng(4)
    bins = SoundingBins(BinningSettings(cell_m=2.0))
    north_m, east_m = rng.uniform(0.0, 60.0, (2, 6000))
    bins.add(np.column_stack([north_m, east_m, np.full(6000, 40.0)]), 5.0)
    grid = grid_of(bins.result(), 2.0)
    known = np.isfinite(grid.depth_m)
    assert 0 < np.count_nonzero(~known) < known.size
    assert np.array_equal(np.isfinite(grid.variance_m2), known)
    assert np.array_equal(np.isfinite(grid.time_s), known)
