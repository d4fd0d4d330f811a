"""Rows of the kernel matrix between cells and points, in memory that is used again and again."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware.compression.kernels import Kernel, correlation_and_slope, squared_distance
from firmware.geometry import Array

Float32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Room:
    """Pages that are filled again at every evaluation: fresh ones cost as much as the sums."""

    k: Float32
    slope: Float32
    spare: Float32
    weighted: Array

    @classmethod
    def of(cls, rows: int, points: int) -> "Room":
        """Return room for so many rows."""
        k, slope, spare = (np.empty((rows, points), dtype=np.float32) for _ in range(3))
        return cls(k, slope, spare, np.empty((rows, points)))

    def with_own_rows(self) -> "Room":
        """Return room that shares with this one what a pass does not leave to the next."""
        return Room(np.empty_like(self.k), np.empty_like(self.slope), self.spare, self.weighted)


class Rows:
    """Some cells, and their kernel rows (R, M)."""

    def __init__(self, position_m: Array, depth_m: Array, weight: Array, room: Room) -> None:
        self._position_m = position_m.astype(np.float32)
        self._depth_m = depth_m[:, None].astype(np.float32)
        self._weight = weight[:, None].astype(np.float32)
        self._root = np.sqrt(weight)
        self._squared_m2 = np.sum(position_m**2, axis=1)
        size = len(depth_m)
        self._k, self._slope, self._spare = room.k[:size], room.slope[:size], room.spare[:size]
        self.weighted = room.weighted[:size]
        self.target = self._root * depth_m

    def measure(self, kernel: Kernel, points: Float32, b: float) -> None:
        """Fill the rows for these points; float32 sums would lose what beta lives on."""
        squared = squared_distance(self._position_m, points, b, self._spare, self._slope)
        k, slope = correlation_and_slope(kernel, squared, self._k, self._slope)
        if slope is k:
            np.copyto(self._slope, k)
        np.multiply(k, self._root[:, None], out=self.weighted)

    def pulled(self, stack: Float32, low_rank: Float32, points: Float32) -> tuple[Array, float]:
        """Return the error's change by points (M, 2) and by -log b, both over b^2."""
        misfit = self._k @ stack
        misfit -= self._depth_m
        misfit *= self._weight
        pull = np.matmul(misfit, low_rank, out=self._spare)
        pull *= self._slope
        moved = (pull.T @ self._position_m).astype(np.float64)
        mass = pull.sum(axis=0).astype(np.float64)
        by_scale = pull.sum(axis=1) @ self._squared_m2 + mass @ np.sum(points**2.0, axis=1)
        by_scale -= 2.0 * float(np.vdot(moved, points))
        return moved - mass[:, None] * points, float(by_scale)
