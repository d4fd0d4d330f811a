from pathlib import Path

import pytest

from host_tools.cli import main

SHORT = ["--seed", "5", "--set", "duration_min=1.5", "--set", "follower_duration_min=1"]
SHORT += ["--set", "beams=32", "--set", "leg_m=60", "--no-report"]


def test_simulation_leaves_stores_and_takes_none_up(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["simulate", *SHORT, "--out", str(tmp_path / "out"), "--store", str(tmp_path / "s")]
    assert main(arguments) == 0
    assert {path.name for path in (tmp_path / "s").iterdir()} == {
        "leader.epoch",
        "leader.sqlite",
        "follower_1.epoch",
        "follower_1.sqlite",
    }
    assert main(arguments) == 2
    assert "holds the stores of an earlier mission" in capsys.readouterr().err


def test_baselines_have_no_store(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    more = ["--out", str(tmp_path), "--store", str(tmp_path / "s"), "--baseline", "unlimited"]
    assert main(["simulate", *SHORT, *more]) == 2
    assert "--store is for vehicles" in capsys.readouterr().err
