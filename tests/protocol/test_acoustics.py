"""The water: geometry, fates, seeds."""

import numpy as np
import pytest

from protocol.acoustics import Delivery, Position, Water, WaterSettings
from protocol.errors import ConfigError, LocalProtocolError

CLEAN = WaterSettings(loss=0.0, outlier_share=0.0, range_noise_m=0.0)
FRAME = bytes(range(256))


def at(*norths_m: float) -> "list[float]":
    return list(norths_m)


def water(settings: WaterSettings, norths_m: "list[float]", seed: int = 1) -> Water:
    def position_of(node: int, time_s: float) -> Position:  # noqa: ARG001
        return norths_m[node], 0.0, 10.0

    nodes = range(len(norths_m))
    return Water(settings, np.random.default_rng(seed), position_of, nodes)


def run(medium: Water, count: int, gap_s: float = 10.0) -> list[Delivery]:
    for i in range(count):
        medium.transmit(0, gap_s * i, FRAME)
    return medium.deliveries_until(np.inf)


def test_a_frame_arrives_after_travel_time_and_is_handed_over_after_airtime() -> None:
    medium = water(CLEAN, at(0.0, 1500.0))
    medium.transmit(0, 8.0, FRAME)
    assert medium.next_delivery_s() == pytest.approx(8.0 + 1.0 + 2.048)
    assert medium.deliveries_until(11.0) == []
    (delivery,) = medium.deliveries_until(11.1)
    assert delivery.t_rx_s == pytest.approx(9.0)
    assert (delivery.source, delivery.destination, delivery.fate) == (0, 1, "delivered")
    assert delivery.frame == FRAME
    assert medium.next_delivery_s() is None


def test_travel_time_follows_a_receiver_that_moves_away() -> None:
    def position_of(node: int, time_s: float) -> Position:
        return (1000.0 + 2.0 * time_s, 0.0, 0.0) if node else (0.0, 0.0, 0.0)

    medium = Water(CLEAN, np.random.default_rng(1), position_of)
    assert medium.travel_time_s(0, 1, 100.0) == pytest.approx(1200.0 / 1498.0, abs=1e-8)


def test_every_node_hears_a_broadcast_in_order_of_distance() -> None:
    medium = water(CLEAN, at(0.0, 3000.0, 1500.0))
    medium.transmit(0, 0.0, FRAME)
    assert [d.destination for d in medium.deliveries_until(10.0)] == [2, 1]


def test_two_frames_collide_only_where_they_overlap() -> None:
    medium = water(CLEAN, at(-1500.0, 0.0, 4500.0))
    medium.transmit(0, 0.0, FRAME)  # at node 1 from 1.0 to 3.05, at node 2 from 4.0
    medium.transmit(2, 0.5, FRAME)  # at node 1 from 3.5, at node 0 from 4.5
    fates = {(d.source, d.destination): d.fate for d in medium.deliveries_until(20.0)}
    assert set(fates.values()) == {"delivered"}
    medium.transmit(0, 20.0, FRAME)
    medium.transmit(2, 19.0, FRAME)  # at node 1 from 22.0: into the other's 21.0 to 23.05
    deliveries = medium.deliveries_until(40.0)
    fates = {(d.source, d.destination): d.fate for d in deliveries}
    assert fates[0, 1] == fates[2, 1] == "collision"
    assert fates[0, 2] == fates[2, 0] == "delivered"
    assert all(d.t_rx_s is None for d in deliveries if d.fate == "collision")


def test_a_node_that_transmits_does_not_hear() -> None:
    medium = water(CLEAN, at(0.0, 1500.0))
    medium.transmit(0, 0.0, FRAME)
    medium.transmit(1, 2.9, FRAME)
    fates = {d.destination: d.fate for d in medium.deliveries_until(20.0)}
    assert fates == {1: "half-duplex", 0: "delivered"}


def test_a_node_cannot_transmit_twice_at_once() -> None:
    medium = water(CLEAN, at(0.0, 1500.0))
    medium.transmit(0, 0.0, FRAME)
    with pytest.raises(LocalProtocolError, match="still transmits"):
        medium.transmit(0, 1.0, FRAME)
    with pytest.raises(LocalProtocolError, match="not in the water"):
        medium.transmit(7, 1.0, FRAME)
    medium.transmit(0, 2.048, FRAME)


def test_clock_that_is_behind_lengthens_its_own_frames_and_shortens_what_it_hears() -> None:
    late = WaterSettings(
        loss=0.0,
        outlier_share=0.0,
        range_noise_m=0.0,
        clock_offset_ms=10.0,
        clock_drift_ppm=100.0,
    )
    medium = water(late, at(0.0, 1500.0))
    medium.transmit(1, 100.0, FRAME)
    medium.transmit(0, 200.0, FRAME)
    arrivals_s = [delivery.t_rx_s for delivery in medium.deliveries_until(300.0)]
    assert arrivals_s == [pytest.approx(101.0 + 0.02), pytest.approx(201.0 - 0.03)]


def test_loss_has_its_share() -> None:
    settings = WaterSettings(loss=0.14)
    fates = [d.fate for d in run(water(settings, at(0.0, 500.0)), 5000)]
    assert fates.count("lost") / 5000 == pytest.approx(0.14, abs=0.02)


def test_silent_water_carries_nothing_and_changes_nothing_else() -> None:
    silent = WaterSettings(loss=0.3, silent_from_min=10.0, silent_min=5.0)
    fates = [d.fate for d in run(water(silent, at(0.0, 500.0)), 200)]
    heard = [d.fate for d in run(water(WaterSettings(loss=0.3), at(0.0, 500.0)), 200)]
    assert fates[60:90] == ["lost"] * 30
    assert fates[:60] + fates[90:] == heard[:60] + heard[90:]


def test_frames_of_one_packet_are_lost_together_and_answers_alone() -> None:
    medium = water(WaterSettings(loss=0.3, packet_frames=2), at(0.0, 300.0))
    fates = [delivery.fate for delivery in run(medium, 2000)]
    assert fates[::2] == fates[1::2]
    assert fates.count("lost") == pytest.approx(600, abs=70)
    alone = water(WaterSettings(loss=0.3, packet_frames=2), at(0.0, 300.0))
    for i in range(2000):
        alone.transmit(0, 10.0 * i, FRAME[:22])
    singles = [delivery.fate for delivery in alone.deliveries_until(np.inf)]
    assert singles[::2] != singles[1::2]


def test_bursts_have_the_share_and_the_mean_length() -> None:
    settings = WaterSettings(loss=0.14, loss_model="gilbert-elliott", burst_frames=5.0)
    lost = [d.fate == "lost" for d in run(water(settings, at(0.0, 500.0)), 20_000)]
    bursts = sum(now and not before for before, now in zip([False, *lost], lost, strict=False))
    assert sum(lost) / len(lost) == pytest.approx(0.14, abs=0.02)
    assert sum(lost) / bursts == pytest.approx(5.0, abs=0.5)


def test_bursts_that_cannot_be_are_refused_with_what_can() -> None:
    settings = WaterSettings(loss=0.9, loss_model="gilbert-elliott", burst_frames=2.0)
    with pytest.raises(ConfigError, match=r"at least 9\.0"):
        water(settings, at(0.0, 500.0))


def test_ranges_have_the_papers_noise_and_outliers() -> None:
    settings = WaterSettings(loss=0.0)
    deliveries = run(water(settings, at(0.0, 900.0)), 5000)
    ranges_m = np.array([1500.0 * (d.t_rx_s - d.t_tx_s) for d in deliveries if d.t_rx_s])
    outliers = ranges_m > 945.0
    assert outliers.mean() == pytest.approx(0.2, abs=0.02)
    assert ranges_m[outliers].mean() == pytest.approx(990.0, abs=0.2)
    assert ranges_m[~outliers].mean() == pytest.approx(900.0, abs=0.1)
    assert ranges_m[~outliers].std() == pytest.approx(1.0, abs=0.05)


def test_corrupted_frames_arrive_with_turned_bits() -> None:
    settings = WaterSettings(loss=0.0, corruption=0.3)
    deliveries = run(water(settings, at(0.0, 500.0)), 1000)
    corrupt = [d for d in deliveries if d.fate == "corrupt"]
    assert len(corrupt) / 1000 == pytest.approx(0.3, abs=0.05)
    assert all(d.frame != FRAME and len(d.frame) == 256 and d.sent == FRAME for d in corrupt)
    assert all(d.frame == FRAME for d in deliveries if d.fate == "delivered")


def test_an_echo_is_a_second_copy_a_little_later() -> None:
    settings = WaterSettings(loss=0.0, outlier_share=0.0, duplication=1.0)
    medium = water(settings, at(0.0, 500.0))
    medium.transmit(0, 0.0, FRAME)
    first, second = medium.deliveries_until(10.0)
    assert (first.fate, second.fate) == ("delivered", "duplicate")
    assert first.t_rx_s is not None
    assert second.t_rx_s == pytest.approx(first.t_rx_s + settings.echo_delay_s)


def test_beyond_reach_nothing_is_heard() -> None:
    medium = water(WaterSettings(loss=0.0, reach_m=1000.0), at(0.0, 1001.0))
    medium.transmit(0, 0.0, FRAME)
    (delivery,) = medium.deliveries_until(10.0)
    assert delivery.fate == "out-of-reach"
    assert not delivery.was_received


def test_the_same_seed_gives_the_same_sea() -> None:
    settings = WaterSettings(corruption=0.2, duplication=0.2)
    one, two, other = (run(water(settings, at(0.0, 500.0), seed), 200) for seed in (4, 4, 5))
    assert one == two
    assert one != other


def test_switching_one_effect_leaves_the_draws_of_the_others() -> None:
    plain = run(water(WaterSettings(), at(0.0, 500.0)), 500)
    busy_settings = WaterSettings(corruption=0.5, duplication=0.5, outlier_share=0.0)
    busy = run(water(busy_settings, at(0.0, 500.0)), 500)
    lost = [d.t_tx_s for d in plain if d.fate == "lost"]
    assert lost == [d.t_tx_s for d in busy if d.fate == "lost"]
    measured = {d.t_tx_s: d.t_rx_s for d in busy if d.fate in {"delivered", "corrupt"}}
    inliers = [d for d in plain if d.t_rx_s and 1500.0 * (d.t_rx_s - d.t_tx_s) < 520.0]
    assert inliers
    assert all(measured[d.t_tx_s] == d.t_rx_s for d in inliers)


def test_another_node_leaves_the_fates_of_the_first_two() -> None:
    two = run(water(WaterSettings(), at(0.0, 500.0)), 300)
    three = run(water(WaterSettings(), at(0.0, 500.0, 900.0)), 300)
    assert two == [d for d in three if d.destination == 1]
