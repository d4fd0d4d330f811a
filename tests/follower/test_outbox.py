"""Which sub-maps a follower queues, and which of its states go out when nothing else waits."""

import numpy as np
import pytest

from firmware.dead_reckoning import ReckonedState
from firmware.follower.outbox import Outbox
from protocol.codec import encode
from protocol.packets import SubmapPacket, TrajectoryPacket
from protocol.repeats import RepeatSettings
from tests.protocol.strategies import paper_packet


def outbox(*, small_frames: bool = False) -> Outbox:
    return Outbox(1, 3, RepeatSettings(), small_frames=small_frames)


def submap(number: int, count: int) -> list[SubmapPacket]:
    return [paper_packet(submap=number, fragment=k, count=count) for k in range(count)]


@pytest.mark.parametrize(
    ("waiting", "count", "queued"),
    [(4, 10, True), (5, 10, False), (4, 9, True), (5, 9, False), (0, 1, True), (1, 1, False)],
)
def test_a_sub_map_is_queued_unless_half_of_it_would_have_to_wait(
    waiting: int, count: int, *, queued: bool
) -> None:
    box = outbox()
    box.add(submap(0, 10))
    for slot in range(10 - waiting):
        assert box.next_packet(4.0 * slot, 10, []) is not None
    box.add(submap(1, count))
    status = box.status()
    assert (status["submaps_sent"], status.get("submaps_without_air", 0)) == (
        1 + queued,
        1 - queued,
    )
    assert status["fragments_waiting"] == waiting + queued * count


@pytest.mark.parametrize(("small_frames", "count", "size"), [(False, 20, 256), (True, 4, 62)])
def test_the_newest_states_go_out_when_nothing_else_waits(
    count: int, size: int, *, small_frames: bool
) -> None:
    box = outbox(small_frames=small_frames)
    states = [
        ReckonedState(time_s=k / 4.0, north_m=k / 2.0, east_m=-k, yaw_rad=0.0, depth_m=10.0)
        for k in range(4 * 60 + 1)
    ]
    assert box.next_packet(60.0, 10, []) is None
    packets = [box.next_packet(60.0 + 4.0 * k, 10, states) for k in range(2)]
    for packet in packets:
        assert isinstance(packet, TrajectoryPacket)
        assert len(encode(packet)) == size
        header = packet.header
        assert (header.vehicle, header.boot_epoch) == (1, 3)
        assert (header.fragment, header.fragment_count) == (0, 1)
        first_s = header.time_quarters / 4.0
        assert 60.5 - count < first_s <= 61.0 - count
        norths_m = 2.0 * (first_s + np.arange(count))
        assert packet.states[:, 0] == pytest.approx(norths_m)
        assert packet.states[:, 1] == pytest.approx(-2.0 * norths_m)
    numbers = [packet.header.submap for packet in packets if packet is not None]
    assert numbers[1] == numbers[0] + 1


def test_trajectories_are_counted_anew_after_the_last_number_that_a_header_holds() -> None:
    box = outbox()
    box._trajectory_packets = (1 << 16) - 1
    state = ReckonedState(time_s=60.0, north_m=0.0, east_m=0.0, yaw_rad=0.0, depth_m=10.0)
    packet = box.next_packet(60.0, 10, [state])
    assert packet is not None
    assert packet.header.submap == 0
