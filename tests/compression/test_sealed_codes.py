"""Codes that leave the end of each body to a seal, and small frames that hardly hold a map."""

import dataclasses

import numpy as np
import pytest

from firmware.compression import compress, packets_from
from firmware.compression.packing import submap_header
from firmware.compression.settings import CompressionSettings
from firmware.leader.reconstruction import ReconstructionSettings, reconstruct_packets
from firmware.submaps import Track
from protocol.packets import SubmapFragment
from tests.compression.conftest import Survey, relief_m

QUICK = CompressionSettings(dense_iterations=2, dense_points=120)


def fragments(survey: Survey, profile: str, settings: CompressionSettings) -> list[SubmapFragment]:
    compressed = compress(survey.bins, settings, profile)
    packets = packets_from(compressed, survey.track, submap_header())
    return [packet for packet in packets if isinstance(packet, SubmapFragment)]


def error_m(packets: list[SubmapFragment], *, sealed: bool, lost: set[int]) -> float:
    got = {p.header.fragment: p for p in packets if p.header.fragment not in lost}
    settings = ReconstructionSettings(sealed=sealed, max_variance_m2=1.0)
    grid = reconstruct_packets(got, settings, 0.0).grid
    rows, columns = (np.arange(n, dtype=np.float64) for n in grid.depth_m.shape)
    north_m = grid.north0_m + grid.cell_m * rows[:, None]
    truth_m = relief_m(north_m, grid.east0_m + grid.cell_m * columns)
    known = np.isfinite(grid.depth_m)
    assert known.sum() > 500
    return float(np.sqrt(np.mean((grid.depth_m - truth_m)[known] ** 2)))


@pytest.mark.parametrize(("profile", "small"), [("dense", 0), ("lattice", 0), ("lattice", 1)])
def test_a_sealed_code_leaves_twelve_bytes_and_loses_little(
    survey: Survey, profile: str, small: int
) -> None:
    plain = dataclasses.replace(QUICK, small_frames=bool(small))
    sealed = dataclasses.replace(plain, sealed=True)
    bodies = fragments(survey, profile, sealed)
    assert len(bodies) == 10
    assert all(packet.body.endswith(bytes(12)) for packet in bodies)
    whole_m = error_m(fragments(survey, profile, plain), sealed=False, lost={0, 7})
    cut_m = error_m(bodies, sealed=True, lost={0, 7})
    assert cut_m < (1.8 if small else 1.1) * whole_m


def test_small_frames_of_a_bent_track_hold_a_map(survey: Survey) -> None:
    seconds = np.arange(40.0)
    bent = Track(
        time_s=seconds,
        north_m=20.0 * np.sin(seconds / 12.0),
        east_m=20.0 * np.cos(seconds / 12.0),
        yaw_rad=seconds / 12.0,
    )
    turning = dataclasses.replace(survey, track=bent)
    packets = fragments(turning, "lattice", dataclasses.replace(QUICK, small_frames=True))
    assert error_m(packets, sealed=False, lost={1, 4}) < 1.0
