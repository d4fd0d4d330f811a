"""The Nanomodem's replies, its core against emulated modems, and its emulator against the guide."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from host_tools.emulators.bench import AirPacket, Heard
from host_tools.emulators.nanomodem import NanomodemQuirks, NanomodemUnit, command_size
from host_tools.emulators.rig import Rig
from protocol.errors import LocalProtocolError
from protocol.modems.events import (
    FrameAcknowledged,
    FrameDropped,
    FrameHeard,
    FrameSent,
    LinkQuality,
    PeerSilent,
    RangeMeasured,
    SupplyVoltage,
)
from protocol.modems.nanomodem import Nanomodem
from protocol.modems.nanomodem_lines import Reply, ReplyReader, airtime_s
from protocol.modems.nanomodem_states import TABLE, WAITS_S, NanomodemSettings, State
from tests.modems.rigs import CALM, nano_rig


def read(data: bytes, step: int = 10_000) -> tuple[list[Reply], int]:
    reader = ReplyReader()
    for start in range(0, len(data), step):
        reader.receive_data(data[start : start + step], 0.0)
    reader.settle(10.0)
    found = []
    while (reply := reader.next_reply()) is not None:
        found.append(reply)
    return found, reader.skipped_bytes


def frames_of(rig: Rig, node: int) -> list[bytes]:
    return [e.frame for e in rig.taken(node, FrameHeard) if isinstance(e, FrameHeard)]


def core_of(rig: Rig, node: int) -> Nanomodem:
    core = rig.cores[node]
    assert isinstance(core, Nanomodem)
    return core


def say(unit: NanomodemUnit, text: bytes, now_s: float = 0.0, until_s: float = 1.0) -> bytes:
    unit.receive_data(text, now_s)
    unit.run(until_s)
    return unit.poll(until_s + 1.0)


def test_every_action_of_the_table_exists_and_every_wait_has_a_way_out() -> None:
    for action, _ in TABLE.values():
        assert callable(getattr(Nanomodem, "_" + action))
    for state in WAITS_S:
        assert (state, "gone") in TABLE


@pytest.mark.parametrize("step", [1, 3, 1000])
def test_payloads_may_hold_any_byte(step: int) -> None:
    payload = b"$E#TO\r\n#U02"
    data = b"#B007%02d" % len(payload) + payload + b"\r\n#U%02d" % len(payload) + payload
    found, skipped = read(data + b"\r\n#TO\r\n$C3\r\n$C-\r\n#R009T00042\r\n", step)
    assert skipped == 0
    assert found == [
        Reply(kind="#B", address=7, payload=payload),
        Reply(kind="#U", payload=payload),
        Reply(kind="#TO"),
        Reply(kind="$C", number=3),
        Reply(kind="$C"),
        Reply(kind="#R", address=9, number=42),
    ]


def test_garbage_before_a_reply_costs_the_garbage_only() -> None:
    found, skipped = read(b"\x00\xffxE#$#A1#A007V00100\r\nzE\r\n")
    assert [reply.kind for reply in found] == ["#A", "E"]
    assert skipped > 0


def test_bytes_lost_from_a_payload_do_not_swallow_the_next_reply() -> None:
    found, _ = read(b"#U10abc\r\n#R009T00042\r\n#TO\r\n")
    assert Reply(kind="#TO") in found


def heard_by(modem: Nanomodem) -> list[bytes]:
    events = iter(modem.next_event, None)
    return [event.frame for event in events if isinstance(event, FrameHeard)]


def test_a_reply_whose_rest_is_read_late_is_whole() -> None:
    """A loop that stood for longer than a silence finds the rest behind the beginning."""
    modem, line = Nanomodem(NanomodemSettings()), b"#B00207\x02\x01abcde\r\n"
    modem.receive_data(line[:9], 10.0)
    modem.poll(10.0)
    modem.receive_data(line[9:], 12.0)
    assert heard_by(modem) == [b"abcde"]


def test_a_reply_whose_rest_never_comes_costs_itself_only() -> None:
    modem = Nanomodem(NanomodemSettings())
    modem.receive_data(b"#B00207\x02\x01", 10.0)
    modem.poll(10.0)
    modem.receive_data(b"#B00203\x02\x01a\r\n", 12.0)
    modem.poll(12.6)
    assert heard_by(modem) == [b"a"]


@given(st.binary(max_size=300), st.integers(1, 30))
def test_any_bytes_in_any_chunking_never_raise(data: bytes, step: int) -> None:
    assert read(data, step) == read(data)


def test_airtime_is_the_guides() -> None:
    assert airtime_s(64) == pytest.approx(1.105)
    assert airtime_s(10) == pytest.approx(0.430)
    assert airtime_s(0) == pytest.approx(0.105)


def test_emulator_answers_local_commands_as_the_guide_says() -> None:
    unit = NanomodemUnit(7, NanomodemQuirks(volts=7.5))
    assert say(unit, b"$?") == b"#A007V32768\r\n"
    assert say(unit, b"$A012") == b"$A012\r\n#A012\r\n"
    assert say(unit, b"$Q") == b"$C-\r\n"
    assert say(unit, b"$P012") == b"E\r\n"
    assert say(unit, b"$Z") == b"E\r\n"
    assert say(unit, b"$B01x") == b"E\r\n"
    assert say(unit, b"$B65") == b"E\r\n"


def test_emulator_gives_half_a_command_up_after_the_gap() -> None:
    unit = NanomodemUnit(7, NanomodemQuirks(gap_s=0.002))
    assert say(unit, b"$B0", 0.0, 0.5) == b"E\r\n"
    assert say(unit, b"$?", 1.0, 2.0).startswith(b"#A007")


@pytest.mark.parametrize("wrong", [0, 1, 8, 9])
def test_emulator_repairs_eight_bytes_and_counts_them(wrong: int) -> None:
    unit = NanomodemUnit(7)
    packet = AirPacket(
        dialect="nanomodem",
        kind="unicast",
        source=2,
        destination=7,
        airtime_s=1.0,
        frames=(b"hello",),
    )
    unit.hear(Heard(packet=packet, t_rx_s=1.0, fate="corrupt", wrong_bytes=(wrong,)), 2.0)
    heard = unit.poll(9.0)
    assert heard == (b"#U05hello\r\n" if wrong <= 8 else b"")
    assert say(unit, b"$Q", 9.0, 10.0) == (b"$C%d\r\n" % wrong if wrong <= 8 else b"$C-\r\n")


@given(st.binary(max_size=200))
def test_no_bytes_from_a_host_raise_in_the_emulator(data: bytes) -> None:
    command_size(data)
    unit = NanomodemUnit(7)
    for start in range(0, len(data), 7):
        unit.receive_data(data[start : start + 7], start * 0.1)
        unit.run(start * 0.1)
    unit.poll(100.0)


def test_frames_are_broadcast_with_quality_and_air_time_of_the_guide() -> None:
    rig = nano_rig(range_m=1500.0)
    frames = [bytes([n]) * 62 for n in range(4)]
    begin_s = rig.now_s
    for frame in frames:
        rig.cores[1].send(frame, rig.now_s)
    rig.run_until(rig.now_s + 10.0)
    heard = [e for e in rig.taken(2, FrameHeard) if isinstance(e, FrameHeard)]
    assert [e.frame for e in heard] == frames
    assert {e.source for e in heard} == {1}
    assert {e.toa_s for e in heard} == {None}
    assert heard[0].heard_s - begin_s == pytest.approx(1.105 + 1.0 + 2 * 0.075, abs=0.05)
    assert len(rig.taken(1, FrameSent)) == 4
    qualities = [e for e in rig.taken(2, LinkQuality) if isinstance(e, LinkQuality)]
    assert qualities
    assert qualities[0].quality_share == 1.0
    assert core_of(rig, 1).counters["errors"] == 0


@pytest.mark.parametrize("range_m", [1.0, 500.0, 1999.0])
def test_ping_measures_the_range_to_a_count(range_m: float) -> None:
    rig = nano_rig(range_m=range_m)
    rig.cores[1].ping(2)
    rig.run_until(rig.now_s + 6.0)
    (measured,) = rig.taken(1, RangeMeasured)
    assert isinstance(measured, RangeMeasured)
    assert measured.owtt_s * 1500.0 == pytest.approx(range_m, abs=0.05)


def test_a_silent_peer_is_reported_after_the_modems_four_seconds() -> None:
    rig = nano_rig()
    begin_s = rig.now_s
    rig.cores[1].ping(77)
    rig.run_until(rig.now_s + 6.0)
    (silent,) = rig.taken(1, PeerSilent)
    assert isinstance(silent, PeerSilent)
    assert silent.at_s - begin_s == pytest.approx(4.105, abs=0.05)


def to_the_other(node: int) -> NanomodemSettings:
    return NanomodemSettings(address=node, destination=3 - node, acknowledge=True)


def test_acknowledged_frames_return_what_was_sent_and_the_range() -> None:
    rig = nano_rig(settings=to_the_other, range_m=900.0)
    rig.cores[1].send(b"x" * 62, rig.now_s)
    rig.run_until(rig.now_s + 6.0)
    assert frames_of(rig, 2) == [b"x" * 62]
    assert rig.taken(1, FrameAcknowledged) == [FrameAcknowledged(frame=b"x" * 62, peer=2)]
    (measured,) = rig.taken(1, RangeMeasured)
    assert isinstance(measured, RangeMeasured)
    assert measured.owtt_s == pytest.approx(0.6, abs=1e-4)


def test_the_first_acknowledged_frame_after_a_restart_counts() -> None:
    rig = nano_rig(
        settings=lambda n: NanomodemSettings(address=n, destination=3 - n, acknowledge=True)
    )
    for life in range(3):
        rig.cores[1] = Nanomodem(core_of(rig, 1).settings)
        rig.run_until(rig.now_s + 10.0)
        rig.cores[1].send(b"life %d" % life, rig.now_s)
        rig.run_until(rig.now_s + 10.0)
        assert frames_of(rig, 2) == [b"life %d" % life]


def test_acknowledged_frames_are_repeated_until_they_arrive_and_count_once() -> None:
    rig = nano_rig(settings=to_the_other, water=replace(CALM, loss=0.3), seed=4)
    frames = [bytes([n]) * 20 for n in range(30)]
    for frame in frames:
        rig.cores[1].send(frame, rig.now_s)
    rig.run_until(rig.now_s + 900.0)
    assert frames_of(rig, 2) == frames
    assert core_of(rig, 2).counters["repeats"] > 0


def test_a_frame_that_nobody_ever_acknowledges_is_dropped_and_said_so() -> None:
    rig = nano_rig(settings=lambda n: NanomodemSettings(address=n, destination=9, acknowledge=True))
    rig.cores[1].send(b"x" * 20, rig.now_s)
    rig.run_until(rig.now_s + 300.0)
    (dropped,) = rig.taken(1, FrameDropped)
    assert isinstance(dropped, FrameDropped)
    assert "8 times" in dropped.reason


def test_a_peers_supply_voltage_can_be_asked() -> None:
    rig = nano_rig(quirks=NanomodemQuirks(volts=6.0))
    rig.taken(1, SupplyVoltage)
    core_of(rig, 1).ask_voltage(2)
    rig.run_until(rig.now_s + 3.0)
    (told,) = [e for e in rig.taken(1, SupplyVoltage) if isinstance(e, SupplyVoltage)]
    assert told.address == 2
    assert told.volts == pytest.approx(6.0, abs=1e-3)


def test_paper_frames_are_refused_in_one_line_that_says_why() -> None:
    core = Nanomodem(NanomodemSettings())
    with pytest.raises(LocalProtocolError) as refusal:
        core.send(bytes(256), 0.0)
    text = str(refusal.value)
    assert "\n" not in text
    assert "256 bytes" in text
    assert "paper" in text
    assert "lattice" in text


@pytest.mark.parametrize("after_s", [0.05, 0.5, 1.5, 3.0])
def test_power_cycle_and_pulled_cable_lose_nothing_acknowledged_or_queued(after_s: float) -> None:
    rig = nano_rig(settings=to_the_other)
    frames = [bytes([n]) * 62 for n in range(8)]
    for frame in frames:
        rig.cores[1].send(frame, rig.now_s)
    rig.run_until(rig.now_s + after_s)
    rig.bench.units[1].power_cycle(rig.now_s)
    rig.run_until(rig.now_s + 8.0)
    rig.unplug(1)
    rig.run_until(rig.now_s + 5.0)
    rig.plug(1)
    rig.run_until(rig.now_s + 120.0)
    assert set(frames_of(rig, 2)) == set(frames)
    assert len(core_of(rig, 1).outbox) == 0


def test_a_swapped_modem_gets_the_address() -> None:
    rig = nano_rig()
    unit = rig.bench.units[1]
    assert isinstance(unit, NanomodemUnit)
    unit.address = 99
    rig.run_until(rig.now_s + 15.0)
    assert unit.address == 1
    assert core_of(rig, 1).state is State.IDLE
    assert core_of(rig, 1).counters["restarts"] == 1
