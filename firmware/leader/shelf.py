"""Where sub-maps go that are wanted for the map only: packed, in memory or on a disk."""

import zlib
from typing import Protocol

import numpy as np

from firmware.submaps import GriddedSubmap

_HEAD = np.dtype([("north0_m", "<f8"), ("east0_m", "<f8"), ("cell_m", "<f8"), ("rows", "<i4")])


class Shelf(Protocol):
    """Packed grids by name."""

    def put(self, name: str, body: bytes) -> bool:
        """Keep a body, in place of an earlier one of the name; return whether it could be."""

    def get(self, name: str) -> bytes | None:
        """Return a body, or None if it is lost."""

    def drop(self, name: str) -> None:
        """Drop a body, if there is one."""


class MemoryShelf:
    """A shelf without a disk: about eight kilobytes a sub-map."""

    def __init__(self) -> None:
        self._bodies: dict[str, bytes] = {}

    def put(self, name: str, body: bytes) -> bool:
        """Keep a body."""
        self._bodies[name] = body
        return True

    def get(self, name: str) -> bytes | None:
        """Return a body."""
        return self._bodies.get(name)

    def drop(self, name: str) -> None:
        """Keep a body no longer."""
        self._bodies.pop(name, None)


def packed(grid: GriddedSubmap) -> bytes:
    """Return a grid as bytes: float32, layer after layer, compressed."""
    head = np.array((grid.north0_m, grid.east0_m, grid.cell_m, len(grid.depth_m)), dtype=_HEAD)
    start_s = np.nan_to_num(np.nanmin(grid.time_s))
    layers = np.stack([grid.depth_m, grid.variance_m2, grid.time_s - start_s]).astype("<f4")
    planes = layers.view(np.uint8).reshape(-1, 4).T
    return head.tobytes() + np.float64(start_s).tobytes() + zlib.compress(planes.tobytes(), 1)


def unpacked(body: bytes) -> GriddedSubmap:
    """Return the grid of bytes; whether it was reconstructed is of no use to the map."""
    head = np.frombuffer(body, dtype=_HEAD, count=1)[0]
    (start_s,) = np.frombuffer(body, dtype="<f8", count=1, offset=_HEAD.itemsize)
    planes = np.frombuffer(zlib.decompress(body[_HEAD.itemsize + 8 :]), dtype=np.uint8)
    values = np.ascontiguousarray(planes.reshape(4, -1).T).view("<f4").astype(np.float64)
    depth_m, variance_m2, time_s = values.reshape(3, int(head["rows"]), -1)
    return GriddedSubmap(
        north0_m=float(head["north0_m"]),
        east0_m=float(head["east0_m"]),
        cell_m=float(head["cell_m"]),
        depth_m=depth_m,
        variance_m2=variance_m2,
        time_s=time_s + start_s,
    )
