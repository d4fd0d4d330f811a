import dataclasses
from pathlib import Path

import pytest

from host_tools.cli import main
from host_tools.reproduce import Outcome, check_sites, simulation_lines
from protocol.errors import ConfigError
from tests.host_tools.test_terrain_placement import slope, write_raster


def outcome(seed: int, live_m: float) -> Outcome:
    return Outcome(
        scenario="paper-1",
        baseline="none",
        seed=seed,
        leader_live_m=live_m,
        leader_share=live_m / 100,
        follower_live_m=2 * live_m,
        follower_share=live_m / 50,
        leader_end_m=1.0,
        follower_end_m=2.0,
        map_mean_m=0.1,
        map_median_m=0.05,
        map_under_1m=0.99,
        active_closures=60,
        valid_share=1.0,
    )


def test_table_gives_the_median_the_worst_seed_and_the_papers_figure() -> None:
    lines = simulation_lines([outcome(1, 8.0), outcome(2, 7.0), outcome(3, 12.0)])
    leader = next(line for line in lines if "leader" in line)
    assert "8.00 m (worst 12.00 m)" in leader
    assert "8.0% (worst 12.0%)" in leader
    assert "19.76 m, 18.0%" in leader
    assert any("60 active closures" in line for line in lines)


def test_scenarios_without_runs_are_left_out() -> None:
    lines = simulation_lines([dataclasses.replace(outcome(1, 8.0), scenario="paper-2")])
    assert not any(line.startswith("paper-1") for line in lines)


def test_bad_counts_are_one_line_and_status_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["reproduce", "--seeds", "0", "--out", str(tmp_path)])
    assert stopped.value.code == 2
    assert "argument --seeds: 0 is none; give 1 or more" in capsys.readouterr().err


def test_terrain_too_small_for_a_simulation_is_told_before_the_first(tmp_path: Path) -> None:
    path = write_raster(tmp_path / "small.tif", slope()[:100, :100])
    with pytest.raises(ConfigError, match="needs"):
        check_sites(path, [1])
