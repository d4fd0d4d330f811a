"""A Micro-Modem's packet of two frames is lost: the map thins evenly, no hole opens."""

import itertools

import numpy as np
import pytest

from firmware.compression import compress, packets_from
from firmware.compression.packing import submap_header
from firmware.compression.settings import CompressionSettings
from firmware.geometry import Array
from firmware.leader.reconstruction import ReconstructionSettings, reconstruct_packets
from tests.compression.conftest import Survey, relief_m


@pytest.mark.parametrize("parity", [True, False])
def test_a_lost_pair_costs_no_more_than_any_other_two_frames(survey: Survey, parity: bool) -> None:
    settings = CompressionSettings(parity=parity, iterations=8)
    packets = packets_from(compress(survey.bins, settings), survey.track, submap_header())

    def rmse_m(lost: tuple[int, ...]) -> float:
        arrived = {p.header.fragment: p for p in packets if p.header.fragment not in lost}
        grid = reconstruct_packets(arrived, ReconstructionSettings(), 40.0).grid
        cells: Array = np.indices(grid.depth_m.shape).astype(np.float64)
        north_m: Array = grid.north0_m + grid.cell_m * cells[0]
        east_m: Array = grid.east0_m + grid.cell_m * cells[1]
        return float(np.sqrt(np.nanmean((grid.depth_m - relief_m(north_m, east_m)) ** 2)))

    pairs = [rmse_m((k, k + 1)) for k in range(0, 10, 2)]
    others = [rmse_m(two) for two in itertools.combinations(range(0, 10, 2), 2)]
    assert np.mean(pairs) <= 1.1 * np.mean(others)
    assert max(pairs) <= 1.25 * max(others)
