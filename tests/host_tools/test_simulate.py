import json
from pathlib import Path

import numpy as np
import pytest

from host_tools.cli import main
from host_tools.mission import run
from host_tools.nodes import BeliefLog
from protocol.acoustics import Delivery, Water, WaterSettings

SHORT = ["--set", "duration_min=2.5", "--set", "follower_duration_min=2", "--set", "beams=48"]


def simulate(folder: Path, *more: str) -> int:
    return main(["simulate", "--seed", "5", "--out", str(folder), *SHORT, *more])


def test_same_seed_writes_the_same_air_byte_for_byte(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert simulate(tmp_path / "a") == 0
    assert simulate(tmp_path / "b", "--no-report") == 0
    first, second = ((tmp_path / name / "air.jsonl").read_bytes() for name in "ab")
    assert first == second
    assert first.count(b"\n") > 20
    assert (tmp_path / "a" / "report.html").is_file()
    assert not (tmp_path / "b" / "report.html").exists()
    assert "leader" in capsys.readouterr().out
    summary = json.loads((tmp_path / "a" / "summary.json").read_text())
    assert summary["seed"] == 5
    assert summary["settings"]["scenario.duration_min"] == 2.5
    for name in ("leader_live", "follower_1_final"):
        rows = np.loadtxt(tmp_path / "a" / f"{name}.tum")
        np.testing.assert_array_equal(rows[:, 0], np.arange(151.0))
        assert np.isfinite(rows).all()


class Talker:
    """A node that transmits the same frame every four seconds."""

    def __init__(self, frame: bytes | None) -> None:
        self.frame, self.log, self.heard = frame, BeliefLog(), 0

    def hear(self, frame: bytes, toa_s: float | None, now_s: float) -> None:  # noqa: ARG002
        self.heard += 1

    def tick(self, now_s: float) -> bytes | None:
        return self.frame if now_s % 4.0 == 0.0 else None


def test_a_frame_under_way_at_the_end_is_recorded_and_heard_by_nobody() -> None:
    water = Water(WaterSettings(loss=0.0), np.random.default_rng(1), lambda *_: (0.0, 0.0, 9.0))
    nodes: dict[int, Talker] = {0: Talker(None), 1: Talker(bytes(256))}
    recorded: list[Delivery] = []
    run(nodes, water, duration_s=9.0, tick_s=0.25, record=recorded.append)
    assert [delivery.t_tx_s for delivery in recorded] == [0.0, 4.0, 8.0]
    assert nodes[0].heard == 2


def test_a_folder_that_is_used_again_tells_of_the_new_mission_only(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "processes").mkdir()
    (tmp_path / "processes" / "leader.json").write_text('{"modem_sent": 12345}')
    for old in ("report.html", "follower_2_final.tum"):
        (tmp_path / old).write_text("old")
    assert simulate(tmp_path, "--no-report", "--set", "leg_m=9000", "--set", "duration_min=90") == 2
    store = tmp_path / "store"
    store.mkdir()
    (store / "leader.sqlite").touch()
    assert simulate(tmp_path, "--no-report", "--store", str(store)) == 2
    assert (tmp_path / "report.html").exists()  # a mission that cannot begin removes nothing
    assert simulate(tmp_path, "--no-report") == 0
    assert not (tmp_path / "report.html").exists()
    assert not (tmp_path / "follower_2_final.tum").exists()
    capsys.readouterr()
    assert main(["link", "status", str(tmp_path)]) == 0
    shown = capsys.readouterr().out
    assert "frames" in shown
    assert "12345" not in shown


def test_a_lowest_altitude_that_decides_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert simulate(tmp_path, "--no-report", "--set", "altitude_m=5") == 0
    said = "altitude_m is 5 m, but the survey is"
    assert said in capsys.readouterr().out
    assert said in json.loads((tmp_path / "summary.json").read_text())["remarks"][0]


@pytest.mark.parametrize("ping_hz", ["0.5", "2.5"])
def test_pings_at_any_rate_leave_answers_and_outputs_on_whole_seconds(
    tmp_path: Path, ping_hz: str
) -> None:
    assert simulate(tmp_path, "--no-report", "--set", f"ping_hz={ping_hz}") == 0
    for name in ("leader_truth", "leader_live", "follower_1_dead_reckoning", "follower_1_final"):
        rows = np.loadtxt(tmp_path / f"{name}.tum")
        np.testing.assert_array_equal(rows[:, 0], np.arange(151.0))
    air = [json.loads(line) for line in (tmp_path / "air.jsonl").read_text().splitlines()]
    assert all(line["t_tx_s"] % 1.0 == 0.0 for line in air)
    assert {line["source"] for line in air} == {0, 1}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--terrain", "nowhere.tif"], "terrain nowhere.tif is not a file"),
        (["--terrain", __file__], "cannot be read as a raster"),
        (["--scenario", "paper-3"], "choose one of"),
        (["--set", "leg_m=9000", "--set", "duration_min=90"], "shorten it"),
        (["--out", "/dev/null/out"], "cannot write to --out"),
        (
            ["--set", "rate_bps=100"],
            "256 bytes sounds for 20.48 s at rate_bps=100, its slot has 4 s; "
            "set rate_bps to 512 or more, or follower_slot_s=",
        ),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert simulate(tmp_path / "out", *arguments) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.count("\n") == 1
