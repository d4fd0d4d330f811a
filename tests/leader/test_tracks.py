"""The states of a vehicle that went silent, was heard late, or set its clock back."""

import numpy as np

from firmware.leader.tracks import TrackBuffer


def test_state_after_a_long_silence_is_held_against_the_last_one() -> None:
    buffer = TrackBuffer()
    for second in range(100):
        buffer.add(float(second), 2.0 * second, 0.0, 0.0)
    buffer.settle(3600.0)
    assert len(buffer) == 100
    assert buffer.is_plausible(4000.0, 2.0 * 4000.0, 0.0, fastest_mps=3.0)
    assert not buffer.is_plausible(4000.0, 6.0 * 4000.0, 0.0, fastest_mps=3.0)
    buffer.add(4000.0, 8000.0, 0.0, 0.0)
    buffer.settle(5000.0)
    assert buffer.is_plausible(5001.0, 8100.0, 0.0, fastest_mps=3.0)


def northward(seconds: int) -> TrackBuffer:
    """Return the states of a way north at 2 m/s."""
    buffer = TrackBuffer()
    for second in range(seconds):
        buffer.add(float(second), 2.0 * second, 0.0, 0.0)
    return buffer


def test_states_take_their_place_whenever_they_arrive_and_the_first_of_two_stays() -> None:
    buffer = northward(10)
    assert buffer.track().time_s.size == 10
    buffer.add(11.0, 22.0, 0.0, 0.0)
    buffer.add(3.5, 7.0, 0.0, 0.0)
    buffer.add(4.1, 900.0, 0.0, 0.0)
    assert len(buffer) == 12
    track = buffer.track()
    assert track.time_s.tolist() == sorted([*map(float, range(10)), 3.5, 11.0])
    np.testing.assert_array_equal(track.north_m, 2.0 * track.time_s)


def test_arrays_lie_whole_in_memory_however_states_arrive() -> None:
    buffer = northward(1)
    for late_s, time_s in ((4.0, 5.0), (6.0, 7.0), (8.0, 9.0)):
        assert buffer.track().time_s.flags.c_contiguous
        buffer.add(time_s, 0.0, 0.0, 0.0)
        assert buffer.track().time_s.flags.c_contiguous
        buffer.add(late_s, 0.0, 0.0, 0.0)
        assert buffer.track().time_s.flags.c_contiguous
    buffer.forget_from(7.0)
    assert buffer.track().time_s.flags.c_contiguous


def test_a_state_is_held_against_those_before_and_after_it() -> None:
    buffer = northward(100)
    buffer.add(108.0, 216.0, 0.0, 0.0)
    for north_m, is_plausible in ((203.0, True), (214.0, True), (199.0, False), (218.0, False)):
        assert buffer.is_plausible(104.0, north_m, 0.0, fastest_mps=3.0) is is_plausible
    assert not buffer.is_plausible(-5.0, 60.0, 0.0, fastest_mps=3.0)
    assert not buffer.is_plausible(104.0, 210.0, 20.0, fastest_mps=3.0)


def test_what_a_clock_showed_that_was_ahead_is_forgotten() -> None:
    buffer = northward(100)
    buffer.forget_from(50.0)
    assert buffer.track().time_s.tolist() == list(range(50))
    assert buffer.is_plausible(70.0, 40.0, 0.0, fastest_mps=3.0)  # 58 m back in 21 s
    buffer.add(70.0, 40.0, 0.0, 0.0)
    assert buffer.track().north_m[-1] == 40.0


def test_settled_states_stay_in_the_track_and_cost_no_more() -> None:
    buffer = northward(100)
    buffer.settle(90.0)
    assert sorted(buffer._states) == [4 * second for second in range(90, 100)]
    assert buffer.track().time_s.size == 100
