"""The values a sub-map is made of, from soundings to grid."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from firmware.geometry import Array

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Values = TypeVar("Values", bound="DataclassInstance")


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """States of one vehicle in raw dead reckoning, nominally once a second, time ascending.

    All arrays are (T,). States lost on the way are simply not there.
    """

    time_s: Array
    north_m: Array
    east_m: Array
    yaw_rad: Array

    def position_at(self, time_s: Array | float) -> Array:
        """Return north, east (..., 2) at the times, interpolated, held constant beyond the ends."""
        axes_m = (self.north_m, self.east_m)
        return np.stack([np.interp(time_s, self.time_s, axis_m) for axis_m in axes_m], axis=-1)

    def gap_s(self, time_s: float) -> float:
        """Return how far the nearest state is from a time."""
        after = int(np.searchsorted(self.time_s, time_s))
        near_s = self.time_s[max(after - 1, 0) : after + 1]
        return float(np.min(np.abs(near_s - time_s)))


@dataclass(frozen=True, slots=True, kw_only=True)
class BinnedSoundings:
    """Soundings thinned to the mean of each occupied cell; all arrays are (K,).

    variance_m2 is that of the mean depth; time_s is the mean time at which the cell was measured.
    """

    cell_m: float
    north_m: Array
    east_m: Array
    depth_m: Array
    variance_m2: Array
    count: Array
    time_s: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Submap:
    """Forty seconds of one vehicle's survey, in raw dead reckoning."""

    vehicle: int
    boot_epoch: int
    index: int
    track: Track
    bins: BinnedSoundings


def joined(parts: Sequence[Submap]) -> Submap:
    """Return consecutive stretches of one vehicle's survey as one sub-map, numbered as the last."""
    bins = [part.bins for part in parts]
    return dataclasses.replace(
        parts[-1],
        track=concatenated([part.track for part in parts]),
        bins=concatenated(bins, cell_m=max(b.cell_m for b in bins)),
    )


def concatenated(parts: Sequence[Values], **common: object) -> Values:
    """Return dataclasses of arrays one after the other; fields that are no arrays are given."""
    names = [f.name for f in dataclasses.fields(parts[0]) if f.name not in common]
    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return dataclasses.replace(parts[0], **arrays, **common)


@dataclass(frozen=True, slots=True, kw_only=True)
class GriddedSubmap:
    """Depths on a regular grid in raw dead reckoning.

    Cell (i, j) lies at north0_m + i cell_m, east0_m + j cell_m. depth_m, variance_m2 and time_s
    are (R, C), NaN where nothing is known. time_s says when the cell was measured, so that drift
    within the sub-map can be taken out. reconstructed grids are what a decoder made of a packet's
    numbers; others are the soundings themselves.
    """

    north0_m: float
    east0_m: float
    cell_m: float
    depth_m: Array
    variance_m2: Array
    time_s: Array
    reconstructed: bool = False
