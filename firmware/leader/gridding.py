"""A decoder's map on a grid: exact on as many nodes as its points can tell apart, cubic between.

A Gaussian process of few points is smooth over a fraction of their spacing, so that on a fine grid
Eq. 5 and 6 would mostly be evaluated where interpolation does as well.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from firmware.compression.decoder import PointDecoder
from firmware.compression.fit import spacing_of
from firmware.compression.kernels import Kernel
from firmware.compression.lattice_frame import cubic_weights
from firmware.geometry import Array

_NODES_A_SPACING = 2.4  # at least; what lies between is then within some per cent of sigma
_LONGEST_STRIDE = 3  # cells


def gridded(
    decoder: PointDecoder, north_m: Array, east_m: Array, inside: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Return depth and variance (R, C) of the cells inside; NaN and infinity elsewhere."""
    depth_m, variance_m2 = np.full(inside.shape, np.nan), np.full(inside.shape, np.inf)
    if not inside.any():
        return depth_m, variance_m2
    cell_m = float(north_m[1] - north_m[0]) if north_m.size > 1 else np.inf
    stride = min(int(_smooth_m(decoder) / (_NODES_A_SPACING * cell_m)), _LONGEST_STRIDE)
    if stride < 2:
        row, column = np.nonzero(inside)
        places_m = np.column_stack([north_m[row], east_m[column]])
        depth_m[inside], variance_m2[inside] = decoder.predict(places_m)
        return depth_m, variance_m2
    along, across = (_between(axis.size, stride) for axis in (north_m, east_m))
    used = abs(along).T @ inside.astype(np.float64) @ abs(across) > 0.0
    row, column = np.nonzero(used)
    nodes_m = np.column_stack(
        [
            north_m[0] + cell_m * stride * (row - 1.0),
            east_m[0] + cell_m * stride * (column - 1.0),
        ]
    )
    nodes = np.zeros((2, *used.shape))
    nodes[0, used], nodes[1, used] = decoder.predict(nodes_m)
    depth_m[inside] = (along @ nodes[0] @ across.T)[inside]
    least_m2 = nodes[1, used].min()
    variance_m2[inside] = np.maximum(along @ nodes[1] @ across.T, least_m2)[inside]
    return depth_m, variance_m2


def _smooth_m(decoder: PointDecoder) -> float:
    """Return over what distance a decoder's map is smooth: its points' spacing, or its kernel's."""
    if decoder.hyper.kernel is Kernel.EXPONENTIAL:
        return 0.0
    length_m = 1.0 / max(abs(decoder.hyper.b_per_m), 1e-9)
    return min(spacing_of(decoder.points_m.astype(np.float64)), length_m)


def _between(cells: int, stride: int) -> csr_array:
    """Return the weights (cells, nodes) of nodes every stride, from one before the first cell."""
    whole, part = np.divmod(np.arange(cells), stride)
    columns = whole[:, None] + np.arange(4)
    weights = cubic_weights(part / stride).ravel()
    starts = 4 * np.arange(cells + 1)
    return csr_array((weights, columns.ravel(), starts), shape=(cells, int(whole[-1]) + 4))
