import json
from pathlib import Path

import numpy as np
import pytest

from host_tools.cli import main

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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--terrain", "nowhere.tif"], "terrain nowhere.tif is not a file"),
        (["--terrain", __file__], "cannot be read as a raster"),
        (["--scenario", "paper-3"], "choose one of"),
        (["--set", "leg_m=9000", "--set", "duration_min=90"], "shorten it"),
        (["--out", "/dev/null/out"], "cannot write to --out"),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert simulate(tmp_path / "out", *arguments) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.count("\n") == 1
