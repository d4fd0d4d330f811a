"""Parity of lost points in the mantissas of those that arrive: the paper's packet, unchanged.

A float32 at 500 m steps by 0.03 mm; a pseudo point needs no better than some centimetres, since its
depth is solved for the position it has. Coordinates are therefore rounded to steps q, and the
place of the float within its step carries a byte:

    v = q (index + (byte + 0.5) / 256 - 0.5)

A reader who knows nothing of it sees the same points, moved by less than q / 2. The 45 bytes of a
packet's 15 points are parity (`protocol.erasure`) over the 65 bytes that say all ten packets'
points modulo a window: any six of ten packets give all 150 points. The low six bits of the mean
depth say whether and in which steps: bit 0 set, bits 1-2 i and bits 3-5 j of the steps
2^(i - 3) m in north and east and 2^(j - 8) m in depth.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware.compression.results import PAPER_FRAGMENTS, PAPER_POINTS
from firmware.geometry import Array
from protocol.erasure import cauchy, parity_of, product, recovered
from protocol.errors import RemoteProtocolError
from protocol.packets import DEEPEST_M, HIGHEST_M

_FLAG_BITS = np.uint32(0x3F)
_BITS = (11, 11, 12)  # of north, east and depth index
_STRIPES = 5
_DATA_BYTES, _PARITY_BYTES = 65, 45  # per packet; 65 hold 15 points of 34 bits
_REACH = 1 << 15  # steps from the datum at which a float32 still resolves the byte

Float32 = NDArray[np.float32]
Bytes = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True)
class Steps:
    """The steps of north, east and depth, as told in the mean depth's low bits."""

    position: int  # 0 to 3
    depth: int  # 0 to 7

    @property
    def sizes_m(self) -> Array:
        """Return (3,) north, east, depth."""
        position_m = 2.0 ** (self.position - 3)
        return np.array([position_m, position_m, 2.0 ** (self.depth - 8)])


def fitting_steps(points_ned_m: Array, mean_depth_m: float) -> Steps | None:
    """Return the finest steps in which points (M, 3) fit their windows, or None if none do."""
    if not np.isfinite(points_ned_m).all():
        return None
    farthest = np.abs(points_ned_m).max(axis=0)
    span_m = np.ptp(points_ned_m[:, :2], axis=0).max()
    swing_m = np.abs(points_ned_m[:, 2] - mean_depth_m).max()
    for position in range(4):
        q = 2.0 ** (position - 3)
        if span_m < q * 1020 and farthest[:2].max() < q * _REACH:
            break
    else:
        return None
    for depth in range(8):
        q = 2.0 ** (depth - 8)
        if swing_m < q * 2040 and farthest[2] < q * _REACH:
            return Steps(position=position, depth=depth)
    return None


def flagged(mean_depth_m: float, steps: Steps | None) -> np.float32:
    """Return the mean depth as sent, its low bits telling the steps, or zero for no parity."""
    bits = np.float32(mean_depth_m).view(np.uint32) & ~_FLAG_BITS
    if steps is not None:
        bits |= np.uint32(1 | steps.position << 1 | steps.depth << 3)
    return np.uint32(bits).view(np.float32)


def steps_of(mean_depth_m: np.float32) -> Steps | None:
    """Return what the low bits of a received mean depth say."""
    bits = int(np.float32(mean_depth_m).view(np.uint32) & _FLAG_BITS)
    return Steps(position=bits >> 1 & 3, depth=bits >> 3) if bits & 1 else None


def with_parity(points_ned_m: Array, steps: Steps) -> Float32:
    """Return points (150, 3) of ten fragments with parity in their mantissas."""
    index = np.round(points_ned_m / steps.sizes_m).astype(np.int64)
    data = np.stack([_packed(part) for part in index.reshape(PAPER_FRAGMENTS, PAPER_POINTS, 3)])
    parity = parity_of(data.reshape(-1, _STRIPES), PAPER_FRAGMENTS * _PARITY_BYTES // _STRIPES)
    payload = parity.reshape(PAPER_FRAGMENTS * PAPER_POINTS, 3)
    return (steps.sizes_m * (index + (payload + 0.5) / 256.0 - 0.5)).astype(np.float32)


def without_parity(points_ned_m: NDArray[np.float32] | Array, steps: Steps) -> Array:
    """Return the points (M, 3) that were meant: rounded to their steps."""
    return np.round(np.asarray(points_ned_m, dtype=np.float64) / steps.sizes_m) * steps.sizes_m


def completed(fragments: Mapping[int, Float32], mean_depth_m: np.float32) -> tuple[Array, int]:
    """Return all points (M, 3) to be had from fragments (15, 3), and how many were recovered.

    Without parity, or where the mean depth means nothing, these are the points that arrived. When
    too much was lost to tell whether there is parity, they are the same, rounded to its steps.
    """
    arrived = [np.asarray(fragments[i], dtype=np.float64) for i in sorted(fragments)]
    points = np.concatenate(arrived)
    steps = steps_of(mean_depth_m)
    usable = all(0 <= i < PAPER_FRAGMENTS for i in fragments) and len(points) == (
        PAPER_POINTS * len(fragments)
    )
    usable &= bool(HIGHEST_M <= mean_depth_m <= DEEPEST_M)
    if steps is None or not usable or not np.isfinite(points).all():
        return points, 0
    if np.abs(points / steps.sizes_m).max() > 4 * _REACH:
        return points, 0
    scaled = points / steps.sizes_m
    index = np.round(scaled).astype(np.int64)
    whole = index * steps.sizes_m
    payload = np.clip(np.floor((scaled - index + 0.5) * 256.0), 0, 255).astype(np.uint8)
    lost = [i for i in range(PAPER_FRAGMENTS) if i not in fragments]
    if _DATA_BYTES * len(lost) > _PARITY_BYTES * len(fragments):
        return whole, 0
    try:
        data = _data_of(sorted(fragments), index, payload)
    except RemoteProtocolError:
        return points, 0
    if not lost:
        return whole, 0
    centre = np.median(index, axis=0).astype(np.int64)
    centre[2] = round(float(mean_depth_m) / steps.sizes_m[2])
    restored = np.concatenate([_unpacked(data[i], centre) for i in lost]) * steps.sizes_m
    return np.concatenate([whole, restored]), len(restored)


def _data_of(have: list[int], index: NDArray[np.int64], payload: Bytes) -> Bytes:
    """Return the data bytes (10, 65) of all fragments, from those that arrived and their parity."""
    per_frame = _DATA_BYTES // _STRIPES
    data = np.zeros((PAPER_FRAGMENTS, _DATA_BYTES), dtype=np.uint8)
    parity = np.zeros((PAPER_FRAGMENTS, _PARITY_BYTES), dtype=np.uint8)
    for row, fragment in enumerate(have):
        mine = slice(row * PAPER_POINTS, (row + 1) * PAPER_POINTS)
        data[fragment] = _packed(index[mine])
        parity[fragment] = payload[mine].ravel()
    arrived = np.isin(np.arange(PAPER_FRAGMENTS), have)
    have_data = np.repeat(arrived, per_frame)
    have_parity = np.flatnonzero(np.repeat(arrived, _PARITY_BYTES // _STRIPES)).astype(np.int64)
    rows, checks = data.reshape(-1, _STRIPES), parity.reshape(-1, _STRIPES)
    full = recovered(rows, checks, have_data, have_parity)
    spare = have_parity[np.count_nonzero(~have_data) :]
    expected = product(cauchy(len(full), len(checks))[spare], full)
    if not np.array_equal(expected, checks[spare]):
        raise RemoteProtocolError("the mantissas hold no parity of these points")
    return full.reshape(PAPER_FRAGMENTS, _DATA_BYTES)


def _packed(index: NDArray[np.int64]) -> Bytes:
    """Return the 65 bytes that say indices (15, 3) modulo their windows."""
    fields = [
        (index[:, axis, None] >> np.arange(bits - 1, -1, -1)) & 1 for axis, bits in enumerate(_BITS)
    ]
    flat = np.concatenate(fields, axis=1).astype(np.uint8).ravel()
    return np.packbits(np.pad(flat, (0, 8 * _DATA_BYTES - flat.size)))


def _unpacked(data: Bytes, centre: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return indices (15, 3), each the one nearest to the centre."""
    flat = np.unpackbits(data)[: PAPER_POINTS * sum(_BITS)].reshape(PAPER_POINTS, -1)
    index = np.empty((PAPER_POINTS, 3), dtype=np.int64)
    first = 0
    for axis, bits in enumerate(_BITS):
        weights = 1 << np.arange(bits - 1, -1, -1)
        value = flat[:, first : first + bits].astype(np.int64) @ weights
        half = 1 << (bits - 1)
        index[:, axis] = centre[axis] + (value - centre[axis] + half) % (2 * half) - half
        first += bits
    return index
