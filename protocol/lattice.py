"""The body of `lattice` fragments: what every frame says by itself, and columns of parity.

A body of B bytes is: protection (4 bytes), the trajectory (its own length, see
`firmware.compression.track_code`), and a column byte for each of the remaining C places. Column j
of all F frames is a Reed-Solomon codeword (Cauchy, `protocol.erasure`) of k_j bytes of the stream:
the first k_j frames carry these bytes themselves, the others their parity. Any k_j frames give
column j, so r frames give all columns with k_j <= r, and these hold the beginning of the stream:

    byte 0    high nibble k0, low nibble k1
    byte 1    low nibble k2 (high nibble 0)
    byte 2    n0: the first n0 columns have k0
    byte 3    n1: the next n1 have k1; all others have k2
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.erasure import parity_of, recovered
from protocol.errors import LocalProtocolError, RemoteProtocolError

PROTECTION_BYTES = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Protection:
    """How many frames give each part of the stream: thresholds k0 <= k1 <= k2, column counts."""

    thresholds: tuple[int, int, int]
    columns: tuple[int, int]  # with k0 and with k1; the rest have k2

    def __post_init__(self) -> None:
        k0, k1, k2 = self.thresholds
        if not 1 <= k0 <= k1 <= k2 <= 15 or not all(0 <= n <= 255 for n in self.columns):
            raise LocalProtocolError(f"{self} does not fit its nibbles and bytes")

    def to_bytes(self) -> bytes:
        """Return the four bytes of the wire."""
        k0, k1, k2 = self.thresholds
        return bytes([k0 << 4 | k1, k2, *self.columns])

    @classmethod
    def from_bytes(cls, data: bytes) -> "Protection":
        """Return what four bytes say."""
        try:
            return cls(thresholds=(data[0] >> 4, data[0] & 15, data[1]), columns=(data[2], data[3]))
        except LocalProtocolError as error:
            raise RemoteProtocolError(f"protection {data[:4].hex()} is not in order") from error

    def thresholds_of(self, columns: int) -> NDArray[np.int64]:
        """Return k of each of so many columns."""
        n0 = min(self.columns[0], columns)
        n1 = min(self.columns[1], columns - n0)
        return np.repeat(np.array(self.thresholds), [n0, n1, columns - n0 - n1])

    def stream_bytes(self, columns: int, frames: int) -> int:
        """Return the length of the stream that so many frames give."""
        k = self.thresholds_of(columns)
        return int(k[k <= frames].sum())


def frames_for_all(body: bytes) -> int | None:
    """Return how many frames give the whole stream, as one body says; None for one that can't."""
    try:
        return Protection.from_bytes(body).thresholds[2]
    except RemoteProtocolError:
        return None


def bodies_of(
    shared: bytes, stream: bytes, protection: Protection, size: int, frames: int
) -> list[bytes]:
    """Return the bodies of all frames; a stream shorter than the columns is padded with zeros."""
    columns = size - PROTECTION_BYTES - len(shared)
    if columns < 1 or protection.thresholds[2] > frames:
        raise LocalProtocolError(f"{frames} bodies of {size} bytes cannot hold {protection}")
    table = np.zeros((frames, columns), dtype=np.uint8)
    start = 0
    thresholds = protection.thresholds_of(columns)
    data = np.frombuffer(stream, dtype=np.uint8)
    for k in np.unique(thresholds):
        mine = np.flatnonzero(thresholds == k)
        part = np.zeros(k * mine.size, dtype=np.uint8)
        taken = data[start : start + part.size]
        part[: taken.size] = taken
        start += part.size
        block = part.reshape(mine.size, k).T
        table[:k, mine] = block
        table[k:, mine] = parity_of(block, frames - int(k))
    head = protection.to_bytes() + shared
    return [head + row.tobytes() for row in table]


def stream_of(bodies: Mapping[int, bytes], shared_bytes: int, frames: int) -> bytes:
    """Return as much of the stream as the bodies that arrived give.

    Raises
    ------
    RemoteProtocolError
        When the bodies contradict each other or say what no sender says.
    """
    first = next(iter(bodies.values()))
    protection = Protection.from_bytes(first)
    head = PROTECTION_BYTES + shared_bytes
    same = all(b[:head] == first[:head] and len(b) == len(first) for b in bodies.values())
    if not same or protection.thresholds[2] > frames or max(bodies) >= frames:
        raise RemoteProtocolError(f"bodies of fragments {sorted(bodies)} do not belong together")
    columns = len(first) - head
    if columns < 1:
        raise RemoteProtocolError(f"a body of {len(first)} bytes has no room for a map")
    table = np.zeros((frames, columns), dtype=np.uint8)
    for index, body in bodies.items():
        table[index] = np.frombuffer(body, dtype=np.uint8)[head:]
    arrived = np.isin(np.arange(frames), list(bodies))
    thresholds = protection.thresholds_of(columns)
    parts = []
    for k in np.unique(thresholds):
        if k > len(bodies):
            break
        mine = np.flatnonzero(thresholds == k)
        block = table[:, mine]
        have = np.flatnonzero(arrived[k:]).astype(np.int64)
        parts.append(recovered(block[:k], block[k:], arrived[:k], have).T.ravel())
    return np.concatenate(parts).tobytes() if parts else b""
