from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

from firmware.journaled import bare
from host_tools import simulate
from host_tools.cli import main
from host_tools.mission import run
from host_tools.nodes import LeaderNode

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


def test_map_is_the_same_with_a_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run_and_shelve(nodes: dict[int, LeaderNode], *rest: Any, **more: Any) -> None:
        run(nodes, *rest, **more)
        atlas = bare(nodes[0].core).atlas
        ids = [sheet.id for sheet in atlas]
        assert ids
        for sheet_id in ids:
            atlas.shelve(sheet_id)

    monkeypatch.setattr(simulate, "run", run_and_shelve)
    maps = []
    for store in ([], ["--store", str(tmp_path / "s")]):
        out = tmp_path / f"out{len(store)}"
        assert main(["simulate", *SHORT, "--out", str(out), *store]) == 0
        with rasterio.open(out / "map.tif") as raster:
            maps.append(raster.read(1))
    np.testing.assert_allclose(maps[0], maps[1], atol=0.02)  # a store's pings are rounded
