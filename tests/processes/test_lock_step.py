"""The channel's end and a vehicle's end over real ptys, the vehicle in a thread."""

import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from firmware.ports import ModemPort
from host_tools.emulators.ptys import PseudoPort
from host_tools.mission import run
from host_tools.processes.control import Advance, ControlLine, Done
from host_tools.processes.pace import Pace
from host_tools.processes.process_group import ProcessGroup
from host_tools.processes.remote_node import MOST_TRIES, RemoteNode
from host_tools.processes.served_clock import ServedClock, StampedModem
from protocol.acoustics import Delivery, Water, WaterSettings
from protocol.crc import crc32c
from protocol.errors import ConfigError, ModemUnavailable
from protocol.framing import wrap
from protocol.modems.base import Reception
from protocol.modems.loopback import LoopbackMedium
from protocol.modems.registry import open_modem
from protocol.modems.serial_line import DEFAULT_BAUD

TICK_S = 0.25
QUIET = WaterSettings(loss=0.0, outlier_share=0.0)


@dataclass
class Talker:
    """A vehicle that transmits its number and the time in its slot, and keeps what it hears."""

    vehicle: int
    group: ProcessGroup
    mission: str = "m"
    stop_at_s: float = float("inf")
    modem_of: int | None = None
    heard: list[Reception] = field(default_factory=list)
    sent: list[bytes] = field(default_factory=list)
    error: Exception | None = None

    def start(self) -> threading.Thread:
        thread = threading.Thread(target=self.run, daemon=True)
        thread.start()
        return thread

    def run(self) -> None:
        port = self.vehicle if self.modem_of is None else self.modem_of
        modem = StampedModem(open_modem(self.group.modem_url(port)))
        clock = ServedClock(self.group.clock_url, self.vehicle, self.mission, modem)
        try:
            for now_s in clock.ticks(TICK_S):
                if now_s >= self.stop_at_s:  # as a killed process: no answer, all lines cut
                    return
                self.step(now_s, modem)
            clock.end()
        except (ConfigError, ModemUnavailable) as error:
            self.error = error
        finally:
            clock.close()
            modem.close()

    def step(self, now_s: float, modem: StampedModem) -> None:
        modem.poll(now_s)
        while (event := modem.next_event()) is not None:
            if isinstance(event, Reception):
                self.heard.append(event)
        if now_s % 4.0 == 2.0 * self.vehicle and modem.status().is_up:
            frame = bytes([self.vehicle, int(now_s) + 1]) * 8
            self.sent.append(frame)
            modem.send(frame, now_s)
        modem.poll(now_s)


def water(settings: WaterSettings = QUIET) -> Water:
    return Water(settings, np.random.default_rng(1), lambda node, _: (300.0 * node, 0.0, 10.0))


@pytest.fixture
def group(tmp_path: Path) -> Iterator[ProcessGroup]:
    made = water()
    with ProcessGroup(made, "m", on_wait=lambda _: None, folder=tmp_path / "ports") as group:
        yield group


def sail(
    group: ProcessGroup, duration_s: float = 30.0, at: Callable[[float], None] = lambda _: None
) -> list[Delivery]:
    deliveries: list[Delivery] = []
    group.wait_for_all()
    run(
        group.nodes,
        group.water,
        duration_s=duration_s,
        tick_s=TICK_S,
        record=deliveries.append,
        progress=at,
    )
    group.end()
    return [delivery for delivery in deliveries if delivery.t_delivered_s <= duration_s]


def heard_frames(talker: Talker) -> list[bytes]:
    return [reception.frame for reception in talker.heard]


def test_frames_and_times_of_arrival_cross_the_ports_unchanged(group: ProcessGroup) -> None:
    talkers = [Talker(vehicle, group) for vehicle in (0, 1)]
    threads = [talker.start() for talker in talkers]
    deliveries = sail(group)
    for thread in threads:
        thread.join()
    for talker in talkers:
        expected = [
            (d.frame, d.t_rx_s, d.t_delivered_s)
            for d in deliveries
            if d.destination == talker.vehicle and d.was_received
        ]
        assert [(r.frame, r.toa_s, r.heard_s) for r in talker.heard] == expected
        assert len(expected) >= 7


def test_garbage_half_frames_and_foreign_traffic_cost_nothing_but_counts(
    group: ProcessGroup,
) -> None:
    talkers = [Talker(vehicle, group) for vehicle in (0, 1)]
    threads = [talker.start() for talker in talkers]
    noise = bytes(range(1, 200)) + wrap(b"not from this water") + wrap(b"half a frame")[:6]

    def disturb(now_s: float) -> None:
        if now_s % 3.0 == 0.25:
            group.nodes[1].port.write(noise)

    deliveries = sail(group, at=disturb)
    for thread in threads:
        thread.join()
    water_frames = [d.frame for d in deliveries if d.destination == 1]
    ours = [r for r in talkers[1].heard if r.toa_s is not None]
    assert [r.frame for r in ours] == water_frames
    foreign = [r for r in talkers[1].heard if r.toa_s is None]
    assert {r.frame for r in foreign} >= {b"not from this water"}
    assert heard_frames(talkers[0]) == [d.frame for d in deliveries if d.destination == 0]


def test_a_port_that_vanishes_and_comes_back_loses_no_arrival(group: ProcessGroup) -> None:
    talkers = [Talker(vehicle, group) for vehicle in (0, 1)]
    threads = [talker.start() for talker in talkers]

    def pull(now_s: float) -> None:
        if now_s == 9.0:
            group.nodes[1].port.unplug()
        if now_s == 17.0:
            group.nodes[1].port.plug()

    deliveries = sail(group, duration_s=40.0, at=pull)
    for thread in threads:
        thread.join()
    assert heard_frames(talkers[1]) == [d.frame for d in deliveries if d.destination == 1]
    assert heard_frames(talkers[0]) == talkers[1].sent
    late = [r for r in talkers[1].heard if r.toa_s is not None and 9.0 < r.heard_s < 17.0]
    assert len(late) == 2
    assert all(abs((r.toa_s or 0.0) - r.heard_s) < 1.0 for r in late)


def test_a_process_that_is_killed_is_waited_for_and_loses_nothing(tmp_path: Path) -> None:
    with ProcessGroup(water(), "m", on_wait=lambda _: None, folder=tmp_path) as group:
        leader = Talker(0, group)
        first = Talker(1, group, stop_at_s=12.75)
        threads = [leader.start(), first.start()]
        second = Talker(1, group)

        def restart(missing: Sequence[RemoteNode]) -> None:
            if missing and missing[0].now_s > 0.0 and len(threads) == 2:
                assert missing[0].now_s == 12.75
                threads[1].join()  # until then its port is taken
                threads.append(second.start())

        group.on_wait = restart
        deliveries = sail(group)
        for thread in threads:
            thread.join()
    assert len(threads) == 3
    both = heard_frames(first) + heard_frames(second)
    assert both == [d.frame for d in deliveries if d.destination == 1]
    assert [d.t_tx_s for d in deliveries if d.source == 1] == [2.0 + 4.0 * k for k in range(7)]


def test_an_arrival_that_the_line_never_hands_over_is_given_up(
    group: ProcessGroup, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("host_tools.processes.served_clock.HANDOVER_S", 0.0)
    monkeypatch.setattr(group.nodes[1].port, "write", lambda _: None)
    talkers = [Talker(vehicle, group) for vehicle in (0, 1)]
    threads = [talker.start() for talker in talkers]
    sail(group, duration_s=11.0)
    for thread in threads:
        thread.join()
    status = group.nodes[1].status()
    assert talkers[1].heard == []
    assert status["arrivals_lost_on_line"] == len(talkers[0].sent)
    assert status["arrivals_repeated"] == (MOST_TRIES - 1) * len(talkers[0].sent)


@pytest.mark.parametrize(
    ("vehicle", "mission", "message"),
    [
        (3, "m", "vehicle 3 is not in this mission; its vehicles are 0, 1"),
        (1, "other", "follower_1 was started for another mission than the channel; give both"),
        (0, "m", "leader is already here"),
    ],
)
def test_a_process_that_does_not_belong_is_told_why(
    vehicle: int, mission: str, message: str, group: ProcessGroup
) -> None:
    leader = Talker(0, group)
    threads = [leader.start()]
    while group.nodes[0].line is None:
        group.look()
    stranger = Talker(vehicle, group, mission, modem_of=1)
    threads.append(stranger.start())
    while threads[1].is_alive():
        group.look()
    assert message in str(stranger.error)
    group.close()
    threads[0].join()
    assert "has gone; start all again" in str(leader.error)


def test_a_hello_that_is_none_costs_only_its_sender_the_line(group: ProcessGroup) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as stranger:
        stranger.connect(group.clock_url.removeprefix("unix://"))
        stranger.sendall(b'{"is":"hello","vehicle":[1],"mission":"m"}\n')
        for _ in range(3):
            group.look()
        stranger.settimeout(5.0)
        assert stranger.recv(100) == b""
    assert len(group.missing()) == 2


def test_a_clock_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    modem = StampedModem(LoopbackMedium(water()).modem(0))
    with pytest.raises(ModemUnavailable, match="start fathomlink channel first"):
        ServedClock(f"unix://{tmp_path}/clock", 0, "m", modem)
    with pytest.raises(ConfigError, match="give wall, or the unix:// name"):
        ServedClock("clock", 0, "m", modem)


class FastPace(Pace):
    """Real time, a thousand times as fast."""

    def is_over(self, now_s: float) -> bool:
        return super().is_over(now_s / 1000.0)


def test_in_real_time_a_process_that_is_down_is_not_waited_for(tmp_path: Path) -> None:
    pace = FastPace(TICK_S / 1000.0)
    with ProcessGroup(water(), "m", on_wait=lambda _: None, folder=tmp_path, pace=pace) as group:
        leader, follower = Talker(0, group), Talker(1, group, stop_at_s=5.0)
        threads = [leader.start(), follower.start()]
        group.wait_for_all()
        pace.start()
        deliveries: list[Delivery] = []
        run(
            group.nodes,
            group.water,
            duration_s=20.0,
            tick_s=TICK_S,
            record=deliveries.append,
        )
        group.end()
        missed = group.nodes[1].status()["periods_missed"]
        for thread in threads:
            thread.join()
    assert missed >= 55
    assert leader.error is None


def test_in_real_time_a_process_that_comes_back_is_told_the_time_that_it_is() -> None:
    port = PseudoPort(DEFAULT_BAUD)
    node = RemoteNode(1, port, lambda _: None, lambda _: None, lambda: True)
    (first, dead), (again, theirs) = (map(ControlLine, socket.socketpair()) for _ in range(2))
    node.join(first)
    node.begin(1.0)
    node.leave()
    dead.close()
    for now_s in (1.25, 61.25):
        node.begin(now_s)
    node.join(again)
    assert theirs.receive() == [Advance(now_s=61.25)]
    node.answer(Done(now_s=61.25))
    assert node.is_answered
    node.leave()
    theirs.close()
    port.close()


def test_a_frame_that_the_line_dropped_is_not_mistaken_for_the_next(tmp_path: Path) -> None:
    port = PseudoPort(DEFAULT_BAUD, tmp_path / "modem")
    modem = StampedModem(open_modem(f"serial://{port.name}"))
    port.unplug()
    modem.poll(0.0)
    modem.send(b"late", 1.0, 1.0)
    port.plug()
    modem.poll(3.0)
    modem.send(b"in time", 4.0, 4.0)
    assert modem.frames_written() == (crc32c(b"late"), crc32c(b"in time"))
    modem.close()
    port.close()


def test_in_real_time_a_frame_of_a_period_that_is_over_is_not_transmitted() -> None:
    port = PseudoPort(DEFAULT_BAUD)
    node = RemoteNode(1, port, lambda _: None, lambda _: None, lambda: True)
    ours, theirs = map(ControlLine, socket.socketpair())
    node.join(ours)
    modem, sent = StampedModem(open_modem(f"serial://{port.name}")), []
    for now_s, answered_s in ((2.0, 2.0), (4.0, 4.25)):
        node.begin(now_s)
        modem.send(b"stamped with its second", now_s)
        if answered_s > now_s:
            node.begin(answered_s)
        node.answer(Done(now_s=now_s, frames=modem.frames_written()))
        sent.append(node.tick(answered_s))
    assert sent == [b"stamped with its second", None]
    assert node.status()["frames_late"] == 1
    node.leave()
    theirs.close()
    modem.close()
    port.close()


@pytest.mark.skipif(shutil.which("socat") is None, reason="apt-get install socat")
def test_frames_cross_a_pair_of_ports_made_by_socat(tmp_path: Path) -> None:
    names = [tmp_path / "a", tmp_path / "b"]
    pair = subprocess.Popen(["socat", *(f"pty,raw,echo=0,link={name}" for name in names)])
    try:
        end_s = time.monotonic() + 10.0
        while not all(name.exists() for name in names) and time.monotonic() < end_s:
            time.sleep(0.005)
        ends = [ModemPort(open_modem(f"serial://{name}")) for name in names]
        heard: list[list[bytes]] = [[], []]
        for k in range(1, 11):
            ends[k % 2].speak(lambda _, k=k: bytes([k]) * 256, float(k))  # type: ignore[misc]
        while len(heard[0]) + len(heard[1]) < 10 and time.monotonic() < end_s:
            for end, frames in zip(ends, heard, strict=True):
                end.hear(lambda r, frames=frames: frames.append(r.frame), 11.0)  # type: ignore[misc]
    finally:
        pair.terminate()
        pair.wait()
    assert heard == [[bytes([k]) * 256 for k in range(first, 11, 2)] for first in (1, 2)]
