"""The sub-maps that the leader holds, its own and those rebuilt from frames."""

from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware.geometry import Array
from firmware.leader.shelf import MemoryShelf, Shelf, packed, unpacked
from firmware.leader.trajectory import Trajectory
from firmware.leader.warping import remove_drift
from firmware.submaps import GriddedSubmap, Track
from protocol.vehicles import LEADER, VEHICLES

FOOTPRINT_M = 10.0
"""Tiles in which footprints are compared: a tenth of a sub-map."""
_GAP_S = 4.0  # a slice of a track, as a frame tells it: not far beyond nothing can be anchored


def chain_of(vehicle: int, boot: int) -> int:
    """Return the number of the graph's chain for a boot of a vehicle; the leader has one."""
    return LEADER if vehicle == LEADER else boot * VEHICLES + vehicle


def vehicle_of(chain: int) -> int:
    """Return the vehicle whose chain it is."""
    return chain % VEHICLES


@dataclass(frozen=True, slots=True, kw_only=True)
class SheetId:
    """A sub-map of one boot of a vehicle; boot epochs are counted without wrapping."""

    vehicle: int
    boot_epoch: int
    submap: int

    @property
    def chain(self) -> int:
        """The chain of the graph that it was measured from."""
        return chain_of(self.vehicle, self.boot_epoch)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sheet:
    """A gridded sub-map in raw dead reckoning, with the track it was measured from."""

    id: SheetId
    track: Track
    grid: GriddedSubmap
    time_s: float  # the middle of the measurement: the grid is warped to agree at this instant
    tiles_m: Array  # (P, 2) centres of the FOOTPRINT_M tiles that hold known cells
    centre_m: Array  # (2,) middle of them, raw dead reckoning

    def reckoned_at(self, time_s: float) -> Array:
        """Return the vehicle's raw dead-reckoned position (2,) at the time."""
        return self.track.position_at(time_s)

    def without_drift(self, trajectory: Trajectory) -> tuple[GriddedSubmap, Array]:
        """Return the grid with the estimated drift taken out about `time_s`, and that drift."""
        drift_mps = trajectory.drift_at(self.time_s)
        grid = remove_drift(self.grid, float(drift_mps[0]), float(drift_mps[1]), self.time_s)
        return grid, drift_mps


def sheet_of(sheet_id: SheetId, track: Track, grid: GriddedSubmap) -> Sheet | None:
    """Return the sheet of a grid, or None if no cell of it is known.

    Its time is the middle one of the cells, or the nearest to it of which the track tells.
    """
    rows, columns = np.nonzero(np.isfinite(grid.depth_m))
    if rows.size == 0:
        return None
    known_m = np.column_stack(
        [grid.north0_m + grid.cell_m * rows, grid.east0_m + grid.cell_m * columns]
    )
    low, occupied = _occupancy(known_m)
    tiles_m = ((low + np.argwhere(occupied)).astype(np.float64) + 0.5) * FOOTPRINT_M
    time_s = float(np.nanmedian(grid.time_s))
    if track.gap_s(time_s) > _GAP_S:
        time_s = float(track.time_s[np.argmin(np.abs(track.time_s - time_s))])
    return Sheet(
        id=sheet_id,
        track=track,
        grid=grid,
        time_s=time_s,
        tiles_m=tiles_m,
        centre_m=tiles_m.mean(axis=0),
    )


def overlap_m2(origin: Sheet, target: Sheet, shifts_m: Array) -> Array:
    """Return the area (S,) that two footprints share when target is moved by shifts_m (S, 2)."""
    first_m, last_m = origin.tiles_m.min(axis=0), origin.tiles_m.max(axis=0)
    begins_m = target.tiles_m.min(axis=0) + shifts_m.min(axis=0)
    ends_m = target.tiles_m.max(axis=0) + shifts_m.max(axis=0)
    if np.any(begins_m > last_m + FOOTPRINT_M) or np.any(ends_m < first_m - FOOTPRINT_M):
        return np.zeros(len(shifts_m))  # so are most, and this is soon told
    low, occupied = _occupancy(origin.tiles_m)
    moved = target.tiles_m[None] + shifts_m[:, None]
    i, j = np.moveaxis(np.floor(moved / FOOTPRINT_M).astype(int) - low, -1, 0)
    inside = (i >= 0) & (j >= 0) & (i < occupied.shape[0]) & (j < occupied.shape[1])
    hit = inside & occupied[np.where(inside, i, 0), np.where(inside, j, 0)]
    return np.asarray(FOOTPRINT_M**2 * hit.sum(axis=1))


def _occupancy(places_m: Array) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the lowest tile (2,) that holds places (N, 2), and from there on which tiles do."""
    tiles = np.floor(places_m / FOOTPRINT_M).astype(int)
    low = tiles.min(axis=0)
    occupied = np.zeros(tiles.max(axis=0) - low + 1, dtype=bool)
    occupied[tuple((tiles - low).T)] = True
    return low, occupied


class Atlas:
    """Sheets to match with, by id in the order of their arrival; the others are on the shelf.

    What the shelf refuses stays in memory, packed, and thus in checkpoints. Where there are more
    than the cap, shelved ones included, the oldest are dropped.
    """

    def __init__(self, capacity: int, shelf: Shelf | None = None) -> None:
        self._capacity = capacity
        self._sheets: OrderedDict[SheetId, Sheet] = OrderedDict()
        self._shelved: OrderedDict[SheetId, None] = OrderedDict()
        self.shelf = MemoryShelf() if shelf is None else shelf
        self._refused = MemoryShelf()
        self.dropped = 0

    def __getstate__(self) -> dict[str, Any]:
        """Return what a checkpoint holds: all but the shelf, which is on a disk of its own."""
        return {name: value for name, value in self.__dict__.items() if name != "shelf"}

    def __len__(self) -> int:
        return len(self._sheets)

    def __iter__(self) -> Iterator[Sheet]:
        return iter(self._sheets.values())

    def __contains__(self, sheet_id: SheetId) -> bool:
        return sheet_id in self._sheets

    def __getitem__(self, sheet_id: SheetId) -> Sheet:
        return self._sheets[sheet_id]

    def add(self, sheet: Sheet) -> None:
        """Keep a sheet; a later version of a known one takes its place."""
        if sheet.id in self._shelved:
            self._unshelve(sheet.id)
        self._sheets[sheet.id] = sheet
        if len(self._sheets) + len(self._shelved) > self._capacity:
            self.dropped += 1
            if self._shelved:
                self._unshelve(next(iter(self._shelved)))
            else:
                self._sheets.popitem(last=False)

    def shelve(self, sheet_id: SheetId) -> None:
        """Put a sheet away: it is matched no more, but stays part of the map."""
        name, body = _name(sheet_id), packed(self._sheets.pop(sheet_id).grid)
        if not self.shelf.put(name, body):
            self._refused.put(name, body)
        self._shelved[sheet_id] = None

    def _unshelve(self, sheet_id: SheetId) -> None:
        del self._shelved[sheet_id]
        for shelf in (self.shelf, self._refused):
            shelf.drop(_name(sheet_id))

    def grids(self) -> Iterator[tuple[int, GriddedSubmap]]:
        """Yield vehicle and grid of every sheet that can be had, those of the shelf first."""
        for sheet_id in self._shelved:
            name = _name(sheet_id)
            body = self._refused.get(name) or self.shelf.get(name)
            if body is not None:
                yield sheet_id.vehicle, unpacked(body)
        for sheet in self:
            yield sheet.id.vehicle, sheet.grid


def _name(sheet_id: SheetId) -> str:
    return f"{sheet_id.vehicle}/{sheet_id.boot_epoch}/{sheet_id.submap}"
