"""What users of other modem software complained about, each as a test of ours."""

from collections.abc import Callable
from pathlib import Path

import pytest

from host_tools.emulators.micromodem import MicroModemUnit
from host_tools.emulators.micromodem_firmware import MicroModemQuirks
from host_tools.emulators.nanomodem import NanomodemQuirks
from host_tools.emulators.rig import Rig
from protocol.codec import decode, encode
from protocol.errors import RemoteProtocolError
from protocol.modems import nmea
from protocol.modems.events import (
    FrameAcknowledged,
    FrameHeard,
    LinkQuality,
    ModemComplaint,
)
from protocol.modems.micromodem import MicroModem
from protocol.modems.micromodem_settings import MicroModemSettings
from protocol.modems.micromodem_states import State
from protocol.modems.nanomodem import Nanomodem
from protocol.modems.nanomodem_states import NanomodemSettings
from protocol.packets import Answer, Header, Profile
from tests.modems.pairs import pair
from tests.modems.rigs import micro_rig, nano_rig

BOTH = pytest.mark.parametrize("make_rig", [micro_rig, nano_rig])
MakeRig = Callable[..., Rig]


def answer() -> bytes:
    header = Header(
        profile=Profile.ANSWER,
        vehicle=0,
        boot_epoch=0,
        submap=7,
        fragment=0,
        fragment_count=1,
        tx_second=9,
        time_quarters=0,
    )
    return encode(Answer(header=header, submap=7, north_m=1.5, east_m=-2.5))


def frames_of(rig: Rig, node: int) -> list[bytes]:
    return [e.frame for e in rig.taken(node, FrameHeard) if isinstance(e, FrameHeard)]


def pass_one_frame(rig: Rig) -> None:
    rig.cores[1].send(b"still alive", rig.now_s)
    rig.run_until(rig.now_s + 8.0)
    assert b"still alive" in frames_of(rig, 2)


UNREADABLE = [
    nmea.encode("CARXD", 1, 2, 0, 1, "0G"),
    nmea.encode("CARXD", 1, 2, 0, 1, "000"),
    nmea.encode("CARXD"),
    nmea.encode("CARDP", 1, 2, 1, 0, 0, ";;;;", "1;two;xx;1"),
    nmea.encode("CACST"),
    nmea.encode("CACST", "x", "", ""),
    nmea.encode("CAMUA", 1, 2, "XYZ"),
]
MEANINGLESS = [
    nmea.encode("CARXD", "one", 2, 0, 1, "00"),
    nmea.encode("CACST", 0, "999999.9", "nine"),
    nmea.encode("CADRQ", "", "", "", "", "", "x"),
    nmea.encode("CADRQ", 0, 2, 0, 0, 256, 999999),
    nmea.encode("CAREV", "", "INIT"),
    nmea.encode("CAREV", "", "AUV", "a.b.c"),
    nmea.encode("CAREV", "", "AUV", "9" * 5000),
    nmea.encode("CAMPR", 1, 2, "-1"),
    nmea.encode("CAACK", 2, 1, -5, 1),
    nmea.encode("CATMQ", "yesterday"),
    nmea.encode("CAERR"),
    nmea.encode("CAXST", *("",) * 20),
]
DAMAGED = [b"$CARXD,1,2,0,1,00*00\r\n", b"\xff\xfe$$$***,,,\r\n" * 50]


@pytest.mark.parametrize(
    ("line", "counter"),
    [
        *((line, "undecodable") for line in UNREADABLE),
        *((line, "lines") for line in MEANINGLESS),
        *((line, "damaged_lines") for line in DAMAGED),
    ],
)
def test_one_undecodable_line_is_counted_and_neither_kills_nor_hangs_the_driver(
    line: bytes, counter: str
) -> None:
    """Goby3 issues 283 and 224."""
    rig = micro_rig()
    core = rig.cores[2]
    before = core.status()[counter]
    core.receive_data(line, rig.now_s)
    core.poll(rig.now_s)
    assert core.status()[counter] == before + line.count(b"\n")
    pass_one_frame(rig)


@BOTH
def test_undecodable_bytes_in_every_state_neither_kill_nor_hang_the_driver(
    make_rig: MakeRig,
) -> None:
    """Goby3 issues 283 and 224, for all that a core may be waiting for."""
    rig = make_rig()
    for _ in range(40):
        rig.cores[1].receive_data(b"\x00#B9$CARXD,*\xff#U99E\n$M\r\n", rig.now_s)
        rig.run_until(rig.now_s + 0.37)
    rig.run_until(rig.now_s + 30.0)
    pass_one_frame(rig)


@pytest.mark.parametrize("number", ["", "x", 0, -1, 3, 999999])
def test_a_data_request_for_no_frame_of_ours_harms_nothing(number: str | int) -> None:
    rig = micro_rig(settings=MicroModemSettings(flexible=False))
    core = rig.cores[1]
    assert isinstance(core, MicroModem)
    core.send(b"x" * 200, rig.now_s)
    while core.state is not State.CYCLE_ASKED:
        rig.run_until(rig.now_s + 0.02)
    core.receive_data(nmea.encode("CADRQ", "000000", 1, 2, 0, 256, number), rig.now_s)
    rig.run_until(rig.now_s + 30.0)
    assert b"x" * 200 in frames_of(rig, 2)
    pass_one_frame(rig)


def test_a_configuration_dump_without_end_and_with_a_heartbeat_in_it_ends() -> None:
    """Goby3 issue 126."""
    rig = micro_rig(quirks=MicroModemQuirks(heartbeat_in_dump=True))
    core = rig.cores[1]
    assert isinstance(core, MicroModem)
    assert core.state is State.IDLE
    assert core.counters["restarts"] == 1  # its own boot, not the heartbeat in the dump
    assert core.counters["settings_refused"] == 0


def test_a_configuration_dump_that_never_ends_is_bounded() -> None:
    """Goby3 issue 126, at its worst."""
    core = MicroModem(MicroModemSettings())
    core.poll(0.0)
    for n in range(3000):
        core.receive_data(nmea.encode("CACFG", f"K{n}", n), n * 0.01)
        core.poll(n * 0.01)
    states = [core.state]
    assert len(core.told) <= 512
    core.poll(40.0)
    assert [*states, core.state] == [State.DUMPING, State.CONFIGURING]


@pytest.mark.parametrize("kind", ["micromodem", "nanomodem"])
def test_an_acknowledgement_returns_the_very_bytes_that_went_out(kind: str) -> None:
    """Goby3 issue 374: there it returned the message quantised once more."""
    if kind == "micromodem":
        rig = micro_rig(
            settings=MicroModemSettings(destination=2, acknowledge=True, flexible=False)
        )
    else:
        rig = nano_rig(
            settings=lambda n: NanomodemSettings(address=n, destination=3 - n, acknowledge=True)
        )
    rig.cores[1].send(answer(), rig.now_s)
    rig.run_until(rig.now_s + 10.0)
    (event,) = rig.taken(1, FrameAcknowledged)
    assert isinstance(event, FrameAcknowledged)
    assert [event.frame] == frames_of(rig, 2)


@BOTH
def test_link_quality_is_reported_for_every_packet(make_rig: MakeRig) -> None:
    """Goby3 issue 271."""
    rig = make_rig()
    for _ in range(3):
        pass_one_frame(rig)
    qualities = [e for e in rig.taken(2, LinkQuality) if isinstance(e, LinkQuality)]
    assert len(qualities) == 3
    assert all(q.quality_share is not None and q.good_frames == 1 for q in qualities)


def test_ptys_work_without_socat(tmp_path: Path) -> None:
    """Goby3 issue 161."""
    with pair("nanomodem", tmp_path) as both:
        both.run(3.0)
        assert all(driver.status().is_up for driver in both.drivers)


def test_the_error_of_a_truncated_frame_says_what_and_where() -> None:
    """DCCL issue 120."""
    for cut in range(1, len(answer())):
        with pytest.raises(RemoteProtocolError) as error:
            decode(answer()[:cut])
        text = str(error.value)
        assert "bytes" in text
        assert "\n" not in text


@BOTH
def test_a_reply_cut_short_is_never_read_past_its_end(make_rig: MakeRig) -> None:
    """DCCL issue 132."""
    rig = make_rig()
    whole = {
        "micromodem": nmea.encode("CARXD", 2, 1, 0, 1, answer().hex()),
        "nanomodem": b"#B00224\x02\x09" + answer() + b"\r\n",
    }[rig.cores[1].name]
    for cut in range(len(whole) - 1):
        rig.cores[1].receive_data(whole[:cut], rig.now_s)
        rig.run_until(rig.now_s + 1.0)
        rig.cores[1].receive_data(b"\r\n", rig.now_s)
        rig.run_until(rig.now_s + 1.0)
    assert frames_of(rig, 1) == []


def test_a_frame_with_a_wrong_check_is_never_let_through_and_the_next_one_is_read() -> None:
    """Pymavlink issues 1019 and 881: checks bypassed, parsers out of step."""
    core = MicroModem(MicroModemSettings())
    line = nmea.encode("CARXD", 2, 1, 0, 1, answer().hex())
    for position in range(1, len(line) - 2):
        damaged = bytearray(line)
        damaged[position] ^= 0x01
        core.receive_data(bytes(damaged), 0.0)
    core.poll(100.0)
    heard = []
    while (event := core.next_event()) is not None:
        heard += [event.frame] if isinstance(event, FrameHeard) else []
    assert heard == []
    core.receive_data(line, 200.0)
    core.poll(300.0)
    events = iter(core.next_event, None)
    assert [e.frame for e in events if isinstance(e, FrameHeard)] == [answer()]


@BOTH
def test_frames_that_look_like_the_dialect_itself_pass_unchanged(make_rig: MakeRig) -> None:
    """MAVLink issue 632: no escaping in the framing."""
    rig = make_rig()
    frames = [b"$CARXD,1,2*00\r\n", b"#TO\r\n#U02xx\r\nE\r\n", b"\x00" * 20, b"V12345"]
    for frame in frames:
        rig.cores[1].send(frame, rig.now_s)
    rig.run_until(rig.now_s + 40.0)
    assert frames_of(rig, 2) == frames


@pytest.mark.parametrize("kind", ["micromodem", "nanomodem"])
def test_our_own_frames_heard_back_are_dropped_and_counted(kind: str) -> None:
    """Python-can issue 136."""
    if kind == "micromodem":
        rig = micro_rig(quirks=MicroModemQuirks(echoes_own=True))
    else:
        rig = nano_rig(quirks=NanomodemQuirks(echoes_own=True))
    pass_one_frame(rig)
    assert frames_of(rig, 1) == []
    assert rig.cores[1].status()["own_echoes"] == 1


@pytest.mark.parametrize("kind", ["micromodem", "nanomodem"])
def test_a_modem_that_refuses_everything_gets_no_storm_of_commands(kind: str) -> None:
    """Bellows issue 699: refusals answered by repeats at once."""
    rig = micro_rig() if kind == "micromodem" else nano_rig()
    unit, core = rig.bench.units[1], rig.cores[1]
    quirks = MicroModemQuirks if isinstance(unit, MicroModemUnit) else NanomodemQuirks
    unit.quirks = quirks(refuses_all=True)  # type: ignore[attr-defined]
    for n in range(20):
        core.send(bytes([n]) * 20, rig.now_s)
    begin_s, said = rig.now_s, 0
    inner = core.poll

    def counting_poll(now_s: float) -> bytes:
        nonlocal said
        output = inner(now_s)
        said += len(output) > 0
        return output

    core.poll = counting_poll  # type: ignore[method-assign]
    rig.run_until(begin_s + 120.0)
    assert said <= 120  # one a second, and fewer as the pauses grow
    complaints = rig.taken(1, ModemComplaint)
    assert 0 < len(complaints) < 60
    assert len(core.outbox) == 20
    unit.quirks = quirks()  # type: ignore[attr-defined]
    rig.run_until(rig.now_s + 400.0)
    assert len(frames_of(rig, 2)) == 20


@pytest.mark.parametrize("terminator", [b"\r\n", b"\n", b"\r"])
@pytest.mark.parametrize("kind", ["micromodem", "nanomodem"])
def test_terminators_of_serial_ports_and_sockets_all_work(kind: str, terminator: bytes) -> None:
    """DESERT pull request 42."""
    if kind == "micromodem":
        rig = micro_rig(quirks=MicroModemQuirks(terminator=terminator))
    else:
        rig = nano_rig(quirks=NanomodemQuirks(terminator=terminator))
    pass_one_frame(rig)


@pytest.mark.parametrize("kind", ["micromodem", "nanomodem"])
def test_noise_before_every_reply_is_skipped(kind: str) -> None:
    """Foxpoint's driver strips what its modem's adapter puts before replies."""
    if kind == "micromodem":
        rig = micro_rig(quirks=MicroModemQuirks(sends_noise=b"\x00\xfe"))
    else:
        rig = nano_rig(quirks=NanomodemQuirks(leading_noise=b"\x00\xfe"))
    pass_one_frame(rig)


@pytest.mark.parametrize("core_type", [MicroModem, Nanomodem])
def test_events_that_nobody_fetches_are_bounded(core_type: type[MicroModem | Nanomodem]) -> None:
    core = core_type(MicroModemSettings() if core_type is MicroModem else NanomodemSettings())  # type: ignore[arg-type]
    for n in range(5000):
        core.receive_data(nmea.encode("CAMUA", 2, 1, "0001"), n * 0.1)
        core.receive_data(b"#B00204\x02%cxx\r\n" % (n % 256), n * 0.1)
    assert len(core._events) <= 512


def statistics(mode: int, arrival_s: float, source: str | int) -> bytes:
    """Return the line about a packet that arrived so many seconds into the day."""
    head: list[str | int] = [mode, f"0000{arrival_s:07.4f}", 3 << 2, *[0] * 9]
    return nmea.encode("CACST", *head, 4, source, 1, 0, 3, 1, 0, *[0] * 10)


@pytest.mark.parametrize(("mode", "source"), [(0, 3), (2, 2), (2, "")])
def test_a_frame_whose_statistics_are_lost_takes_no_arrival_of_another_packet(
    mode: int, source: str | int
) -> None:
    rig = micro_rig()
    core = rig.cores[1]
    core.receive_data(nmea.encode("CARXD", 2, 1, 0, 1, "AABB"), rig.now_s + 3.0)
    core.receive_data(statistics(mode, rig.now_s + 5.0, source), rig.now_s + 6.0)
    (heard,) = [event for event in iter(core.next_event, None) if isinstance(event, FrameHeard)]
    assert (heard.source, heard.toa_s) == (2, None)


@pytest.mark.parametrize("source", [2, ""])
def test_a_frame_takes_the_arrival_that_its_own_statistics_tell(source: str | int) -> None:
    rig = micro_rig()
    core = rig.cores[1]
    core.receive_data(nmea.encode("CARXD", 2, 1, 0, 1, "AABB"), rig.now_s + 3.0)
    core.receive_data(statistics(0, rig.now_s + 0.4, source), rig.now_s + 3.1)
    (heard,) = [event for event in iter(core.next_event, None) if isinstance(event, FrameHeard)]
    assert heard.toa_s == pytest.approx(rig.now_s + 0.4, abs=1e-3)


def test_a_packet_that_begins_ends_one_whose_statistics_are_lost() -> None:
    """Of the same sender, four seconds later, it would pass its arrival on to both."""
    rig = micro_rig()
    core = rig.cores[1]
    core.receive_data(nmea.encode("CARXD", 2, 1, 0, 1, "AABB"), rig.now_s + 3.0)
    core.receive_data(nmea.encode("CARXP", 0), rig.now_s + 6.0)
    core.receive_data(nmea.encode("CARXD", 2, 1, 0, 1, "CCDD"), rig.now_s + 7.0)
    core.receive_data(statistics(0, rig.now_s + 4.4, 2), rig.now_s + 7.1)
    heard = [event for event in iter(core.next_event, None) if isinstance(event, FrameHeard)]
    assert [event.frame for event in heard] == [b"\xaa\xbb", b"\xcc\xdd"]
    assert heard[0].toa_s is None
    assert heard[1].toa_s == pytest.approx(rig.now_s + 4.4, abs=1e-3)
