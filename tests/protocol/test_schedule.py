"""Slots and the header's short times."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.errors import ConfigError
from protocol.schedule import Slots, SlotSettings, reach_m
from protocol.timestamps import (
    from_quarters,
    one_way_travel_time_s,
    to_quarters,
    to_tx_second,
    transmission_s,
)


def test_one_follower_has_every_fourth_second_and_the_leader_two_in_twenty() -> None:
    slots = Slots(SlotSettings())
    assert [slots.next_slot_s(1, t) for t in (0.0, 0.1, 3.9, 4.0)] == [0.0, 4.0, 4.0, 4.0]
    assert [slots.next_slot_s(0, t) for t in (0.0, 3.0, 3.1, 11.5)] == [3.0, 3.0, 11.0, 23.0]
    assert slots.frames_per_submap(40.0) == 10


def test_a_slot_that_just_began_is_still_now() -> None:
    slots = Slots(SlotSettings())
    assert slots.next_follower_slot_s(4.0 + 1e-9) == 4.0


def test_followers_take_turns_and_never_share_a_slot() -> None:
    slots = Slots(SlotSettings(followers=4))
    starts = [slots.next_follower_slot_s(100.0, follower) for follower in (1, 2, 3, 4)]
    assert sorted(starts) == [100.0, 104.0, 108.0, 112.0]
    assert slots.frames_per_submap(40.0) == 2


@given(st.floats(0, 1e6), st.integers(0, 4))
def test_the_next_slot_is_never_in_the_past(now_s: float, vehicle: int) -> None:
    slots = Slots(SlotSettings(followers=4))
    assert slots.next_slot_s(vehicle, now_s) >= now_s - 1e-6
    assert slots.next_slot_s(vehicle, now_s) % 1.0 == 0.0


def test_slots_that_cannot_be_are_refused() -> None:
    with pytest.raises(ConfigError, match="from 0 to 19"):
        SlotSettings(leader_offsets_s=(3, 25))
    with pytest.raises(ConfigError, match="follower 3 has no slot"):
        Slots(SlotSettings(followers=2)).next_slot_s(3, 0.0)


def test_a_full_frame_has_passed_within_its_slot_to_nearly_three_kilometres() -> None:
    assert reach_m(4.0, 256, 1000.0) == pytest.approx(2928.0)


@given(st.integers(0, 10**8), st.floats(-100_000.0, 100_000.0))
def test_quarter_seconds_are_found_again_near_a_known_time(quarters: int, offset_s: float) -> None:
    time_s = quarters / 4.0
    assert from_quarters(to_quarters(time_s), time_s + offset_s) == time_s


@given(st.integers(0, 10**6), st.floats(0.0, 15.4))
def test_one_way_travel_time_is_unambiguous_to_23_km(tx_s: int, travel_s: float) -> None:
    tx_second = to_tx_second(float(tx_s))
    assert transmission_s(tx_second, tx_s + travel_s) == tx_s
    assert one_way_travel_time_s(tx_second, tx_s + travel_s) == pytest.approx(travel_s, abs=1e-6)


def test_noise_at_short_range_gives_a_small_negative_time_not_sixteen_seconds() -> None:
    assert one_way_travel_time_s(4, 100.999) == pytest.approx(0.999)
    assert one_way_travel_time_s(4, 99.999) == pytest.approx(-0.001)
