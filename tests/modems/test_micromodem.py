"""The Micro-Modem core against emulated modems, in virtual time."""

from dataclasses import replace

import numpy as np
import pytest

from host_tools.emulators.micromodem import MicroModemUnit
from host_tools.emulators.micromodem_firmware import MM1, MicroModemQuirks
from host_tools.emulators.rig import Rig
from protocol.codec import decode, encode
from protocol.errors import LocalProtocolError
from protocol.modems.events import (
    FrameAcknowledged,
    FrameHeard,
    FrameSent,
    LinkQuality,
    MiniHeard,
    PeerSilent,
    RangeMeasured,
)
from protocol.modems.micromodem import MicroModem
from protocol.modems.micromodem_clock import parse_utc
from protocol.modems.micromodem_settings import MicroModemSettings
from protocol.modems.micromodem_states import TABLE, WAITS, State
from protocol.packets import Answer, Header, Profile
from protocol.timestamps import one_way_travel_time_s
from tests.modems.rigs import CALM, micro_rig

MM1_QUIRKS = MicroModemQuirks(firmware=MM1)


def frames_of(rig: Rig, node: int) -> list[bytes]:
    return [e.frame for e in rig.taken(node, FrameHeard) if isinstance(e, FrameHeard)]


def core_of(rig: Rig, node: int) -> MicroModem:
    core = rig.cores[node]
    assert isinstance(core, MicroModem)
    return core


def unit_of(rig: Rig, node: int) -> MicroModemUnit:
    unit = rig.bench.units[node]
    assert isinstance(unit, MicroModemUnit)
    return unit


def answer(submap: int = 3) -> bytes:
    header = Header(
        profile=Profile.ANSWER,
        vehicle=0,
        boot_epoch=1,
        submap=submap,
        fragment=0,
        fragment_count=1,
        tx_second=0,
        time_quarters=44,
    )
    return encode(Answer(header=header, submap=submap, north_m=1.0, east_m=2.0))


def test_every_action_of_the_table_exists_and_every_wait_has_a_way_out() -> None:
    for action, _ in TABLE.values():
        assert callable(getattr(MicroModem, action))
    for state, wait in WAITS.items():
        assert (state, wait.then) in TABLE


@pytest.mark.parametrize("quirks", [None, MM1_QUIRKS])
def test_the_modem_is_configured_and_its_clock_set(quirks: MicroModemQuirks | None) -> None:
    rig = micro_rig(quirks=quirks)
    for node in (1, 2):
        settings = unit_of(rig, node).settings
        keys = ("SRC", "CST", "RXP", "XST", "REV", "SNV")
        assert [settings[key] for key in keys] == [str(node), "1", "1", "1", "1", "1"]
        assert core_of(rig, node).clock.is_set
        assert core_of(rig, node).state is State.IDLE


@pytest.mark.parametrize(
    ("rate", "size", "frames"),
    [(0, 32, 1), (1, 64, 3), (2, 62, 3), (3, 256, 2), (4, 256, 2), (5, 256, 8)],
)
def test_every_rate_carries_its_frames_in_one_packet(rate: int, size: int, frames: int) -> None:
    settings = MicroModemSettings(rate=rate, flexible=False)
    rig = micro_rig(settings=settings)
    sent = [bytes([n]) * size for n in range(frames)]
    for frame in sent:
        rig.cores[1].send(frame, rig.now_s)
    rig.run_until(rig.now_s + 20.0)
    assert frames_of(rig, 2) == sent
    assert rig.bench.fates == {"delivered": 1}
    assert [e.frame for e in rig.taken(1, FrameSent) if isinstance(e, FrameSent)] == sent
    assert core_of(rig, 1).counters["late"] == 0


def test_frames_larger_than_the_rate_carries_are_refused_with_advice() -> None:
    core = MicroModem(MicroModemSettings(rate=2))
    with pytest.raises(LocalProtocolError, match="take rate 3, 4 or 5"):
        core.send(bytes(256), 0.0)


def test_the_lead_of_a_full_packet_is_the_same_whatever_waits() -> None:
    rig = micro_rig()
    lead_s = rig.cores[1].lead_s
    rig.cores[1].send(answer(), rig.now_s)
    assert rig.cores[1].lead_s == lead_s


def test_small_frames_go_as_flexible_packets_where_the_firmware_has_them() -> None:
    rig = micro_rig()
    rig.cores[1].send(answer(), rig.now_s)
    rig.run_until(rig.now_s + 4.0)
    (heard,) = frames_of(rig, 2)
    assert decode(heard).header.submap == 3
    assert unit_of(rig, 1)._uid == 1


def test_a_line_damaged_while_the_clock_is_set_does_not_end_its_checking() -> None:
    """The older line is tried then; the newer one, whose clock can be asked, after a restart."""
    rig = micro_rig()
    unit, core = rig.bench.units[1], core_of(rig, 1)
    receive = unit.receive_data

    def damage(data: bytes, now_s: float) -> None:
        receive(data.replace(b"$CCTMS,2", b"$CCTMS,3"), now_s)

    unit.receive_data = damage  # type: ignore[method-assign]
    unit.power_cycle(rig.now_s)
    rig.run_until(rig.now_s + 20.0)
    assert (core.clock.is_set, core.clock.speaks_new) == (True, False)
    unit.receive_data = receive  # type: ignore[method-assign]
    unit.power_cycle(rig.now_s)
    rig.run_until(rig.now_s + 20.0)
    assert (core.clock.is_set, core.clock.speaks_new) == (True, True)


@pytest.mark.parametrize(("quirks", "answer"), [(MM1_QUIRKS, b"$CACLK"), (None, b"$CATMQ")])
def test_a_line_about_the_clock_that_is_said_again_is_about_its_new_second(
    quirks: MicroModemQuirks | None, answer: bytes
) -> None:
    """The first answer is lost, and the modem has its line twice."""
    rig = micro_rig(quirks=quirks)
    unit, core = unit_of(rig, 1), core_of(rig, 1)
    receive, lost = core.receive_data, 0

    def lose(data: bytes, now_s: float) -> None:
        nonlocal lost
        if not lost and answer in data:
            lost, data = 1, b""
        receive(data, now_s)

    core.receive_data = lose  # type: ignore[method-assign]
    unit.power_cycle(rig.now_s)
    rig.run_until(rig.now_s + 20.0)
    assert (lost, core.clock.is_set, core.clock.counters["clock_wrong"]) == (1, True, 0)
    assert unit.clock.read(0.0) == parse_utc(core.settings.utc_at_zero)


def test_old_firmware_gets_a_data_cycle_instead() -> None:
    rig = micro_rig(quirks=MM1_QUIRKS)
    rig.cores[1].send(answer(), rig.now_s)
    rig.run_until(rig.now_s + 8.0)
    assert len(frames_of(rig, 2)) == 1
    assert unit_of(rig, 1)._uid == 0


def test_firmware_that_needs_even_sizes_gets_odd_frames_by_data_cycle() -> None:
    rig = micro_rig(quirks=MicroModemQuirks(firmware="2.0.27087"))
    rig.cores[1].send(bytes(23), rig.now_s)
    rig.run_until(rig.now_s + 8.0)
    assert frames_of(rig, 2) == [bytes(23)]
    assert core_of(rig, 1).counters["failures"] == 0


@pytest.mark.parametrize("range_m", [2.0, 600.0, 1499.0, 1501.0, 4500.0, 9990.0])
@pytest.mark.parametrize("quirks", [None, MM1_QUIRKS, MicroModemQuirks(statistics_version=6)])
def test_one_way_travel_time_is_right_to_a_millisecond_and_10_km(
    range_m: float, quirks: MicroModemQuirks | None
) -> None:
    rig = micro_rig(range_m=range_m, quirks=quirks)
    rng = np.random.default_rng(5)
    for _ in range(4):
        rig.run_until(rig.now_s + 9.0 + float(rng.uniform(0.0, 3.0)))
        rig.cores[1].send(answer(), rig.now_s)
    rig.run_until(rig.now_s + 20.0)
    heard = [e for e in rig.taken(2, FrameHeard) if isinstance(e, FrameHeard)]
    assert len(heard) == 4
    for event in heard:
        assert event.toa_s is not None
        owtt_s = one_way_travel_time_s(decode(event.frame).header.tx_second, event.toa_s)
        assert owtt_s == pytest.approx(range_m / 1500.0, abs=1e-3)


def test_without_a_pulse_no_arrival_time_is_vouched_for_and_the_sender_says_why() -> None:
    rig = micro_rig()
    unit_of(rig, 2).clock.pulse_present = False
    rig.cores[1].send(answer(), rig.now_s)
    rig.run_until(rig.now_s + 5.0)
    (heard,) = rig.taken(2, FrameHeard)
    assert isinstance(heard, FrameHeard)
    assert heard.toa_s is None
    rig.cores[2].send(answer(), rig.now_s)
    rig.run_until(rig.now_s + 8.0)
    assert any("transmit mode 2" in str(event) for event in rig.events[2])
    assert len(core_of(rig, 2).outbox) == 1
    unit_of(rig, 2).clock.pulse_present = True
    rig.run_until(rig.now_s + 30.0)
    assert len(frames_of(rig, 1)) == 1


def test_ping_measures_the_range_and_a_silent_peer_is_reported() -> None:
    rig = micro_rig(range_m=3000.0)
    rig.cores[1].ping(2)
    rig.run_until(rig.now_s + 12.0)
    (measured,) = rig.taken(1, RangeMeasured)
    assert isinstance(measured, RangeMeasured)
    assert measured.owtt_s == pytest.approx(2.0, abs=1e-4)
    rig.cores[1].ping(9)
    rig.run_until(rig.now_s + 30.0)
    assert [e.peer for e in rig.taken(1, PeerSilent) if isinstance(e, PeerSilent)] == [9]


def test_a_ping_reply_without_its_time_counts_as_silence() -> None:
    rig = micro_rig(quirks=MicroModemQuirks(omits_range=True))
    rig.cores[1].ping(2)
    rig.run_until(rig.now_s + 12.0)
    assert len(rig.taken(1, PeerSilent)) == 1


def test_mini_packets_carry_13_bits() -> None:
    rig = micro_rig()
    core_of(rig, 1).mini(2, 0x1ABC)
    rig.run_until(rig.now_s + 5.0)
    assert rig.taken(2, MiniHeard) == [MiniHeard(source=1, value=0x1ABC)]
    with pytest.raises(LocalProtocolError):
        core_of(rig, 1).mini(2, 0x2000)


def test_acknowledged_frames_return_exactly_what_was_sent() -> None:
    settings = MicroModemSettings(destination=2, acknowledge=True, flexible=False)
    rig = micro_rig(settings=settings)
    for n in range(2):
        rig.cores[1].send(bytes([n]) * 256, rig.now_s)
    rig.run_until(rig.now_s + 12.0)
    acknowledged = [e for e in rig.taken(1, FrameAcknowledged) if isinstance(e, FrameAcknowledged)]
    assert [e.frame for e in acknowledged] == frames_of(rig, 2)
    assert {e.peer for e in acknowledged} == {2}


def test_lost_packets_take_both_their_frames() -> None:
    settings = MicroModemSettings(flexible=False)
    rig = micro_rig(water=replace(CALM, loss=0.5), settings=settings, seed=3)
    for n in range(40):
        rig.cores[1].send(bytes([n]) * 256, rig.now_s)
    rig.run_until(rig.now_s + 120.0)
    pairs = [frame[0] // 2 for frame in frames_of(rig, 2)]
    assert 4 < len(pairs) // 2 < 16
    assert all(pairs.count(pair) == 2 for pair in pairs)


def test_a_damaged_frame_is_dropped_and_its_neighbour_kept() -> None:
    water = replace(CALM, corruption=1.0, corrupt_bits=1.0)
    rig = micro_rig(water=water, settings=MicroModemSettings(flexible=False))
    for n in range(2):
        rig.cores[1].send(bytes([n]) * 256, rig.now_s)
    rig.run_until(rig.now_s + 10.0)
    assert len(frames_of(rig, 2)) == 1
    assert core_of(rig, 2).packet.counters["bad_frames"] == 1
    (quality,) = rig.taken(2, LinkQuality)
    assert isinstance(quality, LinkQuality)
    assert (quality.frames, quality.good_frames) == (2, 1)


@pytest.mark.parametrize("after_s", [0.3, 0.6, 1.0, 2.5, 4.0])
@pytest.mark.parametrize("silent", [False, True])
def test_power_cycle_at_any_moment_of_a_packet_loses_nothing_queued(
    after_s: float, silent: bool
) -> None:
    quirks = MicroModemQuirks(forgets_settings=True, silent_boot=silent)
    rig = micro_rig(quirks=quirks, settings=MicroModemSettings(flexible=False))
    for n in range(6):
        rig.cores[1].send(bytes([n]) * 256, rig.now_s)
    rig.run_until(rig.now_s + after_s)
    rig.bench.units[1].power_cycle(rig.now_s)
    rig.run_until(rig.now_s + 120.0)
    assert {frame[0] for frame in frames_of(rig, 2)} == set(range(6))
    assert len(core_of(rig, 1).outbox) == 0
    assert core_of(rig, 1).clock.is_set


def test_pulled_and_replaced_cable_loses_nothing_queued() -> None:
    rig = micro_rig(settings=MicroModemSettings(flexible=False))
    for n in range(6):
        rig.cores[1].send(bytes([n]) * 256, rig.now_s)
    rig.run_until(rig.now_s + 1.2)
    rig.unplug(1)
    rig.run_until(rig.now_s + 30.0)
    rig.plug(1)
    rig.run_until(rig.now_s + 60.0)
    assert {frame[0] for frame in frames_of(rig, 2)} == set(range(6))


def test_a_host_too_late_for_the_data_request_tries_again() -> None:
    rig = micro_rig(settings=MicroModemSettings(flexible=False))
    rig.cores[1].send(bytes(256), rig.now_s)
    rig.run_until(rig.now_s + 0.5)
    core_of(rig, 1).counters["late"] = 0
    stalled_s = 3.0  # the loop stands still over the data request
    rig.bench.advance(rig.now_s + stalled_s)
    rig.now_s += stalled_s
    rig.run_until(rig.now_s + 20.0)
    assert frames_of(rig, 2) == [bytes(256)]


def test_a_packet_whose_beginning_is_unread_goes_out_once() -> None:
    rig = micro_rig(settings=MicroModemSettings(flexible=False))
    core = core_of(rig, 1)
    receive = core.receive_data
    core.receive_data = lambda data, now_s: receive(  # type: ignore[method-assign]
        data.replace(b"$CATXP", b"$CAT\xd8P"), now_s
    )
    core.send(bytes(200), rig.now_s, 20.0)
    rig.run_until(60.0)
    assert [e.start_s for e in rig.taken(1, FrameSent) if isinstance(e, FrameSent)] == [20.0]
    assert frames_of(rig, 2) == [bytes(200)]


def test_a_full_queue_drops_the_oldest_and_says_so() -> None:
    core = MicroModem(MicroModemSettings(queue_frames=4))
    for n in range(7):
        core.send(bytes([n]), 0.0)
    assert core.status()["dropped"] == 3
    assert "full" in str(core.next_event())


@pytest.mark.slow
def test_a_modem_power_cycled_a_hundred_times_loses_nothing_queued() -> None:
    quirks = MicroModemQuirks(forgets_settings=True)
    rig = micro_rig(quirks=quirks, settings=MicroModemSettings(flexible=False))
    rng = np.random.default_rng(11)
    number = 0
    for turn in range(100):
        for _ in range(3):
            rig.cores[1].send(number.to_bytes(2, "big") * 128, rig.now_s)
            number += 1
        rig.run_until(rig.now_s + float(rng.uniform(0.1, 6.0)))
        if turn % 2:
            rig.bench.units[1].power_cycle(rig.now_s)
        else:
            rig.unplug(1)
            rig.run_until(rig.now_s + float(rng.uniform(0.1, 3.0)))
            rig.plug(1)
        rig.run_until(rig.now_s + 30.0)
    rig.run_until(rig.now_s + 120.0)
    heard = {int.from_bytes(frame[:2], "big") for frame in frames_of(rig, 2)}
    assert heard == set(range(number))


@pytest.mark.parametrize("range_m", [50.0, 1200.0, 2500.0])
def test_pairs_in_8_s_slots_and_answers_between_them_share_the_air(range_m: float) -> None:
    rig = micro_rig(range_m=range_m)
    rig.run_until(36.0)
    follower, leader = core_of(rig, 1), core_of(rig, 2)
    for slot in range(5):
        slot_s = 40.0 + 8.0 * slot
        rig.run_until(slot_s - follower.lead_s)
        for k in range(follower.frames_per_packet):
            follower.send(bytes([2 * slot + k]) * 256, rig.now_s, start_s=slot_s)
        rig.run_until(slot_s + 5.0 - leader.lead_s)
        leader.send(answer(slot), rig.now_s, start_s=slot_s + 5.0)
    rig.run_until(90.0)
    assert len(frames_of(rig, 2)) == 10
    heard = [e for e in rig.taken(1, FrameHeard) if isinstance(e, FrameHeard)]
    assert [decode(e.frame).header.submap for e in heard] == list(range(5))
    assert rig.bench.fates == {"delivered": 10}
    starts_s = [e.start_s for e in rig.taken(1, FrameSent) if isinstance(e, FrameSent)]
    assert starts_s == [40.0 + 8.0 * (n // 2) for n in range(10)]


@pytest.mark.parametrize("rate", [2, 4, 5])
@pytest.mark.parametrize("period_s", [0.0, 0.02, 0.1, 0.25])
def test_frames_start_on_their_slots_second_however_seldom_the_loop_polls(
    period_s: float, rate: int
) -> None:
    rig = micro_rig(settings=MicroModemSettings(rate=rate, flexible=False))
    rig.period_s = period_s
    follower = core_of(rig, 1)
    per_packet, size = follower.frames_per_packet, follower.frame_bytes
    for slot in range(6):
        slot_s = 40.0 + 12.0 * slot
        rig.run_until(slot_s - follower.lead_s - 0.25)
        for k in range(1 + slot % per_packet):
            follower.send(bytes([slot, k]) * (size // 2), rig.now_s, start_s=slot_s)
        rig.run_until(slot_s + 8.0)
    starts_s = [e.start_s for e in rig.taken(1, FrameSent) if isinstance(e, FrameSent)]
    expected = [40.0 + 12.0 * s for s in range(6) for _ in range(1 + s % per_packet)]
    assert starts_s == expected
    heard = [e for e in rig.taken(2, FrameHeard) if isinstance(e, FrameHeard)]
    assert [e.toa_s for e in heard] == pytest.approx([s + 0.4 for s in expected], abs=1e-3)
    assert follower.counters["late"] == 0


def test_an_answer_named_for_a_second_does_not_start_on_the_one_before() -> None:
    rig = micro_rig()
    rig.run_until(38.0)
    rig.cores[1].send(answer(), rig.now_s, start_s=42.0)
    rig.run_until(50.0)
    assert [e.start_s for e in rig.taken(1, FrameSent) if isinstance(e, FrameSent)] == [42.0]
