"""Where a lattice sub-map was measured: a mask of blocks, coded in a few bytes."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from firmware.compression.lattice_frame import LatticeFrame
from firmware.geometry import Array
from firmware.submaps import BinnedSoundings
from protocol.arithmetic import Contexts, Decoder, Encoder

BLOCK_NODES = 4  # along each side; 4 m at a step of 1 m
_CENTRE_REACH = 0.3  # of a block
_SPACING_REACH = 0.9  # of the spacing that nine in ten cells keep to their neighbour
_SPACED_CELLS = 1500  # that are asked for it; each takes a microsecond
Mask = NDArray[np.bool_]


def block_shape(frame: LatticeFrame) -> tuple[int, int]:
    """Return the rows and columns of blocks."""
    return -(-frame.rows // BLOCK_NODES), -(-frame.columns // BLOCK_NODES)


def footprint(bins: BinnedSoundings, frame: LatticeFrame) -> Mask:
    """Return which blocks were measured, (rows, columns) of blocks: those whose centre was.

    A centre is measured when a cell lies as near as cells lie to each other, so that the wider
    spacing of outer beams is no gap and a gap of several spacings is one.
    """
    shape = block_shape(frame)
    position_m = np.column_stack([bins.north_m, bins.east_m])
    tree = cKDTree(position_m)
    asked_m = position_m[:: -(-len(position_m) // _SPACED_CELLS)]
    spacing_m = np.asarray(tree.query(asked_m, k=[min(2, len(position_m))])[0])
    reach_m = max(
        _CENTRE_REACH * BLOCK_NODES * frame.step_m,
        _SPACING_REACH * float(np.quantile(spacing_m, 0.9)),
    )
    row, column = np.indices(shape).reshape(2, -1)
    centres = np.empty((row.size, 2))
    centres[:, 0] = BLOCK_NODES * row + 0.5 * (BLOCK_NODES - 1)
    centres[:, 1] = BLOCK_NODES * column + 0.5 * (BLOCK_NODES - 1)
    nearest_m = np.asarray(tree.query(frame.positions_of(centres))[0])
    return np.asarray(nearest_m <= reach_m).reshape(shape)


def inside_footprint(mask: Mask, frame: LatticeFrame, position_m: Array) -> Mask:
    """Return which positions (N, 2) lie in a measured block."""
    nodes = frame.nodes_of(position_m) + 0.5
    block = np.floor(nodes / BLOCK_NODES).astype(np.int64)
    good = (block >= 0).all(axis=1) & (block < np.array(mask.shape)).all(axis=1)
    out = np.zeros(len(position_m), dtype=bool)
    out[good] = mask[block[good, 0], block[good, 1]]
    return out


def encode_footprint(mask: Mask, encoder: Encoder) -> None:
    """Code the mask, each block in the context of its four neighbours that went before."""
    counts = Contexts(16)
    padded = np.pad(mask, 1).astype(int)
    where = _contexts(padded)
    encoder.encode_adaptive(mask.astype(int).ravel().tolist(), where.ravel().tolist(), counts)


def decode_footprint(shape: tuple[int, int], decoder: Decoder) -> Mask:
    """Return the mask; raises CodeEnd when the code ends within it."""
    counts = Contexts(16)
    padded = [[0] * (shape[1] + 2) for _ in range(shape[0] + 1)]
    for i in range(1, shape[0] + 1):
        above, row = padded[i - 1], padded[i]
        for j in range(1, shape[1] + 1):
            context = row[j - 1] | above[j - 1] << 1 | above[j] << 2 | above[j + 1] << 3
            row[j] = decoder.decode(counts.share(context))
            counts.count(context, row[j])
    return np.array(padded, dtype=bool)[1:, 1:-1]


def _contexts(padded: NDArray[np.int64]) -> NDArray[np.int64]:
    west, above = padded[1:-1, :-2], padded[:-2]
    return west | above[:, :-2] << 1 | above[:, 1:-1] << 2 | above[:, 2:] << 3
