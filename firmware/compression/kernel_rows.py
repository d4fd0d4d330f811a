"""Rows of the kernel matrix between cells and points, in memory that is used again and again."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware.compression.kernels import (
    Kernel,
    correlation_and_slope,
    minuends,
    squared_differences,
)
from firmware.geometry import Array

Float32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Room:
    """Pages that are filled again at every evaluation: fresh ones cost as much as the sums."""

    k: Float32
    slope: Float32
    double: Array  # k in double precision, or what has to be kept for a moment only

    @classmethod
    def of(cls, entries: int) -> "Room":
        """Return room for rows of so many entries in all."""
        k, slope = (np.empty(entries, dtype=np.float32) for _ in range(2))
        return cls(k, slope, np.empty(entries))

    def with_own_rows(self) -> "Room":
        """Return room that shares with this one what a pass does not leave to the next."""
        return Room(np.empty_like(self.k), np.empty_like(self.slope), self.double)

    def shaped(self, rows: int, points: int) -> "Room":
        """Return its beginning in that shape."""
        size, shape = rows * points, (rows, points)
        return Room(
            self.k[:size].reshape(shape),
            self.slope[:size].reshape(shape),
            self.double[:size].reshape(shape),
        )

    @property
    def spare(self) -> Float32:
        """Return room of the rows' shape in the place of what stood in double precision."""
        return self.double.reshape(-1).view(np.float32)[: self.k.size].reshape(self.k.shape)


class Rows:
    """Some cells, and their kernel rows (R, M) times the root of their weights.

    along_m (R,) says where the cells lie along an axis on which points may be far from them.
    """

    def __init__(
        self, position_m: Array, depth_m: Array, weight: Array, along_m: Array, room: Room
    ) -> None:
        root = np.sqrt(weight)
        self._first_m, self._last_m = along_m.min(), along_m.max()
        self.target = root * depth_m
        self._minuends = minuends(position_m.astype(np.float32))
        self._root = root[:, None].astype(np.float32)
        self._target = self.target[:, None].astype(np.float32)
        self._terms = moment_terms(position_m).astype(np.float32)
        self._pages = room
        self._room = room.shaped(len(depth_m), 0)

    def near(self, along_m: Array, reach_m: float) -> slice:
        """Return the points, at along_m (M,), from the first to the last within reach."""
        within = along_m >= self._first_m - reach_m
        within &= along_m <= self._last_m + reach_m
        return slice(int(np.argmax(within)), len(within) - int(np.argmax(within[::-1])))

    def weighted(self) -> Array:
        """Return the rows in double precision; float32 sums would lose what beta lives on."""
        np.copyto(self._room.double, self._room.k)
        return self._room.double

    def measure(self, kernel: Kernel, subtrahends: Float32, b: float) -> None:
        """Fill the rows for these points."""
        room = self._room = self._pages.shaped(len(self._root), subtrahends.shape[2])
        squared = squared_differences(self._minuends, subtrahends, b, room.k, room.slope)
        k, slope = correlation_and_slope(kernel, squared, room.k, room.slope)
        if slope is k:
            np.copyto(room.slope, k)
        k *= self._root

    def misfit(self, stack: Float32) -> Float32:
        """Return how far the map lies from the cells under weights (M, P), weighted, (R, P)."""
        out: Float32 = self._room.k @ stack
        out -= self._target
        out *= self._root
        return out

    def pull(self, misfit: Float32, low_rank: Float32) -> Float32:
        """Return moments (M, 4) of the cells' pull on each point: (misfit low_rank) * slope.

        low_rank is (P, M): twice the points' weights times the probability of their pattern.
        """
        if len(low_rank) == 1:
            return (self._room.slope.T @ (misfit * self._terms)) * low_rank.T
        pull = np.matmul(misfit, low_rank, out=self._room.spare)
        pull *= self._room.slope
        return pull.T @ self._terms


def moment_terms(position_m: Array) -> Array:
    """Return (N, 4) north, east, one and the squared length of positions (N, 2)."""
    squared_m2 = np.sum(position_m**2, axis=1)
    return np.column_stack([position_m, np.ones(len(position_m)), squared_m2])


def change_by_points(moments: Array, point_m: Array, b: float) -> tuple[Array, float]:
    """Return the error's change by points (M, 2) and by log b, from moments (M, 4) of its pull.

    A pull p of a cell at x on a point at z changes the error by p b^2 (x - z) and -p b^2 |x - z|^2.
    """
    moved, mass = moments[:, :2], moments[:, 2]
    by_point = (b * b) * (moved - mass[:, None] * point_m)
    apart = moments[:, 3].sum() - 2.0 * np.vdot(moved, point_m)
    apart += mass @ np.sum(point_m**2, axis=1)
    return by_point, -(b * b) * float(apart)
