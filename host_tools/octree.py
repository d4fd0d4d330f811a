"""The paper's baseline: a sub-map as the leaves of a tree of blocks, all lost with any packet.

Section 6.1: a block splits while its depths span more than 1.25 m; blocks are 2 to 32 m wide. The
tree divides the plane, the depths decide where. A leaf is 40 bits: 8 bits of row and of column in
2 m cells, 3 of level (0: 2 m ... 4: 32 m), 21 of mean depth in millimetres above a floor.
"""

import struct
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from firmware.geometry import Array
from firmware.submaps import BinnedSoundings, GriddedSubmap, Track
from protocol.errors import ProtocolError

SPLIT_M = 1.25
SMALLEST_M, LEVELS = 2.0, 5
LEAF_BYTES = 5
# What a frame of the paper leaves beside header, four states and CRC.
CHUNK_BYTES = 256 - 8 - 48 - 4
_HEAD = struct.Struct("<fffI")
_DEPTH_STEP_M = 0.001
_MOST_CELLS = 256
# Of a leaf's mean about the depths under it: a third of the span that does not split, squared.
LEAF_VARIANCE_M2 = (SPLIT_M / 6.0) ** 2

Leaves = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], Array]


def octree_submap(bins: BinnedSoundings) -> list[bytes]:
    """Return the chunks, of at most 196 bytes, that carry the tree; all are needed to decode it.

    A sub-map wider than 512 m, or without soundings, gives no chunk at all.
    """
    if bins.depth_m.size == 0:
        return []
    coarsest_m = SMALLEST_M * 2 ** (LEVELS - 1)
    north0_m = float(np.floor(bins.north_m.min() / coarsest_m) * coarsest_m)
    east0_m = float(np.floor(bins.east_m.min() / coarsest_m) * coarsest_m)
    row = ((bins.north_m - north0_m) // SMALLEST_M).astype(np.int64)
    column = ((bins.east_m - east0_m) // SMALLEST_M).astype(np.int64)
    if row.max() >= _MOST_CELLS or column.max() >= _MOST_CELLS:
        return []
    floor_m = float(bins.depth_m.min())
    rows, columns, levels, depth_m = _leaves(row, column, bins.depth_m)
    steps = np.round((depth_m - floor_m) / _DEPTH_STEP_M).astype(np.int64)
    words = rows | columns << 8 | levels << 16 | np.clip(steps, 0, 2**21 - 1) << 19
    body = words.astype("<u8").view(np.uint8).reshape(-1, 8)[:, :LEAF_BYTES].tobytes()
    data = _HEAD.pack(north0_m, east0_m, floor_m, len(words)) + body
    return [data[k : k + CHUNK_BYTES] for k in range(0, len(data), CHUNK_BYTES)]


def leaf_count(chunks: Sequence[bytes]) -> int:
    """Return how many leaves the chunks of a tree hold."""
    return (sum(map(len, chunks)) - _HEAD.size) // LEAF_BYTES if chunks else 0


def _leaves(row: NDArray[np.int64], column: NDArray[np.int64], depth_m: Array) -> Leaves:
    """Return row, column, level and mean depth of the leaves, coarse ones first."""
    found: list[Leaves] = []
    for level in range(LEVELS - 1, -1, -1):
        key = (row >> level) * _MOST_CELLS + (column >> level)
        blocks, which, count = np.unique(key, return_inverse=True, return_counts=True)
        lowest, highest = np.full(blocks.size, np.inf), np.full(blocks.size, -np.inf)
        np.minimum.at(lowest, which, depth_m)
        np.maximum.at(highest, which, depth_m)
        done = (highest - lowest <= SPLIT_M) | (level == 0)
        mean_m = np.bincount(which, depth_m) / count
        found.append(
            (
                (blocks[done] // _MOST_CELLS) << level,
                (blocks[done] % _MOST_CELLS) << level,
                np.full(int(done.sum()), level, dtype=np.int64),
                mean_m[done],
            )
        )
        rest = ~done[which]
        row, column, depth_m = row[rest], column[rest], depth_m[rest]
    rows, columns, levels, depths = zip(*found, strict=True)
    return (
        np.concatenate(rows),
        np.concatenate(columns),
        np.concatenate(levels),
        np.concatenate(depths),
    )


def decode_octree(chunks: Sequence[bytes], track: Track) -> GriddedSubmap:
    """Return the sub-map of a whole tree on a 2 m grid; each leaf is flat.

    Raises
    ------
    ProtocolError
        When a chunk is missing: the structure cannot be read without it.
    """
    data = b"".join(chunks)
    if len(data) < _HEAD.size:
        raise ProtocolError(f"octree of {len(data)} bytes; its head alone has {_HEAD.size}")
    north0_m, east0_m, floor_m, leaves = _HEAD.unpack_from(data)
    body = data[_HEAD.size :]
    if leaves == 0 or len(body) != leaves * LEAF_BYTES:
        raise ProtocolError(f"octree of {leaves} leaves has {len(body)} bytes of them")
    padded = np.zeros((leaves, 8), dtype=np.uint8)
    padded[:, :LEAF_BYTES] = np.frombuffer(body, dtype=np.uint8).reshape(-1, LEAF_BYTES)
    words = padded.view("<u8").ravel().astype(np.int64)
    rows, columns = words & 0xFF, words >> 8 & 0xFF
    sizes = 1 << np.minimum(words >> 16 & 0x7, LEVELS - 1)
    depths_m = floor_m + (words >> 19) * _DEPTH_STEP_M
    shape = (int((rows + sizes).max()), int((columns + sizes).max()))
    depth_m = np.full(shape, np.nan)
    for row, column, size, leaf_m in zip(rows, columns, sizes, depths_m, strict=True):
        depth_m[row : row + size, column : column + size] = leaf_m
    return GriddedSubmap(
        north0_m=north0_m + SMALLEST_M / 2,
        east0_m=east0_m + SMALLEST_M / 2,
        cell_m=SMALLEST_M,
        depth_m=depth_m,
        variance_m2=np.where(np.isnan(depth_m), np.nan, LEAF_VARIANCE_M2),
        time_s=_nearest_time(depth_m, north0_m, east0_m, track),
        reconstructed=True,
    )


def _nearest_time(depth_m: Array, north0_m: float, east0_m: float, track: Track) -> Array:
    """Return for each known cell the time of the track's nearest state."""
    time_s = np.full(depth_m.shape, np.nan)
    row, column = np.nonzero(np.isfinite(depth_m))
    if track.time_s.size and row.size:
        cells_m = np.stack(
            [north0_m + SMALLEST_M * (row + 0.5), east0_m + SMALLEST_M * (column + 0.5)]
        )
        _, nearest = cKDTree(np.stack([track.north_m, track.east_m], axis=1)).query(cells_m.T)
        time_s[row, column] = track.time_s[nearest]
    return time_s
