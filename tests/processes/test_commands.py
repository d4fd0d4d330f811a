"""The commands themselves: real processes, real ports, and what they say when something is off."""

import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from firmware.clock import WallClock
from host_tools.cli import main
from host_tools.emulators.ptys import PseudoPort
from host_tools.processes import vehicle as vehicle_process
from host_tools.processes.demo import Crew
from host_tools.processes.sealing import seal_of
from host_tools.processes.starts import lasting_start_s, start_time_s
from protocol.codec import decode, encode
from protocol.errors import ConfigError
from protocol.modems.raw_log import read_log
from protocol.packets import SealedFrame
from tests.protocol.strategies import paper_packet

SHORT = ["--seed", "5", "--set", "duration_min=2.5", "--set", "beams=32"]
SHORT += ["--set", "follower_duration_min=2"]


def fathomlink(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "host_tools.cli", *arguments, *SHORT]


def alike(one: Path, other: Path, names: list[str]) -> bool:
    return all((one / name).read_bytes() == (other / name).read_bytes() for name in names)


def test_two_processes_write_the_same_files_as_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["demo", "--out", str(tmp_path / "two"), *SHORT]) == 0
    said = capsys.readouterr()
    assert "report.html" in said.out
    assert "dead reckoning" in said.out
    assert said.err == ""
    assert "_failed" not in said.out
    assert (tmp_path / "two" / "report.html").is_file()
    assert main(["simulate", "--no-report", "--out", str(tmp_path / "one"), *SHORT]) == 0
    names = ["air.jsonl", "closures.csv", "leader_final.tum", "follower_1_live.tum", "map.tif"]
    assert alike(tmp_path / "one", tmp_path / "two", names)
    assert (tmp_path / "one" / "air.jsonl").read_bytes().count(b"\n") > 20


def test_a_dying_process_ends_the_demo_with_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    start = Crew.start

    def start_badly(crew: Crew, name: str, arguments: list[str], log: Path) -> None:
        more = ["--vehicle", "9"] if name != "leader" else []
        start(crew, name, [*arguments, *more], log)

    monkeypatch.setattr(Crew, "start", start_badly)
    assert main(["demo", "--out", str(tmp_path), *SHORT]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "follower_1 ended with status 2: fathomlink: --vehicle is 9" in error


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["follower", "--modem", "serial:///dev/nowhere"], "/dev/nowhere is not there; plug"),
        (["follower", "--modem", "loopback://"], "two processes need serial://"),
        (["leader", "--modem", "/dev/ttyUSB0"], "is no URL; write e.g."),
        (["leader", "--modem", "serial:///dev/ptmx", "--clock", "sundial"], "give wall, or the"),
        (["follower", "--vehicle", "2", "--modem", "x"], "this scenario's followers are 1 to 1"),
        (["leader", "--modem", "serial:///dev/ptmx", "--start", "noon"], "such as 2026-05-01T12"),
        (["channel", "--ports", "/dev/null"], "give --ports a short path"),
        (["leader", "--modem", "foo:///dev/ttyUSB0"], "known are loopback://, micromodem://, nano"),
        (
            ["leader", "--modem", "micromodem:///x?adress=2"],
            "unknown option 'adress'; known are",
        ),
        (["leader", "--modem", "micromodem:///x?rate=9"], "rate is 9; it must be at most 6"),
        (["leader", "--modem", "serial:///x", "--key", "/nowhere/key"], "openssl rand -hex 32"),
    ],
)
def test_what_is_wrong_with_a_port_or_a_clock_is_one_line(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*arguments, "--out", str(tmp_path), *SHORT]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_channel_that_runs_keeps_its_ports(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as running:
        running.bind(str(tmp_path / "clock"))
        running.listen()
        arguments = ["channel", "--ports", str(tmp_path), "--out", str(tmp_path / "out"), *SHORT]
        assert main(arguments) == 2
    assert f"a channel runs at {tmp_path}; end it, or give" in capsys.readouterr().err
    assert (tmp_path / "clock").is_socket()


@pytest.fixture
def line() -> Iterator[str]:
    """The name of a port at whose other end nobody is."""
    port = PseudoPort(9600)
    yield port.name
    port.close()


def test_a_modem_that_does_not_answer_is_told_before_the_mission_starts(
    line: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    clock = itertools.count()
    monkeypatch.setattr(WallClock, "now_s", lambda _: next(clock) * 0.1)
    monkeypatch.setattr("time.sleep", lambda _: None)
    raw_log = tmp_path / "raw"
    arguments = ["--modem", f"nanomodem://{line}", "--raw-log", str(raw_log), *SHORT]
    for log in (raw_log, tmp_path / "raw.1"):
        assert main(["follower", *arguments]) == 2
        error = capsys.readouterr().err
        assert "no answer from a nanomodem in 2 s at 9600 baud; check its power" in error
        assert error.count("\n") == 1
        with log.open() as lines:
            assert any(one.way == "out" for one in read_log(lines))


def test_a_modem_that_is_too_small_for_the_profile_is_told(
    line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("host_tools.processes.vehicle.await_identified", lambda *_: {})
    paper = ["--profile", "paper"]
    assert main(["leader", "--modem", f"nanomodem://{line}", *SHORT, *paper]) == 2
    error = capsys.readouterr().err
    assert "profile paper has frames of 256 bytes, this modem carries 62; take profile" in error


@pytest.mark.parametrize(
    ("mode", "digits", "more", "message"),
    [
        (0o600, 64, [], "--key needs --store"),
        (0o644, 64, ["--store"], "has mode 0644; type: chmod 600"),
        (0o600, 60, ["--store"], "holds 60 characters, not 64 hexadecimal digits"),
    ],
)
def test_a_key_that_cannot_be_used_is_one_line(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    mode: int,
    digits: int,
    more: list[str],
    message: str,
) -> None:
    key = tmp_path / "key"
    key.write_text("0" * digits)
    key.chmod(mode)
    store = [*more, str(tmp_path / "store")] if more else []
    assert main(["leader", "--modem", "serial:///x", "--key", str(key), *store, *SHORT]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_encryption_without_a_key_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["leader", "--modem", "serial:///x", "--encrypt", *SHORT]) == 2
    error = capsys.readouterr().err
    assert "--encrypt needs --key FILE" in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("leader_encrypts", [True, False])
def test_a_vehicle_that_encrypts_is_understood_by_those_that_do(
    tmp_path: Path, leader_encrypts: bool
) -> None:
    key, store = tmp_path / "key", tmp_path / "store"
    key.write_text("5a" * 32)
    key.chmod(0o600)
    store.mkdir()
    plain = encode(paper_packet())
    shown, hidden = (seal_of(1, key, store, encrypts=does).seal(plain) for does in (False, True))
    assert shown is not None
    assert hidden is not None
    assert plain[60:120] in shown
    assert plain[60:120] not in hidden
    leader = seal_of(0, key, store, encrypts=leader_encrypts)
    assert (leader.open(hidden) is not None) == leader_encrypts
    assert leader.counters["rejected_tag"] == (not leader_encrypts)


def test_a_start_is_a_whole_second_of_utc() -> None:
    assert start_time_s("1970-01-02T00:00:00Z") == 86_400.0
    assert start_time_s("1970-01-01T12:00:00") == 43_200.0
    assert start_time_s("next") % 60.0 == 0.0
    with pytest.raises(ConfigError, match="whole second"):
        start_time_s("1970-01-01T00:00:00.5Z")


def test_the_next_start_stays_that_of_a_stores_first_life_while_its_mission_lasts(
    tmp_path: Path,
) -> None:
    starts_s = [lasting_start_s(tmp_path, 1, now_s, 600.0) for now_s in (60.0, 120.0, 660.0, 720.0)]
    assert starts_s == [60.0, 60.0, 60.0, 720.0]
    assert lasting_start_s(tmp_path, 0, 180.0, 600.0) == 180.0
    (tmp_path / "follower_1.start").write_text("damaged")
    assert lasting_start_s(tmp_path, 1, 780.0, 600.0) == 780.0
    assert lasting_start_s(tmp_path, 1, 840.0, 600.0) == 780.0
    assert lasting_start_s(tmp_path / "nowhere", 1, 60.0, 600.0) == 60.0


def test_a_vehicle_started_again_with_its_store_sails_the_same_mission(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    starts_s: list[float] = []

    def told(start_utc_s: float, _: float) -> None:
        starts_s.append(start_utc_s)
        raise ConfigError("enough")

    monkeypatch.setattr(vehicle_process, "open_modem", lambda *_: None)
    monkeypatch.setattr(vehicle_process, "WallClock", told)
    for minute_s in (60.0, 120.0):
        monkeypatch.setattr(vehicle_process, "start_time_s", lambda _, at_s=minute_s: at_s)
        assert main(["follower", "--modem", "serial:///x", "--store", str(tmp_path / "s")]) == 2
    assert starts_s == [60.0, 60.0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "profile",
    [
        ["paper"],
        ["dense"],
        ["lattice"],
        ["lattice", "--set", "follower.compression.small_frames=1"],
    ],
    ids=["paper-encrypted", "dense", "lattice", "lattice-small"],
)
def test_two_processes_with_a_key_map_together_in_every_profile(
    tmp_path: Path, profile: list[str]
) -> None:
    out, ports, key = tmp_path / "out", tmp_path / "p", tmp_path / "key"
    key.write_text("5a" * 32)
    key.chmod(0o600)
    minutes = ["--set", "duration_min=5", "--set", "follower_duration_min=5"]
    mission = ["--profile", *profile, "--out", str(out), "--seed", "5", *minutes]
    program = [sys.executable, "-m", "host_tools.cli"]
    channel = subprocess.Popen(
        [*program, "channel", "--no-report", "--ports", str(ports), *mission],
        stdout=subprocess.DEVNULL,
    )

    def vehicle(name: str, port: str) -> "subprocess.Popen[bytes]":
        at = ["--modem", f"serial://{ports}/{port}", "--clock", f"unix://{ports}/clock"]
        sealed = ["--key", str(key), "--store", str(tmp_path / name)]
        sealed += ["--encrypt"] if profile == ["paper"] else []
        return subprocess.Popen([*program, name, *at, *sealed, *mission])

    while not (ports / "follower-1").exists():
        time.sleep(0.05)
    crew = [vehicle("leader", "leader"), vehicle("follower", "follower-1")]
    assert [process.wait(timeout=120) for process in (channel, *crew)] == [0, 0, 0]
    frames = [json.loads(line) for line in (out / "air.jsonl").read_text().splitlines()]
    sent = [decode(bytes.fromhex(f["hex"])) for f in frames if f["fate"] == "delivered"]
    assert len(sent) > 40
    assert all(isinstance(packet, SealedFrame) for packet in sent)
    leader = json.loads((out / "processes" / "leader.json").read_text())
    came = leader["reassembly_complete"] + leader["reassembly_partial"]
    assert came >= 2
    unbuilt = leader.get("submaps_empty", 0) + leader.get("submaps_not_rebuilt", 0)
    hardly_fits = "follower.compression.small_frames=1" in profile  # beside a track that bends
    assert unbuilt <= (came - 1 if hardly_fits else 0)


@pytest.mark.slow
def test_a_follower_killed_in_mid_mission_is_waited_for_and_the_mission_goes_on(
    tmp_path: Path,
) -> None:
    out, clock = tmp_path / "out", f"unix://{tmp_path / 'p' / 'clock'}"
    channel = subprocess.Popen(
        fathomlink("channel", "--no-report", "--ports", str(tmp_path / "p"), "--out", str(out)),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )

    def vehicle(*name: str) -> "subprocess.Popen[bytes]":
        port = tmp_path / "p" / ("leader" if name == ("leader",) else "follower-1")
        return subprocess.Popen(
            fathomlink(*name, "--modem", f"serial://{port}", "--clock", clock, "--out", str(out))
        )

    while not (tmp_path / "p" / "follower-1").exists():
        time.sleep(0.05)
    leader, follower = vehicle("leader"), vehicle("follower")
    beliefs = out / "processes" / "follower_1.beliefs"
    while not (beliefs.exists() and beliefs.stat().st_size > 50 * 80):
        time.sleep(0.001)
    os.kill(follower.pid, signal.SIGKILL)
    follower.wait()
    follower = vehicle("follower")
    said, errors = channel.communicate(timeout=120)
    assert (leader.wait(), follower.wait(), channel.returncode) == (0, 0, 0)
    assert "waiting for follower_1" in errors
    assert "follower_1" in said
    assert beliefs.stat().st_size >= 151 * 80
