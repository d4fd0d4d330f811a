"""Vehicles on modems that load a packet before it starts: the core is asked a lead before."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from firmware.dead_reckoning import ReckonedState
from firmware.follower.core import FollowerCore
from firmware.follower.settings import FollowerSettings
from firmware.ports import ModemPort
from firmware.soundings import Odometry
from host_tools.cli import main
from host_tools.inspector import inspect_file
from host_tools.processes.emulated_modems import _each_frame
from host_tools.writers import link_counts
from protocol.acoustics import Delivery, Water, WaterSettings
from protocol.codec import decode
from protocol.modems.loopback import LoopbackMedium
from protocol.schedule import Slots, SlotSettings

START = ReckonedState(time_s=0.0, north_m=0.0, east_m=0.0, yaw_rad=0.0, depth_m=0.0)


class Loading:
    """A loopback modem that says it must be given frames in pairs, 1.7 s before."""

    def __init__(self) -> None:
        still = Water(WaterSettings(), np.random.default_rng(1), lambda *_: (0.0, 0.0, 0.0))
        self.inner = LoopbackMedium(still).modem(1)
        self.inner.lead_s, self.inner.frames_per_packet = 1.7, 2
        self.sent: list[tuple[float, float | None]] = []
        self.inner.send = self.send  # type: ignore[method-assign]

    def send(self, frame: bytes, now_s: float, start_s: float | None = None) -> None:
        assert frame == b"frame"
        self.sent.append((now_s, start_s))


def test_a_core_is_asked_for_a_pair_by_the_last_period_that_is_early_enough() -> None:
    modem, asked = Loading(), list[float]()

    def poll(start_s: float) -> bytes | None:
        asked.append(start_s)
        return b"frame" if start_s % 8.0 == 0.0 else None

    port = ModemPort(modem.inner, period_s=0.25)
    for k in range(4 * 17):
        port.speak(poll, k * 0.25)
    assert modem.sent == [(6.25, 8.0), (6.25, 8.0), (14.25, 16.0), (14.25, 16.0)]
    assert [second for second in asked if second % 8.0] == [
        float(second) for second in range(2, 19) if second % 8
    ]


def test_a_follower_has_as_many_frames_for_a_slot_as_it_holds() -> None:
    slots = Slots(SlotSettings(follower_slot_s=8, frames_per_slot=2))
    assert slots.frames_per_submap(40.0) == 10
    core = FollowerCore(1, 0, START, settings=FollowerSettings(), slots=slots)
    for k in range(4 * 96):
        core.receive_odometry(
            Odometry(
                time_s=k * 0.25,
                velocity_north_mps=1.0,
                velocity_east_mps=0.0,
                yaw_rad=0.0,
                depth_m=0.0,
            )
        )
    frames = [[core.poll(now_s) for _ in range(3)] for now_s in (80.0, 84.0, 88.0, 96.5, 104.0)]
    counts = [sum(frame is not None for frame in three) for three in frames]
    assert counts == [2, 0, 2, 0, 2]
    assert core.status()["slots_missed"] == 1
    headers = [decode(frame).header for three in frames for frame in three if frame is not None]
    assert [header.tx_second for header in headers] == [0, 0, 8, 8, 8, 8]


PACKET = Delivery(
    source=1,
    destination=0,
    t_tx_s=8.0,
    t_rx_s=8.2,
    t_delivered_s=11.0,
    frame=b"",
    fate="delivered",
)


def test_a_packet_of_two_frames_is_recorded_as_both_and_as_they_were_sent() -> None:
    sent, heard = bytes([1]) * 256 + bytes([2]) * 256, bytes([1]) * 256 + bytes([3]) * 256
    packet = replace(PACKET, frame=heard, fate="corrupt", sent=sent)
    recorded: list[Delivery] = []
    _each_frame(packet, 0, recorded.append)
    assert [(d.frame, d.sent) for d in recorded] == [
        (heard[:256], sent[:256]),
        (heard[256:], sent[256:]),
    ]
    assert link_counts(recorded)["bytes_on_air"] == 512


def test_a_packet_is_recorded_without_its_drivers_envelope() -> None:
    packet = replace(PACKET, frame=b"\x01\x07" + bytes(22))
    recorded: list[Delivery] = []
    _each_frame(packet, 2, recorded.append)
    assert [(d.frame, d.sent) for d in recorded] == [(bytes(22), bytes(22))]


@pytest.mark.slow
def test_a_mission_on_emulated_micromodems_at_rate_4(tmp_path: Path) -> None:
    short = ["duration_min=7", "follower_duration_min=7", "leg_m=100", "beams=32"]
    arguments = [part for change in short for part in ("--set", change)]
    for name in ("one", "two"):
        assert (
            main(["demo", "--modems", "micromodem", "--out", str(tmp_path / name), *arguments]) == 0
        )
    air = (tmp_path / "one" / "air.jsonl").read_text()
    assert air == (tmp_path / "two" / "air.jsonl").read_text()
    frames = [json.loads(line) for line in air.splitlines()]
    ours = [frame for frame in frames if frame["source"] == 1 and len(frame["hex"]) == 512]
    starts = [frame["t_tx_s"] for frame in ours]
    assert len(ours) >= 30
    assert starts[::2] == starts[1::2]
    told = [decode(bytes.fromhex(f["hex"])).header.tx_second for f in ours if f["fate"] != "lost"]
    assert told == [f["t_tx_s"] % 16.0 for f in ours if f["fate"] != "lost"]
    assert sum(start % 8.0 == 0.0 for start in starts) >= 0.9 * len(starts)  # or a second later
    assert {f["fate"] for f in ours[::2]} >= {"delivered", "lost"}
    assert [f["fate"] for f in ours[::2]] == [f["fate"] for f in ours[1::2]]
    leader = json.loads((tmp_path / "one" / "processes" / "leader.json").read_text())
    assert leader["ranges_used"] >= 10


@pytest.mark.slow
def test_a_mission_of_small_lattice_frames_on_emulated_nanomodems(tmp_path: Path) -> None:
    short = ["duration_min=6", "follower_duration_min=6", "leg_m=200", "beams=64"]
    arguments = [part for change in short for part in ("--set", change)]
    run = ["demo", "--modems", "nanomodem", "--profile", "lattice", "--out", str(tmp_path)]
    assert main([*run, *arguments]) == 0
    frames = [json.loads(line) for line in (tmp_path / "air.jsonl").read_text().splitlines()]
    ours = [frame for frame in frames if frame["source"] == 1]
    assert len(ours) >= 60
    assert {len(frame["hex"]) for frame in ours} == {2 * 62}
    assert not any("dropped" in line for line in inspect_file(tmp_path / "air.jsonl"))
    leader = json.loads((tmp_path / "processes" / "leader.json").read_text())
    assert leader.get("submaps_not_rebuilt", 0) <= 1  # the last one may be cut
    follower = json.loads((tmp_path / "processes" / "follower_1.json").read_text())
    assert follower["answers_used"] + follower["answers_without_news"] >= 10
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["closures"]["active"]["number"] >= 5


@pytest.mark.parametrize("command", ["demo", "channel"])
def test_nanomodems_refuse_the_papers_frames_in_one_line(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = [command, "--modems", "nanomodem", "--profile", "paper", "--set", "duration_min=1"]
    run += ["--out", str(tmp_path)]
    assert main(run) == 2
    error = capsys.readouterr().err
    assert "profile paper has frames of 256 bytes, this modem carries 62; take profile" in error
    assert error.count("\n") == 1
