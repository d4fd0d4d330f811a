"""Defects that simulated faults brought to light; ROBUSTNESS.md names the seeds."""

import numpy as np
import pytest

from firmware.leader.alignment import fields_of
from firmware.leader.screening import prepare
from firmware.submaps import GriddedSubmap


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1)])
def test_a_grid_of_one_row_has_no_slopes_and_stops_no_match(shape: tuple[int, int]) -> None:
    grid = GriddedSubmap(
        north0_m=0.0,
        east0_m=0.0,
        cell_m=2.0,
        depth_m=np.full(shape, 40.0),
        variance_m2=np.full(shape, 0.01),
        time_s=np.zeros(shape),
    )
    layer = prepare(grid)
    assert layer is not None
    fields = fields_of(layer, 0.5)
    assert fields.shape == (7, *shape)
    assert np.isnan(fields).all()
