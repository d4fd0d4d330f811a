"""Real processes, really killed: SIGKILL at instants that nobody chose."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from host_tools.cli import main

SHORT = ["--seed", "5", "--set", "duration_min=2.5", "--set", "beams=32"]
SHORT += ["--set", "follower_duration_min=2", "--set", "leg_m=60"]
KILLS = 6


def fathomlink(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "host_tools.cli", *arguments, *SHORT]


class Ship:
    """The processes of a mission with stores."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.out = folder, folder / "out"
        ports = folder / "p"
        self.channel = subprocess.Popen(
            fathomlink("channel", "--no-report", "--ports", str(ports), "--out", str(self.out)),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        while not (ports / "follower-1").exists():
            time.sleep(0.05)
        self.names = {"leader": "leader", "follower": "follower-1"}
        self.vehicles = {name: self.start(name) for name in self.names}

    def start(self, name: str) -> "subprocess.Popen[bytes]":
        ports = self.folder / "p"
        modem, clock = f"serial://{ports / self.names[name]}", f"unix://{ports / 'clock'}"
        more = ["--out", str(self.out), "--store", str(self.folder / "store")]
        return subprocess.Popen(fathomlink(name, "--modem", modem, "--clock", clock, *more))

    def seconds(self, name: str) -> int:
        path = self.out / "processes" / f"{self.names[name].replace('-', '_')}.beliefs"
        return path.stat().st_size // 80 if path.exists() else 0

    def kill(self, name: str) -> None:
        os.kill(self.vehicles[name].pid, signal.SIGKILL)
        self.vehicles[name].wait()
        self.vehicles[name] = self.start(name)

    def arrive(self) -> None:
        assert self.channel.wait(timeout=200) == 0
        for process in self.vehicles.values():
            assert process.wait(timeout=20) == 0


def undisturbed(folder: Path) -> Path:
    ship = Ship(folder)
    ship.arrive()
    return ship.out


def killed(folder: Path) -> Path:
    ship = Ship(folder)
    for k in range(KILLS):
        name = ("leader", "follower")[k % 2]
        goal = ship.seconds(name) + 15
        while ship.seconds(name) < goal:
            time.sleep(0.0007 * (k + 1))
        ship.kill(name)
    ship.arrive()
    return ship.out


@pytest.mark.slow
def test_killed_processes_come_to_the_same_end_as_undisturbed_ones(tmp_path: Path) -> None:
    one, other = undisturbed(tmp_path / "one"), killed(tmp_path / "other")
    summary = json.loads((other / "summary.json").read_text())
    resumed = sum(summary["counters"][name]["store_resumed"] for name in ("leader", "follower_1"))
    assert resumed == 2
    assert (one / "air.jsonl").read_bytes() == (other / "air.jsonl").read_bytes()
    for name in ("leader_final", "follower_1_final", "leader_live", "follower_1_live"):
        ends = [np.loadtxt(folder / f"{name}.tum")[:, 1:3] for folder in (one, other)]
        assert np.abs(ends[0] - ends[1]).max() < 1e-3
    assert (one / "leader_final.tum").read_bytes() == (other / "leader_final.tum").read_bytes()


def test_store_that_cannot_be_made_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    arguments = ["leader", "--modem", "serial:///dev/ptmx", "--start", "1970-01-01T00:00:00Z"]
    status = main([*arguments, "--store", str(tmp_path / "file"), *SHORT])
    error = capsys.readouterr().err
    assert status == 2
    assert "give a folder of yours" in error
    assert error.strip().splitlines()[-1].startswith("fathomlink: --store")
