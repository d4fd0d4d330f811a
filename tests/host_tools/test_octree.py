import numpy as np
import pytest

from firmware.submaps import BinnedSoundings, Track
from host_tools.octree import CHUNK_BYTES, decode_octree, leaf_count, octree_submap
from protocol.errors import ProtocolError


def bins(depth: object = None, rows: int = 70, columns: int = 40) -> BinnedSoundings:
    north_m, east_m = np.meshgrid(
        -50 + 2.0 * np.arange(rows) + 1, 30 + 2.0 * np.arange(columns) + 1, indexing="ij"
    )
    north_m, east_m = north_m.ravel(), east_m.ravel()
    depth_m = 40 + 2 * np.sin(north_m / 12) if depth is None else np.full(north_m.size, 40.0)
    ones = np.ones(north_m.size)
    return BinnedSoundings(
        cell_m=2.0,
        north_m=north_m,
        east_m=east_m,
        depth_m=depth_m,
        variance_m2=0.002 * ones,
        count=10 * ones,
        time_s=ones,
    )


TRACK = Track(
    time_s=np.arange(40.0),
    north_m=-50 + 3.5 * np.arange(40.0),
    east_m=np.full(40, 70.0),
    yaw_rad=np.zeros(40),
)


def test_leaves_lie_within_the_split_of_every_depth_under_them() -> None:
    data = bins()
    chunks = octree_submap(data)
    grid = decode_octree(chunks, TRACK)
    row = np.round((data.north_m - grid.north0_m) / 2).astype(int)
    column = np.round((data.east_m - grid.east0_m) / 2).astype(int)
    error_m = np.abs(grid.depth_m[row, column] - data.depth_m)
    assert error_m.max() < 1.25
    assert 0.05 < np.sqrt(np.mean(error_m**2)) < 0.5
    assert 100 < leaf_count(chunks) < 1400
    assert all(len(chunk) <= CHUNK_BYTES for chunk in chunks)


def test_flat_seabed_needs_only_the_largest_blocks() -> None:
    chunks = octree_submap(bins(depth="flat"))
    assert leaf_count(chunks) <= 6 * 4
    grid = decode_octree(chunks, TRACK)
    np.testing.assert_allclose(grid.depth_m[np.isfinite(grid.depth_m)], 40.0, atol=1e-3)


def test_any_missing_chunk_loses_the_whole_structure() -> None:
    chunks = octree_submap(bins())
    for missing in range(len(chunks)):
        with pytest.raises(ProtocolError):
            decode_octree(chunks[:missing] + chunks[missing + 1 :], TRACK)


def test_cells_carry_the_time_of_the_nearest_state() -> None:
    grid = decode_octree(octree_submap(bins()), TRACK)
    row = 20
    north_m = grid.north0_m + 2 * row
    expected = np.argmin(np.abs(TRACK.north_m - north_m))
    column = round((70.0 - grid.east0_m) / 2)
    assert grid.time_s[row, column] == expected


def test_empty_and_far_too_wide_submaps_give_no_chunk() -> None:
    empty = np.empty(0)
    nothing = BinnedSoundings(
        cell_m=2.0,
        north_m=empty,
        east_m=empty,
        depth_m=empty,
        variance_m2=empty,
        count=empty,
        time_s=empty,
    )
    assert octree_submap(nothing) == []
    assert octree_submap(bins(rows=300)) == []
