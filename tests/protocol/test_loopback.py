"""Modems over the water in one process."""

import numpy as np
import pytest

from protocol.acoustics import Delivery, Water, WaterSettings
from protocol.errors import ConfigError
from protocol.modems.base import QUEUED_EVENTS, QUEUED_FRAMES, Reception
from protocol.modems.loopback import LARGEST_FRAME_BYTES, LoopbackMedium

QUIET = WaterSettings(loss=0.0, outlier_share=0.0, range_noise_m=0.0)


def medium(record: "list[Delivery] | None" = None, nodes: int = 2) -> LoopbackMedium:
    water = Water(
        QUIET,
        np.random.default_rng(1),
        lambda node, _: (750.0 * node, 0.0, 0.0),
        range(nodes),
    )
    return LoopbackMedium(water, record.append if record is not None else None)


def test_a_frame_is_sent_at_the_moment_it_is_handed_over() -> None:
    recorded: list[Delivery] = []
    shared = medium(recorded, nodes=3)
    one, two = shared.modem(0), shared.modem(1)
    one.send(b"x" * 125, 8.0)
    two.poll(20.0)
    event = two.next_event()
    assert isinstance(event, Reception)
    assert event.toa_s == pytest.approx(8.5)
    assert event.heard_s == pytest.approx(9.5)
    assert [d.destination for d in recorded] == [1, 2]  # node 2 has no modem and is recorded
    assert one.largest_frame_bytes == LARGEST_FRAME_BYTES


def test_a_second_frame_waits_for_the_first() -> None:
    recorded: list[Delivery] = []
    shared = medium(recorded)
    modem = shared.modem(0)
    for _ in range(2):
        modem.send(b"x" * 125, 0.0)
    assert modem.status().queued == 1
    modem.poll(0.9)
    assert modem.status().queued == 1
    modem.poll(1.0)
    assert (modem.status().queued, modem.status().sent) == (0, 2)
    shared.advance(10.0)
    assert [d.t_tx_s for d in recorded] == [0.0, 1.0]


def test_queues_are_bounded_and_drops_counted() -> None:
    shared = medium()
    one, two = shared.modem(0), shared.modem(1)
    for i in range(QUEUED_FRAMES + 3):  # the first is on the air at once
        one.send(bytes([i]), 0.0)
    assert (one.status().queued, one.status().dropped_out) == (QUEUED_FRAMES, 2)
    one.close()
    assert one.status().queued == 0
    for i in range(QUEUED_EVENTS + 5):
        one.send(b"y", 10.0 + i)
    two.poll(1000.0)
    assert two.status().dropped_in == 6  # one more was on the air before
    assert two.status().received == QUEUED_EVENTS + 6
    assert two.status().is_up


def test_a_node_that_is_not_in_the_water_is_named() -> None:
    with pytest.raises(ConfigError, match="node 5 is not in the water"):
        medium().modem(5)
