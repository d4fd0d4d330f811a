"""The states of a vehicle that went silent."""

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
