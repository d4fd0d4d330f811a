"""The driver over pseudo-terminals: identification, vanishing ports, logs, refusals."""

import io
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest

from host_tools.emulators.micromodem import MicroModemUnit
from host_tools.emulators.micromodem_firmware import MicroModemQuirks
from host_tools.emulators.nanomodem import NanomodemUnit
from host_tools.emulators.ptys import PseudoPort
from host_tools.emulators.run import EmulationSettings, emulate
from protocol.errors import ConfigError, ModemError, ModemTimeout, ModemUnavailable
from protocol.modems.base import ModemContext
from protocol.modems.dialect_driver import DialectDriver, await_identified, check_frame_size
from protocol.modems.events import FrameHeard
from protocol.modems.micromodem import MicroModem
from protocol.modems.micromodem_settings import MicroModemSettings
from protocol.modems.raw_log import RawLog, read_log, replay
from protocol.modems.registry import open_modem
from tests.modems.pairs import Pair, pair

KINDS = ("micromodem", "nanomodem")


@pytest.mark.parametrize("kind", KINDS)
def test_frames_pass_both_ways_over_ptys_without_socat(kind: str, tmp_path: Path) -> None:
    with pair(kind, tmp_path) as both:
        both.run(12.0)
        assert all(driver.status().is_up for driver in both.drivers)
        both.drivers[0].send(b"to the second", both.now_s)
        both.run(5.0)
        both.drivers[1].send(b"to the first!", both.now_s)
        both.run(5.0)
        assert both.frames(1) == [b"to the second"]
        assert both.frames(0) == [b"to the first!"]
        status = both.drivers[1].status()
        assert (status.sent, status.received, status.queued, status.discarded) == (1, 1, 0, 0)
        assert status.quality is not None


def verdict_of(both: Pair) -> ModemError:
    driver = both.drivers[0]

    def pause(_: float) -> None:
        both.step_water()

    with pytest.raises(ModemError) as error:
        await_identified(driver, lambda: both.now_s, pause)
    assert "\n" not in str(error.value)
    assert both.now_s <= 2.2
    return error.value


@pytest.mark.parametrize(("kind", "other"), [KINDS, KINDS[::-1]])
def test_another_dialect_is_named_within_two_seconds(kind: str, other: str, tmp_path: Path) -> None:
    path = tmp_path / f"{kind}-1"
    baud = 19_200 if kind == "micromodem" else 9_600
    with pair(kind, tmp_path, urls=[f"{other}://{path}?baud={baud}"]) as both:
        assert f"open it as {kind}://{path}" in str(verdict_of(both))


@pytest.mark.parametrize("kind", KINDS)
def test_a_wrong_speed_is_said_so(kind: str, tmp_path: Path) -> None:
    with pair(kind, tmp_path, urls=[f"{kind}://{tmp_path}/{kind}-1?baud=4800"]) as both:
        assert "?baud=" in str(verdict_of(both))


def test_a_silent_port_times_out_with_advice(tmp_path: Path) -> None:
    link = tmp_path / "nobody"
    port = PseudoPort(19_200, link)
    driver = open_modem(f"micromodem://{link}")
    assert isinstance(driver, DialectDriver)
    now = iter(range(10_000))
    with pytest.raises(ModemTimeout, match="check its power and the cable"):
        await_identified(driver, lambda: next(now) * 0.01, lambda _: None)
    driver.close()
    port.close()


def test_identification_returns_once_the_modem_has_answered(tmp_path: Path) -> None:
    with pair("nanomodem", tmp_path) as both:

        def pause(_: float) -> None:
            both.step_water()

        counters = await_identified(both.drivers[0], lambda: both.now_s, pause)
        assert counters["lines"] >= 1
        assert both.now_s < 0.5


@pytest.mark.parametrize(
    ("url", "advice"),
    [
        ("micromodem://", "names no port"),
        ("micromodem:///dev/x?speed=9600", "unknown option .speed.; known are address"),
        ("micromodem:///dev/x?rate=9", "at most 6"),
        ("nanomodem:///dev/x?address=256", "at most 255"),
        ("evologics:///dev/x", "known are .*micromodem://"),
    ],
)
def test_a_bad_url_is_one_line_of_advice(url: str, advice: str) -> None:
    with pytest.raises(ConfigError, match=advice) as error:
        open_modem(url)
    assert "\n" not in str(error.value)


def test_a_missing_port_is_named() -> None:
    with pytest.raises(ModemUnavailable, match="/dev/no-such-port is not there"):
        open_modem("micromodem:///dev/no-such-port")


def test_a_profile_that_does_not_fit_is_refused_before_anything_is_sent(tmp_path: Path) -> None:
    with pair("nanomodem", tmp_path) as both:
        largest = both.drivers[0].largest_frame_bytes
        check_frame_size(largest, 62, "lattice")
        with pytest.raises(ConfigError, match="take profile lattice in its 62-byte size"):
            check_frame_size(largest, 256, "paper")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("after_s", [0.1, 0.7, 2.0])
def test_port_pulled_and_back_loses_nothing_queued(
    kind: str, after_s: float, tmp_path: Path
) -> None:
    with pair(kind, tmp_path) as both:
        both.run(10.0)
        frames = [bytes([n]) * 60 for n in range(5)]
        for frame in frames:
            both.drivers[0].send(frame, both.now_s)
        both.run(after_s)
        port = both.emulation.ports[1]
        port.unplug()
        both.run(3.0)
        assert not both.drivers[0].status().is_up
        port.plug()
        both.run(60.0)
        assert set(both.frames(1)) == set(frames)
        assert both.drivers[0].status().queued == 0
        assert both.drivers[0].status().reopened == 1
        assert any("has gone" in text for text in both.notices(0))
        assert any("is back" in text for text in both.notices(0))


def set_back(driver: DialectDriver, step_s: float) -> None:
    """From now on poll a driver by a clock that is behind."""
    poll = driver.poll
    driver.poll = lambda now_s: poll(now_s - step_s)  # type: ignore[method-assign]


@pytest.mark.parametrize("kind", KINDS)
def test_a_clock_set_back_keeps_no_frame_waiting(kind: str, tmp_path: Path) -> None:
    with pair(kind, tmp_path) as both:
        both.run(60.0)
        frames = [bytes([n]) * 60 for n in range(4)]
        for frame in frames[:3]:
            both.drivers[0].send(frame, both.now_s, both.now_s + 1.0)
        both.run(1.5)
        set_back(both.drivers[0], 50.0)
        both.run(8.0)
        both.drivers[0].send(frames[3], both.now_s - 50.0)
        both.run(22.0)
        assert set(both.frames(1)) == set(frames)
        assert both.drivers[0].status().queued == 0


@pytest.mark.parametrize("kind", KINDS)
def test_a_clock_set_back_keeps_no_port_closed(kind: str, tmp_path: Path) -> None:
    with pair(kind, tmp_path) as both:
        both.run(60.0)
        both.emulation.ports[1].unplug()
        both.run(2.0)
        set_back(both.drivers[0], 50.0)
        both.emulation.ports[1].plug()
        both.run(1.0)
        assert both.drivers[0].status().reopened == 1


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_port_pulled_and_modem_power_cycled_a_hundred_times(kind: str, tmp_path: Path) -> None:
    with pair(kind, tmp_path) as both:
        both.run(10.0)
        sent: list[bytes] = []
        for turn in range(100):
            sent += [(2 * turn + k).to_bytes(2, "big") * 30 for k in range(2)]
            for frame in sent[-2:]:
                both.drivers[0].send(frame, both.now_s)
            both.run(0.1 + (turn % 17) * 0.3)
            if turn % 2:
                both.emulation.bench.units[1].power_cycle(both.now_s)
            else:
                both.emulation.ports[1].unplug()
                both.run(0.2 + (turn % 5) * 0.5)
                both.emulation.ports[1].plug()
            both.run(25.0)
        both.run(60.0)
        missing = set(sent) - set(both.frames(1))
        assert missing == set()
        assert both.drivers[0].status().queued == 0
        assert both.drivers[0].status().dropped_out == 0
        assert both.drivers[0].status().reopened == 50


@pytest.mark.parametrize("step_s", [0.02, 0.25])
def test_a_raw_log_replays_to_the_same_words_and_events(step_s: float, tmp_path: Path) -> None:
    file = io.StringIO()
    units = {n: MicroModemUnit(n, MicroModemQuirks(forgets_settings=True)) for n in (1, 2)}
    tap = RawLog(file)
    with pair("micromodem", tmp_path, tap=tap, units=dict(units), step_s=step_s) as both:
        both.run(10.0)
        for n in range(4):
            both.drivers[0].send(bytes([n]) * 200, both.now_s)
        both.run(2.0)
        units[1].power_cycle(both.now_s)
        both.run(40.0)
        both.drivers[1].send(b"hello", both.now_s)
        both.run(10.0)
        heard = both.frames(0)
        status = dict(both.drivers[0].status().errors)
    core = MicroModem(MicroModemSettings(address=1))
    events, said, recorded = replay(read_log(io.StringIO(file.getvalue())), core)
    assert said == recorded
    assert [e.frame for e in events if isinstance(e, FrameHeard)] == heard == [b"hello"]
    assert core.status() == status


def test_a_raw_log_on_a_full_disk_costs_no_frame(tmp_path: Path) -> None:
    log = RawLog(MagicMock(flush=MagicMock(side_effect=OSError("No space left on device"))))
    with pair("nanomodem", tmp_path, tap=log) as both:
        both.run(12.0)
        both.drivers[0].send(b"out", both.now_s)
        both.drivers[1].send(b"in", both.now_s + 3.0)
        both.run(8.0)
        assert (both.frames(0), both.frames(1)) == ([b"in"], [b"out"])
        assert both.drivers[0].status().queued == 0
    assert log.unwritten > 0


class SmallDisk(io.RawIOBase):
    """A file that takes nothing while it is full."""

    def __init__(self) -> None:
        self.is_full, self.data = False, b""

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        if self.is_full:
            raise OSError("No space left on device")
        self.data += bytes(data)
        return len(data)


def test_a_raw_log_ends_where_a_disk_was_full_and_so_replays_as_it_was() -> None:
    disk = SmallDisk()
    file = io.TextIOWrapper(io.BufferedWriter(disk))
    log = RawLog(file)
    for n in range(300):
        disk.is_full = 100 <= n < 250
        log("in", bytes([n % 256]) * 40, float(n))
    file.close()
    times_s = [line.t_s for line in read_log(io.StringIO(disk.data.decode()))]
    assert times_s == [float(n) for n in range(len(times_s))]
    assert len(times_s) >= 100
    assert log.unwritten == 200


def test_a_raw_log_cut_by_a_crash_or_damaged_is_read_or_named() -> None:
    whole = '{"t": 1.0, "way": "in", "hex": "00"}\n'
    assert len(list(read_log([whole, whole[:20]]))) == 1
    with pytest.raises(ConfigError, match="line 1"):
        list(read_log(["nonsense\n"]))
    with pytest.raises(ConfigError, match="way"):
        list(read_log([whole.replace("in", "up")]))


def test_the_emulation_for_others_prints_urls_and_answers_in_real_time(tmp_path: Path) -> None:
    said: list[str] = []
    opened: list[DialectDriver] = []
    begin_s = time.monotonic()

    def should_stop() -> bool:
        if not opened:
            url = said[0].split(": ")[1]
            driver = open_modem(url)
            assert isinstance(driver, DialectDriver)
            opened.append(driver)
        opened[0].poll(time.monotonic())
        return opened[0].core.identified or time.monotonic() > begin_s + 5.0

    settings = EmulationSettings(kind="nanomodem", directory=tmp_path)
    assert emulate(settings, say=said.append, should_stop=should_stop) == 0
    assert opened[0].core.identified
    assert said[1].startswith("node 2: nanomodem://")
    opened[0].close()


@pytest.mark.skipif(shutil.which("socat") is None, reason="socat is missing: apt install socat")
def test_a_driver_works_over_a_socat_pair(tmp_path: Path) -> None:
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    command = ["socat", f"pty,raw,echo=0,link={ours}", f"pty,raw,echo=0,link={theirs}"]
    with subprocess.Popen(command) as process:
        try:
            end_s = time.monotonic() + 5.0
            while not (ours.exists() and theirs.exists()) and time.monotonic() < end_s:
                time.sleep(0.01)
            _answer_over(ours, theirs)
        finally:
            process.terminate()


def _answer_over(ours: Path, theirs: Path) -> None:
    import serial  # noqa: PLC0415

    unit = NanomodemUnit(1)
    driver = open_modem(f"nanomodem://{ours}", ModemContext())
    assert isinstance(driver, DialectDriver)
    with serial.Serial(str(theirs), 9600, timeout=0) as modem_end:
        begin_s = time.monotonic()
        while not driver.core.ready and time.monotonic() < begin_s + 5.0:
            now_s = time.monotonic() - begin_s
            driver.poll(now_s)
            data = modem_end.read(1000)
            if data:
                unit.receive_data(data, now_s)
            unit.run(now_s)
            modem_end.write(unit.poll(now_s))
    assert driver.core.ready
    driver.close()
