"""Places and depths of points, there and back."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware.compression.decoder import NUGGET, factorised
from firmware.compression.kernels import Kernel, correlation, squared_distance
from firmware.compression.point_code import (
    coarse_to_fine,
    decode_depths,
    decode_places,
    encode_depths,
    encode_place_steps,
)
from firmware.compression.steps import run
from protocol.arithmetic import CodeEnd, Decoder, Encoder


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 90), st.integers(1, 300), st.integers(1, 300))
def test_places_come_back_in_the_order_the_coder_tells(
    seed: int, count: int, rows: int, columns: int
) -> None:
    rng = np.random.default_rng(seed)
    places = np.column_stack([rng.integers(rows, size=count), rng.integers(columns, size=count)])
    encoder = Encoder()
    order = run(encode_place_steps(places, (rows, columns), encoder))
    found = decode_places(count, (rows, columns), Decoder(encoder.finish()))
    assert np.array_equal(found, places[order])


def test_places_without_order_take_fewer_bits_than_a_list() -> None:
    rng = np.random.default_rng(2)
    places = rng.integers(256, size=(400, 2))
    encoder = Encoder()
    run(encode_place_steps(places, (256, 256), encoder))
    assert len(encoder.finish()) < 0.62 * 400 * 16 / 8  # 16 bits each; log2(400!) less: 0.55


@pytest.mark.parametrize("count", [1, 2, 3, 64, 450])
def test_coarse_order_takes_every_point_once_and_spreads_at_once(count: int) -> None:
    order = coarse_to_fine(count)
    assert np.array_equal(np.sort(order), np.arange(count))
    if count >= 64:
        assert np.diff(np.sort(order[:8])).max() <= count // 4


def test_depths_come_back_within_half_a_step_and_neighbours_save_bits() -> None:
    rng = np.random.default_rng(3)
    position_m = rng.uniform(0.0, 100.0, (300, 2))
    k = correlation(Kernel.MATERN32, squared_distance(position_m, position_m, 0.05))
    lower, _, _ = factorised(k, NUGGET)
    depth_m = np.tril(lower) @ rng.normal(size=300)
    encoder = Encoder()
    sent_m = encode_depths(depth_m, lower, 0.02, encoder)
    code = encoder.finish()
    assert np.abs(sent_m - depth_m).max() <= 0.01 + 1e-12
    assert np.allclose(decode_depths(lower, 0.02, Decoder(code)), sent_m, atol=1e-9)
    assert len(code) < 300  # 8 bits a depth without neighbours: a spread of 1 m in steps of 2 cm
    with pytest.raises(CodeEnd):
        decode_depths(lower, 0.02, Decoder(code[: len(code) // 2]))
