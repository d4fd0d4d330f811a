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
    """Some cells, and their kernel rows (R, M) times the root of their weights."""

    def __init__(self, position_m: Array, depth_m: Array, weight: Array, room: Room) -> None:
        root = np.sqrt(weight)
        self.target = root * depth_m
        self._minuends = minuends(position_m.astype(np.float32))
        self._root = root[:, None].astype(np.float32)
        self._target = self.target[:, None].astype(np.float32)
        self._terms = moment_terms(position_m).astype(np.float32)
        size = len(depth_m)
        self._k, self._slope, self._spare = room.k[:size], room.slope[:size], room.spare[:size]
        self.weighted = room.weighted[:size]

    def measure(self, kernel: Kernel, subtrahends: Float32, b: float) -> None:
        """Fill the rows for these points; float32 sums would lose what beta lives on."""
        squared = squared_differences(self._minuends, subtrahends, b, self._spare, self._slope)
        k, slope = correlation_and_slope(kernel, squared, self._k, self._slope)
        if slope is k:
            np.copyto(self._slope, k)
        k *= self._root
        np.copyto(self.weighted, k)

    def misfit(self, stack: Float32) -> Float32:
        """Return how far the map lies from the cells under weights (M, P), weighted, (R, P)."""
        out: Float32 = self._k @ stack
        out -= self._target
        out *= self._root
        return out

    def pull(self, misfit: Float32, low_rank: Float32) -> Float32:
        """Return moments (M, 4) of the cells' pull on each point: (misfit low_rank) * slope.

        low_rank is (P, M): twice the points' weights times the probability of their pattern.
        """
        if len(low_rank) == 1:
            return (self._slope.T @ (misfit * self._terms)) * low_rank.T
        pull = np.matmul(misfit, low_rank, out=self._spare)
        pull *= self._slope
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
