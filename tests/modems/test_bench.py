"""The bench of emulated modems: one water for all, and ports that behave like ports."""

import termios
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import serial

from host_tools.emulators.bench import Bench, Line, Unit
from host_tools.emulators.micromodem import MicroModemUnit
from host_tools.emulators.nanomodem import NanomodemUnit
from host_tools.emulators.ptys import BACKLOG_BYTES, PseudoPort
from host_tools.emulators.run import Emulation, EmulationSettings
from protocol.acoustics import Water
from protocol.errors import ConfigError
from protocol.modems.nmea import decode
from tests.modems.rigs import CALM, apart

MakeUnit = Callable[[int], Unit]


def bench_of(make_unit: MakeUnit, nodes: int) -> Bench:
    water = Water(CALM, np.random.default_rng(1), apart(300.0), nodes=tuple(range(1, nodes + 1)))
    return Bench(water, {n: make_unit(n) for n in water.nodes})


def test_a_broadcast_is_heard_by_all_others_each_at_its_distance() -> None:
    bench = bench_of(NanomodemUnit, 4)
    bench.units[1].receive_data(b"$B05hello", 0.0)
    heard_s: dict[int, float] = {}
    while bench.next_event_s() < 10.0:
        bench.advance(bench.next_event_s())
        for node in (2, 3, 4):
            if bench.units[node].poll(bench.now_s) == b"#B00105hello\r\n":
                heard_s[node] = bench.now_s
    assert heard_s[3] - heard_s[2] == pytest.approx(0.2)
    assert heard_s[4] - heard_s[3] == pytest.approx(0.2)


def test_packets_that_meet_at_a_receiver_are_both_lost_there() -> None:
    bench = bench_of(NanomodemUnit, 3)
    for node in (1, 3):
        bench.units[node].receive_data(b"$B05hello", 0.0)
    bench.advance(10.0)
    assert bench.units[2].poll(10.0) == b""
    assert bench.fates["collision"] == 2


def test_a_packet_under_way_at_the_end_is_counted_and_heard_by_nobody() -> None:
    bench = bench_of(NanomodemUnit, 2)
    bench.units[1].receive_data(b"$B05hello", 0.0)
    bench.advance(0.3)
    assert not bench.fates
    bench.end()
    assert bench.fates == {"delivered": 1}
    assert bench.units[2].poll(10.0) == b""


def test_modems_of_two_dialects_in_one_water_do_not_understand_each_other() -> None:
    def make(node: int) -> Unit:
        return NanomodemUnit(node) if node == 1 else MicroModemUnit(node)

    bench = bench_of(make, 2)
    bench.advance(5.0)
    bench.units[2].poll(5.0)
    bench.units[1].receive_data(b"$B05hello", 5.0)
    bench.advance(10.0)
    assert bench.units[2].poll(10.0) == b""


def test_a_micromodem_takes_preloaded_data_and_sentences_without_checksum() -> None:
    bench = bench_of(MicroModemUnit, 2)
    bench.advance(5.0)
    bench.units[1].receive_data(b"$CCTXD,1,2,0,68656C6C6F\r\n$CCCYC,0,1,2,0,0,1\r\n", 5.0)
    bench.advance(20.0)
    lines = [decode(line) for line in bench.units[2].poll(20.0).splitlines()]
    frames = [s.fields[4] for s in lines if s is not None and s.name == "CARXD"]
    assert frames == ["68656C6C6F"]


@pytest.mark.parametrize(
    ("said", "answer"),
    [
        (b"$CCXXX,1*00\r\n", b"CAERR"),
        (b"$CCXXX\r\n", b"CAERR"),
        (b"$CCCFG,NO,1\r\n", b"Unknown setting"),
        (b"$CCCYC,0,1,2,9,0,1\r\n", b"Bad field"),
        (b"$CCCYC,0,2,1,4,0,1\r\n", b"Bad field"),
        (b"$CCCYC\r\n", b"Bad field"),
        (b"$CCTDP,2,1,0,0,XY\r\n", b"Bad field"),
        (b"$CCCYC,0,1,2,4,0,1\r\n" * 2, b"BUSY"),
        (b"$CCCYC,0,1,2,4,0,1\r\n", b"DATA_TIMEOUT,1"),
        (b"$CCMSC,1,1,0\r\n", b"INIT"),
    ],
)
def test_a_micromodem_answers_mistakes_as_a_modem_would(said: bytes, answer: bytes) -> None:
    bench = bench_of(MicroModemUnit, 2)
    bench.advance(5.0)
    bench.units[1].poll(5.0)
    bench.units[1].receive_data(said, 5.0)
    bench.advance(15.0)
    assert answer in bench.units[1].poll(15.0)


def test_bytes_take_their_time_on_the_line() -> None:
    line = Line(9600)
    line.put(b"x" * 96, 1.0)
    line.put(b"y" * 96, 1.0)
    assert line.take(1.09) == b""
    assert line.take(1.1001) == b"x" * 96
    assert line.next_s() == pytest.approx(1.2)


def test_a_host_at_another_speed_hears_garbage(tmp_path: Path) -> None:
    port = PseudoPort(19_200, tmp_path / "port")
    with serial.Serial(port.name, 4800, timeout=1.0) as host:
        port.write(b"$CACFG,SRC,1*33\r\n")
        assert b"$CA" not in host.read(17)
        host.baudrate = 19_200
        port.write(b"$CACFG,SRC,1*33\r\n")
        assert host.read(17) == b"$CACFG,SRC,1*33\r\n"
    port.close()
    assert not (tmp_path / "port").exists()


def test_a_port_takes_the_name_of_a_dead_one_alone(tmp_path: Path) -> None:
    link = tmp_path / "port"
    link.write_text("mine")
    with pytest.raises(ConfigError, match="port is there already; remove it"):
        PseudoPort(9600, link)
    assert link.read_text() == "mine"
    link.unlink()
    live = PseudoPort(9600, link)
    with pytest.raises(ConfigError, match="port is there already; remove it"):
        PseudoPort(9600, link)
    assert link.exists()
    live.close()
    link.symlink_to(tmp_path / "gone")
    PseudoPort(9600, link).close()
    assert not link.is_symlink()


def test_a_host_that_does_not_read_costs_a_bounded_backlog() -> None:
    port = PseudoPort(19_200)
    for _ in range(200):
        port.write(b"x" * 1000)
    assert len(port._backlog) <= BACKLOG_BYTES
    assert port.lost_bytes > 0
    port.unplug()
    port.write(b"gone")
    assert port.read() == b""
    port.close()


def test_ports_are_raw_so_that_no_byte_is_changed() -> None:
    port = PseudoPort(9600)
    everything = bytes(range(256))
    with serial.Serial(port.name, 9600, timeout=1.0) as host:
        host.write(everything)
        host.flush()
        heard = b""
        for _ in range(1000):
            heard += port.read()
            if len(heard) == 256:
                break
            termios.tcdrain(host.fileno())
        assert heard == everything
    port.close()


@pytest.mark.parametrize(
    "settings", [{"kind": "janus"}, {"nodes": 1}, {"nodes": 16}, {"range_m": float("nan")}]
)
def test_an_emulation_that_cannot_be_is_refused(settings: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        Emulation(EmulationSettings(**settings))  # type: ignore[arg-type]
