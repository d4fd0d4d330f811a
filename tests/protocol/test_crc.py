"""What the CRC of a 256-byte frame catches, by enumeration of its syndromes.

The CRC is linear: an error pattern passes exactly when the syndromes of its bits cancel. The
syndrome of a bit depends on its distance from the frame's end only, so that what holds for the
largest frame holds for every smaller one.
"""

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.crc import crc32c, with_crc

FRAME_BITS = 8 * 256


def syndrome(frame: bytes) -> int:
    return crc32c(frame[:-4]) ^ int.from_bytes(frame[-4:], "little")


@pytest.fixture(scope="module")
def syndromes() -> NDArray[np.uint32]:
    """Syndrome of each single turned bit, bytes in order, least significant bit first."""
    sound = with_crc(bytes(252))
    values = []
    for position in range(FRAME_BITS):
        frame = bytearray(sound)
        frame[position // 8] ^= 1 << position % 8
        values.append(syndrome(bytes(frame)))
    return np.array(values, dtype=np.uint32)


def rank(vectors: list[int]) -> int:
    basis: list[int] = []
    for vector in vectors:
        for pivot in basis:
            vector = min(vector, vector ^ pivot)  # noqa: PLW2901
        if vector:
            basis.append(vector)
    return len(basis)


def test_syndromes_add_up(syndromes: NDArray[np.uint32]) -> None:
    frame = bytearray(with_crc(bytes(range(252))))
    for position in (3, 700, 1999, 2047):
        frame[position // 8] ^= 1 << position % 8
    together = syndromes[3] ^ syndromes[700] ^ syndromes[1999] ^ syndromes[2047]
    assert syndrome(bytes(frame)) == together


def test_every_error_of_an_odd_number_of_bits_is_caught(syndromes: NDArray[np.uint32]) -> None:
    # one linear function is 1 on every column, so an odd sum of columns is never 0
    with_one = [int(value) << 1 | 1 for value in syndromes]
    assert rank([*with_one, 1]) == rank(with_one) + 1  # (0, 1) is no sum of any of them


def test_every_error_of_two_or_four_bits_is_caught(syndromes: NDArray[np.uint32]) -> None:
    assert np.unique(syndromes).size == FRAME_BITS
    first, second = np.triu_indices(FRAME_BITS, 1)
    pairs = syndromes[first] ^ syndromes[second]
    pairs.sort()
    assert pairs.size == 2_096_128
    assert pairs[0] != 0
    assert (np.diff(pairs) != 0).all()  # two pairs with one sum would be four bits that cancel


def test_every_burst_of_up_to_32_bits_is_caught_in_the_order_of_a_uart(
    syndromes: NDArray[np.uint32],
) -> None:
    columns = [int(value) for value in syndromes]
    windows = range(FRAME_BITS - 31)
    assert all(rank(columns[start : start + 32]) == 32 for start in windows)


def test_every_burst_of_up_to_25_bits_is_caught_with_bytes_sent_most_significant_bit_first(
    syndromes: NDArray[np.uint32],
) -> None:
    columns = [int(value) for value in syndromes.reshape(-1, 8)[:, ::-1].ravel()]
    windows = range(FRAME_BITS - 24)
    assert all(rank(columns[start : start + 25]) == 25 for start in windows)


def test_heavy_damage_passes_as_rarely_as_chance() -> None:
    # sixteen bits of the syndrome stand for all thirty-two, so that some do pass
    rng = np.random.default_rng(1)
    count = 200_000
    damaged = rng.bytes(42 * count)
    passed = sum(
        syndrome(damaged[start : start + 42]) & 0xFFFF == 0 for start in range(0, 42 * count, 42)
    )
    expected = count / 65_536
    assert abs(passed - expected) < 4.0 * np.sqrt(expected)
