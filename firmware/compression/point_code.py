"""Places and depths of pseudo points in few bits: what order and neighbours tell is not sent.

Places are whole numbers in a box. The box is halved again and again, and each half told how many
points it holds; points without an order need log2(M!) bits less than a list. Counts are coded with
the odds of points that keep apart, C(n, k)^2 for equal halves, in exact integers.

Depths follow in an order from coarse to fine. Each is predicted from those before it by the
leader's own Gaussian process (a row of the covariance's Cholesky factor); only whole steps of the
difference are coded. Sums of floats never choose a symbol's odds, so machines need not agree on
their last bit.
"""

from collections.abc import Generator
from functools import lru_cache
from itertools import accumulate
from math import gcd

import numpy as np
from numpy.typing import NDArray

from firmware.geometry import Array
from protocol.arithmetic import Contexts, Decoder, Encoder
from protocol.errors import RemoteProtocolError

_CLASSES = 24  # bits of a difference in steps: 130 km at a step of 8 mm
_POINTS_A_STEP = 32  # some milliseconds
_STAGES = 4  # of the order from coarse to fine, each with its own odds

Places = NDArray[np.int64]
Box = tuple[int, int, int, int]  # first row and column, rows, columns


def encode_place_steps(
    places: Places, shape: tuple[int, int], encoder: Encoder
) -> Generator[None, None, NDArray[np.intp]]:
    """Code places (M, 2) within a box of rows and columns; the value is the order a reader gets."""
    rows_columns = places.tolist()
    order: list[int] = []
    open_boxes: list[tuple[Box, list[int]]] = [((0, 0, *shape), list(range(len(places))))]
    while open_boxes:
        box, inside = open_boxes.pop()
        if len(inside) <= 1 or box[2:] == (1, 1):
            if len(inside) == 1:
                _encode_alone(rows_columns[inside[0]], box, encoder)
            order += inside
            if len(order) % _POINTS_A_STEP == 0:
                yield
            continue
        first, second, axis = _halves(box)
        in_first = [i for i in inside if rows_columns[i][axis] < second[axis]]
        in_second = [i for i in inside if rows_columns[i][axis] >= second[axis]]
        odds = _odds(len(inside), box, first)
        _encode_count(len(in_second), len(inside), odds, encoder)
        open_boxes += [(second, in_second), (first, in_first)]
    return np.array(order, dtype=np.intp)


def _encode_alone(place: list[int], box: Box, encoder: Encoder) -> None:
    """Code where in a box its only point lies, as counts of one would, at a third of the time."""
    row, column, rows, columns = place[0] - box[0], place[1] - box[1], box[2], box[3]
    while rows > 1 or columns > 1:
        if rows >= columns:
            half, bit = rows // 2, int(row >= rows // 2)
            encoder.encode(bit, _clipped(65536 * (rows - half) // rows))
            row, rows = (row - half, rows - half) if bit else (row, half)
        else:
            half, bit = columns // 2, int(column >= columns // 2)
            encoder.encode(bit, _clipped(65536 * (columns - half) // columns))
            column, columns = (column - half, columns - half) if bit else (column, half)


def decode_places(count: int, shape: tuple[int, int], decoder: Decoder) -> Places:
    """Return places (M, 2); raises CodeEnd when the code ends within them."""
    places: list[tuple[int, int]] = []
    open_boxes: list[tuple[Box, int]] = [((0, 0, *shape), count)]
    while open_boxes:
        box, inside = open_boxes.pop()
        if not inside or box[2:] == (1, 1):
            places += [box[:2]] * inside
            continue
        first, second, _ = _halves(box)
        in_second = _decode_count(inside, _odds(inside, box, first), decoder)
        open_boxes += [(second, in_second), (first, inside - in_second)]
    return np.array(places, dtype=np.int64).reshape(-1, 2)


def _halves(box: Box) -> tuple[Box, Box, int]:
    """Return both halves of a box, cut across its longer side, and the axis of the cut."""
    row, column, rows, columns = box
    if rows >= columns:
        half = rows // 2
        return (row, column, half, columns), (row + half, column, rows - half, columns), 0
    half = columns // 2
    return (row, column, rows, half), (row, column + half, rows, columns - half), 1


def _odds(count: int, box: Box, first: Box) -> list[int]:
    """Return the running sums of the odds that 0, 1 ... count of the points are in the second."""
    one = first[2] * first[3]
    other = box[2] * box[3] - one
    common = gcd(one, other)  # leaves the odds as they are, and their numbers short
    return _running_odds(count, one // common, other // common)


@lru_cache(maxsize=64)
def _running_odds(count: int, one: int, other: int) -> list[int]:
    odds = [one**count]
    for k in range(count):
        odds.append(odds[-1] * (count - k) ** 2 * other // ((k + 1) ** 2 * one))
    return [0, *accumulate(odds)]


def _encode_count(value: int, count: int, sums: list[int], encoder: Encoder) -> None:
    low, high = 0, count
    while low < high:
        middle = (low + high) // 2
        above = value > middle
        encoder.encode(int(above), _share(sums, low, middle, high))
        low, high = (middle + 1, high) if above else (low, middle)


def _decode_count(count: int, sums: list[int], decoder: Decoder) -> int:
    low, high = 0, count
    while low < high:
        middle = (low + high) // 2
        above = decoder.decode(_share(sums, low, middle, high))
        low, high = (middle + 1, high) if above else (low, middle)
    return low


def _share(sums: list[int], low: int, middle: int, high: int) -> int:
    """Return the odds, in 1/65536, that a number from low to high lies above the middle."""
    return _clipped(65536 * (sums[high + 1] - sums[middle + 1]) // (sums[high + 1] - sums[low]))


def _clipped(share: int) -> int:
    return min(max(share, 1), 65535)


def coarse_to_fine(count: int) -> NDArray[np.intp]:
    """Return an order of points along their boxes that spreads from the first on."""
    bits = max(count - 1, 1).bit_length()
    index = np.arange(1 << bits)
    mirrored = np.zeros_like(index)
    for bit in range(bits):
        mirrored |= (index >> bit & 1) << (bits - 1 - bit)
    return np.asarray(mirrored[mirrored < count], dtype=np.intp)


def encode_depths(depth_m: Array, lower: Array, step_m: float, encoder: Encoder) -> Array:
    """Code depths (M,) about their mean in order; return what a reader gets, within step_m / 2.

    lower is the Cholesky factor of their correlation.
    """
    counts = _contexts()
    sent_m, white = np.empty(len(depth_m)), np.zeros(len(depth_m))
    for i, wanted_m in enumerate(depth_m):
        predicted_m = float(lower[i, :i] @ white[:i])
        steps = round((float(wanted_m) - predicted_m) / step_m)
        _encode_steps(steps, _stage(i), counts, encoder)
        sent_m[i] = predicted_m + steps * step_m
        white[i] = (sent_m[i] - predicted_m) / lower[i, i]
    return sent_m


def decode_depths(lower: Array, step_m: float, decoder: Decoder) -> Array:
    """Return depths (M,) about their mean; raises CodeEnd when the code ends within them."""
    counts = _contexts()
    sent_m, white = np.empty(len(lower)), np.zeros(len(lower))
    for i in range(len(lower)):
        predicted_m = float(lower[i, :i] @ white[:i])
        sent_m[i] = predicted_m + step_m * _decode_steps(_stage(i), counts, decoder)
        white[i] = (sent_m[i] - predicted_m) / lower[i, i]
    return sent_m


def _stage(index: int) -> int:
    """Return the odds' context: every stage has four times the points of the one before."""
    return min(max(index.bit_length() - 4, 0) // 2, _STAGES - 1)


def _contexts() -> Contexts:
    """Return fresh counts: per stage, of ever more bits, and of the bit below the highest."""
    return Contexts(_STAGES * 2 * _CLASSES)


def _encode_steps(steps: int, stage: int, counts: Contexts, encoder: Encoder) -> None:
    """Code how many bits the size has, then these bits but the highest, then the sign."""
    size, bits = abs(steps), min(abs(steps).bit_length(), _CLASSES - 1)
    first = stage * 2 * _CLASSES
    marks = [1] * bits + [0]
    encoder.encode_adaptive(marks, range(first, first + bits + 1), counts)
    if bits > 1:
        encoder.encode_adaptive([size >> (bits - 2) & 1], [first + _CLASSES + bits], counts)
        encoder.encode_number(size & ((1 << (bits - 2)) - 1), bits - 2)
    if bits:
        encoder.encode(int(steps < 0), 32768)


def _decode_steps(stage: int, counts: Contexts, decoder: Decoder) -> int:
    first = stage * 2 * _CLASSES
    bits = 0
    while True:
        mark = decoder.decode(counts.share(first + bits))
        counts.count(first + bits, mark)
        if not mark:
            break
        bits += 1
        if bits == _CLASSES:
            raise RemoteProtocolError(f"a depth {1 << bits} steps from its neighbours'")
    size = 1 if bits else 0
    if bits > 1:
        context = first + _CLASSES + bits
        below = decoder.decode(counts.share(context))
        counts.count(context, below)
        size = (2 | below) << (bits - 2) | decoder.decode_number(bits - 2)
    return -size if bits and decoder.decode(32768) else size
