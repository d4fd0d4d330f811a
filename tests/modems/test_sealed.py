"""A modem behind a seal: the cores on both sides see plain frames, and only the peer's."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from host_tools.emulators.rig import Rig
from protocol.acoustics import Water, WaterSettings
from protocol.codec import decode, encode
from protocol.errors import LocalProtocolError
from protocol.modems.base import LinkNotice, Modem, Reception
from protocol.modems.events import FrameDropped
from protocol.modems.loopback import LoopbackMedium
from protocol.modems.micromodem_settings import MicroModemSettings
from protocol.modems.sealed import SealedLink, SealedModem
from protocol.packets import (
    Header,
    Profile,
    SealedFrame,
    SubmapFragment,
    SubmapPacket,
    TrajectoryPacket,
)
from protocol.seal import Keys, Opener, Sealer
from protocol.timestamps import to_tx_second
from tests.modems.rigs import micro_rig, nano_rig
from tests.modems.test_scars import answer, frames_of
from tests.protocol.strategies import paper_packet

cycles_rig = partial(micro_rig, settings=MicroModemSettings(flexible=False))
KEYS = Keys(bytes(range(32)))


class Count:
    def __init__(self, last: int = 1 << 30) -> None:
        self.number, self.last = 0, last

    def next(self) -> int:
        if self.number == self.last:
            raise LocalProtocolError("the disk is full")
        self.number += 1
        return self.number


def link(vehicle: int, count: Count | None = None) -> SealedLink:
    return SealedLink(Sealer(KEYS, count or Count()), Opener(vehicle, KEYS))


def medium() -> LoopbackMedium:
    calm = WaterSettings(loss=0.0, outlier_share=0.0)
    return LoopbackMedium(
        Water(calm, np.random.default_rng(1), lambda node, _: (300.0 * node, 0.0, 0.0))
    )


def heard(modem: Modem, now_s: float) -> list[bytes]:
    modem.poll(now_s)
    events = iter(modem.next_event, None)
    return [event.frame for event in events if isinstance(event, Reception)]


def trajectory() -> TrajectoryPacket:
    header = Header(
        profile=Profile.TRAJECTORY,
        vehicle=1,
        boot_epoch=0,
        submap=3,
        fragment=0,
        fragment_count=1,
        tx_second=2,
        time_quarters=(1 << 20) - 2,
    )
    return TrajectoryPacket(header=header, states=np.arange(60, dtype=np.float32).reshape(20, 3))


def test_a_fragment_crosses_with_fourteen_points_and_a_gap() -> None:
    water = medium()
    follower, leader = (SealedModem(water.modem(v), link(v)) for v in (1, 0))
    packet = replace(paper_packet(), header=replace(paper_packet().header, vehicle=1))
    follower.send(encode(packet), 0.0)
    (frame,) = heard(leader, 10.0)
    arrived = decode(frame)
    assert isinstance(arrived, SubmapPacket)
    np.testing.assert_array_equal(arrived.points_ned_m[:14], packet.points_ned_m[:14])
    assert np.isnan(arrived.points_ned_m[14]).all()
    assert arrived.header == packet.header
    assert leader.status().errors == {"opened": 1, "marks_unwritten": 0}


def test_a_trajectory_crosses_without_its_oldest_state() -> None:
    frame = link(1).seal(encode(trajectory()))
    assert frame is not None
    opened = link(0).open(frame)
    assert opened is not None
    packet = decode(opened)
    assert isinstance(packet, TrajectoryPacket)
    np.testing.assert_array_equal(packet.states[:19], trajectory().states[1:])
    assert np.isnan(packet.states[19]).all()
    assert packet.header.time_quarters == 2  # one second later, across the turn of the field


@pytest.mark.parametrize(
    ("profile", "body_bytes"),
    [
        (Profile.SUBMAP_DENSE, 244),
        (Profile.SUBMAP_LATTICE, 244),
        (Profile.SUBMAP_LATTICE_SMALL, 50),
    ],
)
def test_a_coded_body_crosses_without_its_unused_end(profile: Profile, body_bytes: int) -> None:
    body = b"\xa5" * (body_bytes - 12) + bytes(12)
    packet = SubmapFragment(header=replace(trajectory().header, profile=profile), body=body)
    frame = link(1).seal(encode(packet))
    assert frame is not None
    assert len(frame) == len(encode(packet))
    sealed = decode(frame)
    assert isinstance(sealed, SealedFrame)
    assert len(sealed.body) == body_bytes - 12
    opened = link(0).open(frame)
    assert opened == encode(packet)


def test_plain_frames_are_not_let_through_and_counted() -> None:
    water = medium()
    leader = SealedModem(water.modem(0), link(0))
    water.modem(1).send(encode(trajectory()), 0.0)
    water.modem(1).send(b"noise", 4.0)
    assert heard(leader, 10.0) == []
    rejected = {"rejected_plain": 1, "rejected_size": 1}
    assert leader.status().errors == {**rejected, "marks_unwritten": 0}


def test_a_frame_that_cannot_be_sealed_stays_here() -> None:
    water = medium()
    follower = SealedModem(water.modem(1), link(1, Count(last=1)))
    for now_s in (0.0, 4.0):
        follower.send(encode(trajectory()), now_s)
    header = replace(trajectory().header, profile=Profile.SUBMAP_DENSE)
    follower.send(encode(SubmapFragment(header=header, body=b"\xff" * 244)), 8.0)
    assert follower.status().sent == 1
    assert follower.status().errors == {"not_sealed": 2, "marks_unwritten": 0}


def test_a_driver_that_stamps_seals_with_the_second_of_its_start() -> None:
    rig = micro_rig()
    leader, follower = link(0), link(1)
    rig.cores[1]._stamp = leader.stamp  # type: ignore[attr-defined]
    to_follower = decode(answer())
    plain = encode(replace(to_follower, header=replace(to_follower.header, fragment=1)))
    rig.cores[1].send(plain, rig.now_s, start_s := float(round(rig.now_s) + 5))
    rig.run_until(start_s + 8.0)
    (frame,) = frames_of(rig, 2)
    assert isinstance(decode(frame), SealedFrame)
    opened = follower.open(frame)
    assert opened is not None
    assert decode(opened).header.tx_second == to_tx_second(start_s)


def test_a_seal_without_counter_gives_the_driver_nothing_to_send() -> None:
    assert link(1, Count(last=0)).stamp(encode(trajectory()), 5.0) is None


@pytest.mark.parametrize("vehicle", [0, 1])
def test_the_seal_keeps_to_the_modem_under_it(vehicle: int) -> None:
    inner = medium().modem(vehicle)
    modem = SealedModem(inner, link(vehicle))
    assert (modem.largest_frame_bytes, modem.lead_s) == (inner.largest_frame_bytes, inner.lead_s)
    assert modem.frames_per_packet == inner.frames_per_packet
    modem.close()


def test_a_driver_with_a_lead_is_given_plain_frames_and_its_notices_pass() -> None:
    inner = medium().modem(1)
    inner.lead_s = 1.7
    follower = SealedModem(inner, link(1))
    handed: list[bytes] = []

    def send(frame: bytes, now_s: float, start_s: float | None = None) -> None:
        assert (now_s, start_s) == (2.3, 4.0)
        handed.append(frame)

    inner.send = send  # type: ignore[method-assign]
    follower.send(encode(trajectory()), 2.3, 4.0)
    assert handed == [encode(trajectory())]
    notice = LinkNotice(text="the port is back", at_s=1.0)
    events = iter([notice, None])
    inner.next_event = lambda: next(events)  # type: ignore[method-assign]
    assert follower.next_event() is notice


@pytest.mark.parametrize("make_rig", [micro_rig, cycles_rig, nano_rig])
def test_a_frame_without_a_counter_never_reaches_the_modem(make_rig: Callable[[], Rig]) -> None:
    rig = make_rig()
    rig.cores[1]._stamp = link(1, Count(last=0)).stamp  # type: ignore[attr-defined]
    rig.cores[1].send(answer(), rig.now_s)
    rig.run_until(rig.now_s + 8.0)
    status = rig.cores[1].status()
    assert (status["dropped"], status["confirmed"], status["failures"]) == (1, 0, 0)
    assert rig.taken(1, FrameDropped) == [
        FrameDropped(frame=answer(), reason="it cannot be sealed")
    ]
    assert not sum(rig.bench.fates.values())
    rig.cores[1]._stamp = link(1).stamp  # type: ignore[attr-defined]
    rig.cores[1].send(answer(), rig.now_s)
    rig.run_until(rig.now_s + 8.0)
    assert len(frames_of(rig, 2)) == 1
