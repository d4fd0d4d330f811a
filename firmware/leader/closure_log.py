"""Closures on which nothing more will be decided, kept as a row of bytes each."""

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from firmware.geometry import Array
from firmware.leader.atlas import SheetId
from firmware.leader.closures import Closure, Stage

_ROW = struct.Struct("<d 6i 2d 2d 3d d d B ?")
_STAGES = tuple(Stage)
MOST = 200_000
"""Five days of them, 28 MB; the oldest are overwritten."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """A detected closure and how far it came; see `Closure`."""

    time_s: float
    origin: SheetId
    target: SheetId
    origin_time_s: float
    target_time_s: float
    offset_m: Array  # (2,)
    covariance_m2: Array  # (2, 2)
    residual: float
    axis_deg: float | None
    stage: Stage
    active: bool


def verdict_of(closure: Closure) -> Verdict:
    """Return what is to be remembered of a closure."""
    return Verdict(
        time_s=closure.time_s,
        origin=closure.origin,
        target=closure.target,
        origin_time_s=closure.origin_anchor.time_s,
        target_time_s=closure.target_anchor.time_s,
        offset_m=closure.offset_m,
        covariance_m2=closure.covariance_m2,
        residual=closure.residual,
        axis_deg=closure.axis_deg,
        stage=closure.stage,
        active=closure.active,
    )


class ClosureLog:
    """Verdicts in the order in which they were added."""

    def __init__(self) -> None:
        self._rows = bytearray()
        self.overwritten = 0

    def __len__(self) -> int:
        return len(self._rows) // _ROW.size

    def __iter__(self) -> Iterator[Verdict]:
        return map(_verdict, _ROW.iter_unpack(bytes(self._rows)))

    def add(self, closure: Closure) -> None:
        """Keep a closure's verdict."""
        if len(self) >= MOST:
            del self._rows[: _ROW.size]
            self.overwritten += 1
        c = closure
        self._rows += _ROW.pack(
            c.time_s,
            *(c.origin.vehicle, c.origin.boot_epoch, c.origin.submap),
            *(c.target.vehicle, c.target.boot_epoch, c.target.submap),
            *(c.origin_anchor.time_s, c.target_anchor.time_s),
            *c.offset_m,
            *(c.covariance_m2[0, 0], c.covariance_m2[0, 1], c.covariance_m2[1, 1]),
            c.residual,
            math.nan if c.axis_deg is None else c.axis_deg,
            _STAGES.index(c.stage),
            c.active,
        )


def _verdict(row: tuple[float, ...]) -> Verdict:
    ids = [int(value) for value in row[1:7]]
    return Verdict(
        time_s=row[0],
        origin=SheetId(vehicle=ids[0], boot_epoch=ids[1], submap=ids[2]),
        target=SheetId(vehicle=ids[3], boot_epoch=ids[4], submap=ids[5]),
        origin_time_s=row[7],
        target_time_s=row[8],
        offset_m=np.array(row[9:11]),
        covariance_m2=np.array([[row[11], row[12]], [row[12], row[13]]]),
        residual=row[14],
        axis_deg=None if math.isnan(row[15]) else row[15],
        stage=_STAGES[int(row[16])],
        active=bool(row[17]),
    )
