"""Parity across the frames of a transfer: what was lost comes back from what arrived.

A systematic Cauchy code over GF(2^8), polynomial x^8 + x^4 + x^3 + x^2 + 1 (0x11d): parity symbol i
is the sum over data symbols j of 1 / (x_i + y_j) with x_i = data symbols + i and y_j = j. Every
square part of a Cauchy matrix can be inverted, so any k of the k + m symbols give the k back; k + m
is at most 256. All arrays are uint8; each symbol may be a row of L bytes, coded alike.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from protocol.errors import LocalProtocolError, RemoteProtocolError

Bytes = NDArray[np.uint8]

_POLYNOMIAL = 0x11D
_ORDER = 255


def _tables() -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    exponent = np.zeros(2 * _ORDER + 2, dtype=np.uint8)
    logarithm = np.zeros(256, dtype=np.int64)
    value = 1
    for power in range(_ORDER):
        exponent[power] = exponent[power + _ORDER] = value
        logarithm[value] = power
        value <<= 1
        if value & 0x100:
            value ^= _POLYNOMIAL
    return exponent, logarithm


_EXP, _LOG = _tables()


def multiply(left: Bytes, right: Bytes) -> Bytes:
    """Return the product in GF(2^8), element by element, broadcasting."""
    product = _EXP[_LOG[left] + _LOG[right]]
    return np.where((left == 0) | (right == 0), np.uint8(0), product).astype(np.uint8)


def _inverse(value: Bytes) -> Bytes:
    return np.asarray(_EXP[_ORDER - _LOG[value]], dtype=np.uint8)


@lru_cache(maxsize=32)
def cauchy(data: int, parity: int) -> Bytes:
    """Return the (parity, data) matrix of the code."""
    if data < 1 or parity < 0 or data + parity > 256:
        raise LocalProtocolError(f"{data} data and {parity} parity symbols exceed the field's 256")
    rows = np.arange(data, data + parity, dtype=np.uint8)
    matrix = _inverse(rows[:, None] ^ np.arange(data, dtype=np.uint8)[None, :])
    matrix.setflags(write=False)
    return matrix


def parity_of(data: Bytes, parity: int) -> Bytes:
    """Return the parity symbols (parity, L) of data (k, L)."""
    return product(cauchy(len(data), parity), data)


def recovered(
    data: Bytes, parity: Bytes, have_data: NDArray[np.bool_], have: NDArray[np.int64]
) -> Bytes:
    """Return data (k, L) with its missing rows filled in from parity rows `have` (indices).

    Raises
    ------
    RemoteProtocolError
        When fewer parity symbols arrived than data symbols are missing.
    """
    missing = np.flatnonzero(~have_data)
    if missing.size == 0:
        return data
    if len(have) < missing.size:
        raise RemoteProtocolError(
            f"{missing.size} symbols are missing and only {len(have)} parity symbols arrived"
        )
    used = have[: missing.size]
    matrix = cauchy(len(data), len(parity))[used]
    right = parity[used] ^ product(matrix[:, have_data], data[have_data])
    out = data.copy()
    out[missing] = _solved(matrix[:, missing].copy(), right)
    return out


def product(matrix: Bytes, data: Bytes) -> Bytes:
    """Return the product in GF(2^8) of a matrix (m, k) and data (k, L)."""
    out = np.zeros((len(matrix), data.shape[1]), dtype=np.uint8)
    for column, row in zip(matrix.T, data, strict=True):
        out ^= multiply(column[:, None], row[None, :])
    return out


def _solved(matrix: Bytes, right: Bytes) -> Bytes:
    """Return the solution of a square system by Gauss-Jordan; Cauchy pivots are never zero."""
    right = right.copy()
    for pivot in range(len(matrix)):
        scale = _inverse(matrix[pivot, pivot : pivot + 1])
        matrix[pivot] = multiply(matrix[pivot], scale)
        right[pivot] = multiply(right[pivot], scale)
        factor = matrix[:, pivot].copy()
        factor[pivot] = 0
        matrix ^= multiply(factor[:, None], matrix[pivot][None, :])
        right ^= multiply(factor[:, None], right[pivot][None, :])
    return right
