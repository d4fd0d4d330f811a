"""Parity across frames: any k of k + m symbols give the k back."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.arithmetic import CodeEnd, Contexts, Decoder, Encoder
from protocol.erasure import parity_of, recovered
from protocol.errors import LocalProtocolError, RemoteProtocolError
from protocol.lattice import Protection, bodies_of, stream_of


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 30), st.integers(0, 30), st.integers(0, 2**32 - 1))
def test_any_symbols_enough_in_number_give_the_data(k: int, m: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    data = rng.integers(0, 256, (k, 3), dtype=np.uint8)
    parity = parity_of(data, m)
    kept = np.sort(rng.permutation(k + m)[:k])
    have_data = np.isin(np.arange(k), kept)
    damaged = np.where(have_data[:, None], data, np.uint8(0))
    have = (kept[kept >= k] - k).astype(np.int64)
    assert np.array_equal(recovered(damaged, parity, have_data, have), data)


def test_too_few_symbols_are_told() -> None:
    data = np.zeros((4, 2), dtype=np.uint8)
    with pytest.raises(RemoteProtocolError, match="2 symbols are missing"):
        recovered(data, parity_of(data, 1), np.array([1, 1, 0, 0], bool), np.array([0]))


def test_a_code_beyond_the_field_is_refused() -> None:
    with pytest.raises(LocalProtocolError, match="256"):
        parity_of(np.zeros((250, 1), dtype=np.uint8), 10)


@pytest.mark.parametrize("arrived", [{1, 8}, {0, 2, 3, 9}, {1, 2, 3, 4, 5, 6, 9}, set(range(10))])
def test_more_frames_give_more_of_the_stream(arrived: set[int]) -> None:
    stream = bytes(np.random.default_rng(1).integers(0, 256, 700, dtype=np.uint8))
    protection = Protection(thresholds=(2, 4, 7), columns=(20, 30))
    bodies = bodies_of(b"track", stream, protection, 120, 10)
    got = stream_of({i: bodies[i] for i in arrived}, 5, 10)
    length = protection.stream_bytes(111, len(arrived))
    assert len(got) == length
    assert got[:700] == stream[:length]


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 3), st.booleans()), max_size=400), st.integers(0, 60))
def test_a_code_cut_anywhere_is_read_up_to_the_cut(
    symbols: list[tuple[int, bool]], cut: int
) -> None:
    encoder, counts = Encoder(), Contexts(4)
    encoder.encode_adaptive([int(b) for _, b in symbols], [c for c, _ in symbols], counts)
    code = encoder.finish()
    decoder, counts, read = Decoder(code[:cut]), Contexts(4), []
    try:
        for context, _ in symbols:
            bit = decoder.decode(counts.share(context))
            counts.count(context, bit)
            read.append(bool(bit))
    except CodeEnd:
        assert cut < len(code)
    assert read == [b for _, b in symbols][: len(read)]
    if cut >= len(code):
        assert len(read) == len(symbols)
