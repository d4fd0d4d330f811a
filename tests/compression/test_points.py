"""The paper's profile: fit, packets, and the way back."""

import itertools

import numpy as np
import pytest

from firmware.compression import (
    Compressed,
    CompressedPoints,
    compress,
    compress_steps,
    fragment_points,
    packets_from,
)
from firmware.compression.packing import states_by_second, submap_header
from firmware.compression.settings import CompressionSettings
from firmware.leader.reconstruction import ReconstructionSettings, reconstruct_packets
from firmware.submaps import Track
from protocol.codec import decode, encode
from protocol.packets import SubmapPacket
from tests.compression.conftest import Survey, relief_m

QUICK = CompressionSettings(iterations=8)
HEADER = submap_header(submap=3, time_quarters=400)


def received(compressed: Compressed, survey: Survey) -> list[SubmapPacket]:
    packets = []
    for packet in packets_from(compressed, survey.track, HEADER):
        decoded = decode(encode(packet))
        assert isinstance(decoded, SubmapPacket)
        packets.append(decoded)
    return packets


@pytest.fixture(scope="module")
def packets(survey: Survey) -> list[SubmapPacket]:
    return received(compress(survey.bins, QUICK), survey)


def rmse_m(packets: list[SubmapPacket], drop: set[int]) -> float:
    arrived = {i: p for i, p in enumerate(packets) if i not in drop}
    grid = reconstruct_packets(arrived, ReconstructionSettings(cell_m=1.0), 100.0).grid
    north_m = grid.north0_m + grid.cell_m * np.arange(grid.depth_m.shape[0])
    east_m = grid.east0_m + grid.cell_m * np.arange(grid.depth_m.shape[1])
    true_m = relief_m(*np.meshgrid(north_m, east_m, indexing="ij"))
    return float(np.sqrt(np.nanmean((grid.depth_m - true_m) ** 2)))


def test_ten_packets_of_fifteen_points_carry_the_map(packets: list[SubmapPacket]) -> None:
    assert len(packets) == 10
    assert all(packet.points_ned_m.shape == (15, 3) for packet in packets)
    assert rmse_m(packets, set()) < 0.15  # m, of a relief of 1.3 m standard deviation


def test_two_lost_packets_cost_little(packets: list[SubmapPacket]) -> None:
    assert rmse_m(packets, {2, 7}) < 2.0 * rmse_m(packets, set())


def test_trajectory_comes_back_in_slices(packets: list[SubmapPacket], survey: Survey) -> None:
    arrived = {i: p for i, p in enumerate(packets) if i != 4}
    track = reconstruct_packets(arrived, ReconstructionSettings(), 100.0).track
    assert track.time_s.size == 36
    assert track.time_s[0] == 100.0
    np.testing.assert_allclose(track.north_m[:16], survey.track.north_m[:16], atol=1e-4)


def test_every_step_is_no_worse_than_the_one_before(survey: Survey) -> None:
    steps = list(compress_steps(survey.bins, QUICK))
    assert len(steps) > 20
    by_evaluations = {step.report.evaluations: step for step in steps}
    errors_m = [rmse_m(received(step, survey), set()) for step in by_evaluations.values()]
    assert len(errors_m) >= 3
    assert all(later <= earlier for earlier, later in itertools.pairwise(errors_m))


def test_points_of_one_fragment_are_spread_over_the_whole_map(survey: Survey) -> None:
    compressed = compress(survey.bins, CompressionSettings(iterations=1))
    assert isinstance(compressed, CompressedPoints)
    for points in fragment_points(compressed):
        assert np.ptp(points[:, 0]) > 50.0
        assert np.ptp(points[:, 1]) > 80.0


@pytest.mark.parametrize("period_s", [0.25, 0.7, 0.9])
def test_a_slice_holds_where_the_vehicle_was_at_its_whole_seconds(period_s: float) -> None:
    time_s = np.arange(0.0, 40.0, period_s)
    track = Track(
        time_s=time_s,
        north_m=2.0 * time_s,
        east_m=np.zeros(time_s.size),
        yaw_rad=np.full(time_s.size, np.pi - 1e-3) * (-1.0) ** np.arange(time_s.size),
    )
    states = states_by_second(track, 45)
    known = int(time_s[-1]) + 1
    assert states[:known, 0] == pytest.approx(2.0 * np.arange(known), abs=1e-4)
    assert np.abs(states[:known, 2]) == pytest.approx(np.full(known, np.pi), abs=2e-3)
    assert np.isnan(states[known:]).all()


def test_a_slice_is_empty_where_navigation_was_away() -> None:
    time_s = np.array([0.0, 1.0, 2.0, 8.0, 9.0])
    track = Track(time_s=time_s, north_m=time_s, east_m=time_s, yaw_rad=np.zeros(time_s.size))
    found = np.isfinite(states_by_second(track, 12)).all(axis=1)
    assert found.tolist() == [True] * 3 + [False] * 5 + [True] * 2 + [False] * 2
