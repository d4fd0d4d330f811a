"""The `dense` profile: twice the paper's points in the same frames, quantised and protected.

The stream (`protocol.lattice` cuts it to frames): `_HEAD`, then 4.5 bytes a point, 12 bits each of
north, east and depth in their bounds. The first points, spread over the whole map, travel where
half of the frames gives them; all others where as many frames give them as nearly always arrive.
The fit knows both: it minimises the expected error over the two.
"""

import dataclasses
import struct
from collections.abc import Generator
from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import NDArray

from firmware.compression.binning import coarsened
from firmware.compression.calibration import calibrated
from firmware.compression.fit import (
    Dealing,
    FitFrame,
    FittedPoints,
    fit_frame,
    fit_steps,
    moved_steps,
)
from firmware.compression.initial import hilbert_order
from firmware.compression.kernels import Hyperparameters
from firmware.compression.losses import LossPatterns
from firmware.compression.settings import CompressionSettings
from firmware.geometry import Array
from firmware.submaps import BinnedSoundings
from protocol.errors import RemoteProtocolError
from protocol.lattice import PROTECTION_BYTES, Protection, bodies_of, stream_of

_HEAD = struct.Struct(">9fHH")  # hyperparameters, north, east, depth at level 0, steps, counts
_LEVELS = 4095
_FIRST_POINTS = 40  # what half of the frames gives: one point in 20 m
_TRACK_BYTES = 20  # a straight track takes 15; a longer one costs a few points
_RARELY = 0.02  # how often fewer frames than the second threshold may arrive
_PACK_EVERY = 6

Levels = NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class DenseCode:
    """Quantised points, the first `first` of them for the first part, and what reads them."""

    hyperparameters: NDArray[np.float32]
    origin: Array  # north, east, depth at level 0, as float32 values
    steps: Array  # metres a level: horizontal, depth, as float32 values
    levels: Levels  # (M, 3)
    first: int

    @property
    def points_ned_m(self) -> Array:
        """Return the points (M, 3) as any receiver computes them."""
        return _points(self.levels, self.origin, self.steps)


def dense_protection(frames: int, columns: int, loss: float) -> Protection:
    """Return the protection: half of the frames for the first points, nearly all for the rest."""
    half = (frames + 1) // 2
    chance = [comb(frames, r) * (1 - loss) ** r * loss ** (frames - r) for r in range(frames + 1)]
    enough = max([k for k in range(half, frames + 1) if sum(chance[:k]) <= _RARELY] or [half])
    first_bytes = _HEAD.size + _point_bytes(_FIRST_POINTS)
    first = min(-(-first_bytes // half), columns)
    return Protection(thresholds=(half, half, enough), columns=(first, 0))


def dense_counts(frames: int, size: int, track_bytes: int, loss: float) -> tuple[int, int]:
    """Return how many points fit in all, and how many in the first part."""
    columns = size - PROTECTION_BYTES - track_bytes
    protection = dense_protection(frames, columns, loss)
    first = protection.stream_bytes(columns, protection.thresholds[0]) - _HEAD.size
    total = protection.stream_bytes(columns, frames) - _HEAD.size
    return int(total * 2 // 9), min(int(first * 2 // 9), int(total * 2 // 9))


def dense_code_steps(
    bins: BinnedSoundings, settings: CompressionSettings, size: int
) -> Generator[tuple[DenseCode, FittedPoints] | None, None, str]:
    """Yield ever better codes, and None between small steps; the value says why it ended."""
    total, first = dense_counts(settings.frames, size, _TRACK_BYTES, settings.expected_loss)
    cells = coarsened(bins, settings.fit_cell_m)
    count = min(total, cells.depth_m.size)
    frame = fit_frame(cells, settings.max_fit_rows)
    rare = 0.5 * _RARELY

    def deal(position_m: Array) -> Dealing:
        order = hilbert_order(position_m)
        part = np.ones(len(position_m), dtype=np.intp)
        spread = np.linspace(0, len(order) - 1, min(first, len(order))).round().astype(int)
        part[order[spread]] = 0
        patterns = LossPatterns(no_loss=1.0 - rare, lost=((1,),), probability=np.array([rare]))
        return Dealing(fragment=part, patterns=patterns)

    fitting = dataclasses.replace(settings, iterations=settings.dense_iterations)
    steps = fit_steps(frame, count, fitting, deal)
    waiting: FittedPoints | None = None
    packed_at = 0
    while True:
        try:
            step = next(steps)
        except StopIteration as stop:
            ended = str(stop.value)
            break
        waiting = step or waiting
        yield None
        if step is not None and (not packed_at or step.evaluations >= packed_at + _PACK_EVERY):
            packed_at, waiting = step.evaluations, None
            code = yield from _coded_steps(step, frame, bins)
            yield code, step
    if waiting is not None:
        code = yield from _coded_steps(waiting, frame, bins)
        yield code, waiting
    return ended


def _coded_steps(
    fitted: FittedPoints, frame: FitFrame, bins: BinnedSoundings
) -> Generator[None, None, DenseCode]:
    """Quantise positions, fit the depths anew to where they lie now, and quantise those."""
    order = np.argsort(fitted.fragment, kind="stable")
    low = fitted.position_m.min(axis=0) + frame.origin_m
    span = float(np.ptp(fitted.position_m, axis=0).max())
    step = float(np.float32(max(span / (_LEVELS - 1), 1e-4)))
    origin = np.float32(low).astype(np.float64)
    levels = np.clip(np.round((fitted.position_m + frame.origin_m - origin) / step), 0, _LEVELS)
    at_m = levels * step + origin - frame.origin_m
    fitted = yield from moved_steps(fitted, at_m, frame)
    depth_m = fitted.depth_m + frame.mean_depth_m
    depth0 = float(np.float32(depth_m.min()))
    depth_step = float(np.float32(max(float(np.ptp(depth_m)) / (_LEVELS - 1), 1e-6)))
    depths = np.clip(np.round((depth_m - depth0) / depth_step), 0, _LEVELS)
    code = DenseCode(
        hyperparameters=np.zeros(4, dtype=np.float32),
        origin=np.append(origin, depth0),
        steps=np.array([step, depth_step]),
        levels=np.column_stack([levels, depths]).astype(np.int64)[order],
        first=int(np.count_nonzero(fitted.fragment == 0)),
    )
    hyper = Hyperparameters(
        b_per_m=fitted.b_per_m,
        c_m2=1.0,
        sigma2_m2=0.0,
        mean_depth_m=frame.mean_depth_m,
        kernel=fitted.kernel,
    )
    yield
    hyper, _ = calibrated(code.points_ned_m, hyper, bins)
    return dataclasses.replace(code, hyperparameters=hyper.to_wire())


def dense_bodies(code: DenseCode, track: bytes, size: int, frames: int, loss: float) -> list[bytes]:
    """Return the bodies of so many frames; points that a long track leaves no room for are cut."""
    total, first = dense_counts(frames, size, len(track), loss)
    columns = size - PROTECTION_BYTES - len(track)
    protection = dense_protection(frames, columns, loss)
    levels = code.levels[:total]
    head = _HEAD.pack(*code.hyperparameters, *code.origin, *code.steps, len(levels), first)
    first_bytes = protection.stream_bytes(columns, protection.thresholds[0])
    beginning = (head + _packed(levels[:first])).ljust(first_bytes, b"\0")
    return bodies_of(track, beginning + _packed(levels[first:]), protection, size, frames)


def dense_points(
    bodies: dict[int, bytes], track_bytes: int, frames: int
) -> tuple[Array, NDArray[np.float32]]:
    """Return points (M, 3) and hyperparameters (4,) that the bodies that arrived give.

    Raises
    ------
    RemoteProtocolError
        When they give none, or say what no sender says.
    """
    stream = stream_of(bodies, track_bytes, frames)
    if len(stream) < _HEAD.size:
        raise RemoteProtocolError(f"{len(bodies)} of {frames} fragments give no points")
    *values, count, first = _HEAD.unpack_from(stream)
    body = next(iter(bodies.values()))
    columns = len(body) - PROTECTION_BYTES - track_bytes
    protection = Protection.from_bytes(body)
    cut = protection.stream_bytes(columns, protection.thresholds[0])
    first = min(first, count)
    parts = [_unpacked(stream[_HEAD.size : cut], first)]
    if len(stream) > cut:
        parts.append(_unpacked(stream[cut:], count - first))
    numbers = np.array(values)
    if not np.isfinite(numbers[4:]).all():
        raise RemoteProtocolError("bounds that are no numbers")
    points = _points(np.concatenate(parts), numbers[4:7], numbers[7:9])
    return points, numbers[:4].astype(np.float32)


def _points(levels: Levels, origin: Array, steps: Array) -> Array:
    out: Array = origin + levels * np.array([steps[0], steps[0], steps[1]])
    return out


def _point_bytes(count: int) -> int:
    return (9 * count + 1) // 2


def _packed(levels: Levels) -> bytes:
    bits = (levels.ravel()[:, None] >> np.arange(11, -1, -1)) & 1
    return np.packbits(bits.astype(np.uint8).ravel()).tobytes()


def _unpacked(data: bytes, count: int) -> Levels:
    count = min(count, len(data) * 2 // 9)
    bits = np.unpackbits(np.frombuffer(data[: _point_bytes(count)], dtype=np.uint8))
    weights = 1 << np.arange(11, -1, -1)
    return np.asarray(bits[: 36 * count].reshape(count, 3, 12).astype(np.int64) @ weights)
