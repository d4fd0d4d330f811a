"""Where the lattice of a sub-map lies: a rectangle along the track, and how to read it anywhere."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from firmware.compression.initial import main_axis
from firmware.geometry import Array
from firmware.submaps import BinnedSoundings

_MARGIN_NODES = 3  # beyond the cells on all sides; keeps the cosines' mirror off the data
_MAX_NODES = 250  # along a side: one byte, bounded work, and a length that transforms fast
_ANGLE_STEPS = 256  # of half a turn
_LARGEST_FACTOR = 40  # of a side: beyond it a cosine transform takes far longer


@dataclass(frozen=True, slots=True, kw_only=True)
class LatticeFrame:
    """Nodes (rows, columns) every step_m, rows along angle_rad from north, from a corner.

    All fields are exactly what the wire says: the corner in quarter metres, the angle in 1/256 of
    half a turn, the step in quarter metres.
    """

    corner_north_q: int
    corner_east_q: int
    angle_code: int
    step_q: int
    rows: int
    columns: int

    @property
    def step_m(self) -> float:
        """Return the distance between nodes."""
        return 0.25 * self.step_q

    @property
    def shape(self) -> tuple[int, int]:
        """Return rows along and columns across."""
        return self.rows, self.columns

    def nodes_of(self, position_m: Array) -> Array:
        """Return the fractional row and column (N, 2) of positions (N, 2) north, east."""
        offset_m = position_m - 0.25 * np.array([self.corner_north_q, self.corner_east_q])
        out: Array = offset_m @ self._axes().T / self.step_m
        return out

    def positions_of(self, nodes: Array) -> Array:
        """Return north, east (N, 2) of rows and columns (N, 2)."""
        corner_m = 0.25 * np.array([self.corner_north_q, self.corner_east_q])
        out: Array = corner_m + self.step_m * nodes @ self._axes()
        return out

    def _axes(self) -> Array:
        angle_rad = np.pi * self.angle_code / _ANGLE_STEPS
        return np.array(
            [[np.cos(angle_rad), np.sin(angle_rad)], [-np.sin(angle_rad), np.cos(angle_rad)]]
        )


def lattice_frame(bins: BinnedSoundings, step_m: float) -> LatticeFrame:
    """Return the smallest frame along the cells' main axis, its step doubled until it fits.

    A side is a node or two longer where its transform would be slow.
    """
    position_m = np.column_stack([bins.north_m, bins.east_m])
    axis = main_axis(position_m)
    angle_code = round(np.arctan2(axis[1], axis[0]) / np.pi * _ANGLE_STEPS) % _ANGLE_STEPS
    step_q = max(1, round(4.0 * step_m))
    while True:
        trial = LatticeFrame(
            corner_north_q=0,
            corner_east_q=0,
            angle_code=angle_code,
            step_q=step_q,
            rows=1,
            columns=1,
        )
        local = trial.nodes_of(position_m)
        low = np.floor(local.min(axis=0)) - _MARGIN_NODES
        sides = np.ceil(local.max(axis=0)) + _MARGIN_NODES - low + 1
        if sides.max() <= _MAX_NODES:
            break
        step_q *= 2
    corner_q = np.round(4.0 * trial.positions_of(low[None, :]))[0].astype(int)
    return LatticeFrame(
        corner_north_q=int(corner_q[0]),
        corner_east_q=int(corner_q[1]),
        angle_code=angle_code,
        step_q=step_q,
        rows=_transforming_fast(int(sides[0])),
        columns=_transforming_fast(int(sides[1])),
    )


def _transforming_fast(side: int) -> int:
    """Return the next length without a large prime factor: 149 costs eight times as much as 150."""
    while True:
        rest = side
        for factor in range(2, _LARGEST_FACTOR + 1):
            while rest % factor == 0:
                rest //= factor
        if rest == 1:
            return side
        side += 1


def interpolation(frame: LatticeFrame, position_m: Array) -> csr_array:
    """Return the (N, rows x columns) matrix that reads node values at positions (N, 2).

    Cubic convolution (Keys, 1981, a = -1/2) on 4 x 4 nodes, held at the edges.
    """
    nodes = frame.nodes_of(position_m)
    whole = np.floor(nodes).astype(np.int64)
    part = nodes - whole
    weights = [cubic_weights(part[:, axis]) for axis in range(2)]
    rows = np.clip(whole[:, 0, None] + np.arange(-1, 3), 0, frame.rows - 1)
    columns = np.clip(whole[:, 1, None] + np.arange(-1, 3), 0, frame.columns - 1)
    index = rows[:, :, None] * frame.columns + columns[:, None, :]
    values = weights[0][:, :, None] * weights[1][:, None, :]
    starts = 16 * np.arange(len(nodes) + 1, dtype=np.int32)  # half as much to read
    shape = (len(nodes), frame.rows * frame.columns)
    return csr_array((values.ravel(), index.ravel().astype(np.int32), starts), shape=shape)


def cubic_weights(t: Array) -> Array:
    """Return the weights (..., 4) of the nodes about a place a part t beyond the second."""
    return np.stack(
        [
            ((-0.5 * t + 1.0) * t - 0.5) * t,
            (1.5 * t - 2.5) * t * t + 1.0,
            ((-1.5 * t + 2.0) * t + 0.5) * t,
            (0.5 * t - 0.5) * t * t,
        ],
        axis=1,
    )
