"""Slots and the header's short times."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.acoustics import Water, WaterSettings
from protocol.errors import ConfigError
from protocol.schedule import Air, Slots, SlotSettings, Turns, planned_slots
from protocol.timestamps import (
    from_quarters,
    one_way_travel_time_s,
    to_quarters,
    to_tx_second,
    transmission_s,
)


def conflict_free_reach_m(settings: SlotSettings, air: Air) -> float:
    """Return the distance up to which these slots cannot collide, whatever the geometry.

    Within it a follower's frame has passed the leader before the leader answers and before the next
    follower's frame, and the answer has passed all followers before any of them transmits.
    """
    slot_s = settings.follower_slot_s
    starts_s = (
        offset_s + turn * settings.leader_period_s
        for offset_s in settings.leader_offsets_s
        for turn in range(slot_s)  # after slot_s periods the two rasters repeat
    )
    phases_s = {start_s % slot_s for start_s in starts_s}
    guard_s = min(min(phases_s) - air.frame_s, slot_s - max(phases_s) - air.answer_s)
    return max(0.0, guard_s) * air.sound_speed_mps


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
    assert starts == [112.0, 100.0, 104.0, 108.0]  # the first one's begin every 16 s
    assert slots.frames_per_submap(40.0) == 2
    assert Slots(SlotSettings(followers=4, frames_per_slot=2)).frames_per_submap(40.0) == 4


@given(st.floats(0, 1e6), st.integers(0, 4))
def test_the_next_slot_is_never_in_the_past(now_s: float, vehicle: int) -> None:
    slots = Slots(SlotSettings(followers=4))
    assert slots.next_slot_s(vehicle, now_s) >= now_s - 1e-6
    assert slots.next_slot_s(vehicle, now_s) % 1.0 == 0.0


@pytest.mark.parametrize("vehicle", [0, 3])
def test_a_slot_minutes_ahead_has_yet_to_come_unless_the_clock_was_set_back(vehicle: int) -> None:
    slots = Slots(SlotSettings(followers=14, follower_slot_s=10, leader_period_s=140))
    turns = Turns(slots, vehicle, 1000.0)
    next_s = slots.next_slot_s(vehicle, 1000.0)
    after_s = slots.next_slot_s(vehicle, next_s + 1e-3)
    assert [turns.due_s(now_s) for now_s in (next_s, next_s + 1.0, after_s)] == [
        next_s,
        None,
        after_s,
    ]
    assert turns.missed == 0
    set_back_s = slots.next_slot_s(vehicle, 500.0)
    assert turns.due_s(set_back_s) == set_back_s


def test_a_slot_is_missed_a_little_late_and_holds_as_many_frames_as_it_may() -> None:
    turns = Turns(Slots(SlotSettings(frames_per_slot=2)), 1, 0.0)
    assert [turns.due_s(0.0) for _ in range(3)] == [0.0, 0.0, None]
    assert (turns.due_s(4.5), turns.missed) == (None, 1)
    assert turns.due_s(8.0) == 8.0
    turns.skip(8.0)
    assert turns.due_s(8.0) is None
    assert [turns.due_s(12.0) for _ in range(3)] == [12.0, 12.0, None]
    assert [turns.due_s(16.0) for _ in range(3)] == [16.0, 16.0, None]


def test_the_leader_has_one_frame_a_slot_and_misses_none_between_them() -> None:
    turns = Turns(Slots(SlotSettings(frames_per_slot=2)), 0, 0.0)
    due_s = [turns.due_s(now_s) for now_s in (3.0, 3.0, 4.0, 11.0, 11.0, 12.0)]
    assert due_s == [3.0, None, None, 11.0, None, None]
    assert turns.missed == 0


def test_a_clock_set_back_by_more_than_slots_lie_apart_costs_no_slot() -> None:
    turns = Turns(Slots(SlotSettings()), 1, 1000.0)
    assert [turns.due_s(now_s) for now_s in (1000.0, 988.0)] == [1000.0, 988.0]


def test_slots_that_cannot_be_are_refused() -> None:
    with pytest.raises(ConfigError, match="from 0 to 19"):
        SlotSettings(leader_offsets_s=(3, 25))
    with pytest.raises(ConfigError, match="from 0 to 19"):
        SlotSettings(leader_offsets_s=(-1, 11))
    for follower in (0, 3):
        with pytest.raises(ConfigError, match=f"follower {follower} has no slot"):
            Slots(SlotSettings(followers=2)).next_follower_slot_s(0.0, follower)


def test_the_papers_slots_are_free_of_conflict_to_twelve_hundred_metres() -> None:
    assert conflict_free_reach_m(SlotSettings(), Air()) == pytest.approx(1236.0)
    assert planned_slots(1, 1200.0, Air()) == SlotSettings()


def test_where_slots_are_long_the_reach_ends_where_a_frame_meets_the_answer() -> None:
    slots = SlotSettings(follower_slot_s=8, leader_period_s=24, leader_offsets_s=(3,))
    assert conflict_free_reach_m(slots, Air()) == pytest.approx((3.0 - 2.048) * 1500.0)


@given(st.integers(1, 8), st.floats(100.0, 10_000.0), st.sampled_from([22, 42, 54]))
def test_planned_slots_reach_as_far_as_asked(
    followers: int, reach_m: float, answer_bytes: int
) -> None:
    air = Air(answer_bytes=answer_bytes)
    slots = planned_slots(followers, reach_m, air)
    assert conflict_free_reach_m(slots, air) >= reach_m - 1e-6


@pytest.mark.parametrize(("share_of_reach", "is_clear"), [(0.999, True), (1.2, False)])
def test_four_followers_on_the_water_keep_clear_within_the_reach_and_not_beyond(
    share_of_reach: float, is_clear: bool
) -> None:
    settings, air = SlotSettings(followers=4), Air()
    radius_m = share_of_reach * conflict_free_reach_m(settings, air)
    places = [(0.0, 0.0, 0.0), (radius_m, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, radius_m, 0.0)]
    places.append((0.0, -1.0, 0.0))
    quiet = WaterSettings(loss=0.0, outlier_share=0.0, range_noise_m=0.0)
    water = Water(quiet, np.random.default_rng(1), lambda node, _: places[node], range(5))
    slots = Slots(settings)
    for second in range(400):
        for vehicle in range(5):
            if slots.next_slot_s(vehicle, float(second)) == second:
                size = air.frame_bytes if vehicle else air.answer_bytes
                water.transmit(vehicle, float(second), bytes(size))
    to_leader_or_from_it = [
        delivery.fate == "delivered"
        for delivery in water.deliveries_until(np.inf)
        if 0 in {delivery.source, delivery.destination}
    ]
    assert len(to_leader_or_from_it) == 100 + 4 * 40
    assert all(to_leader_or_from_it) == is_clear


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
