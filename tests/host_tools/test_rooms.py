"""Truth stays on the desk: what firmware may import, and what it can reach."""

import ast
import gc
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from host_tools.scenario import named_scenario
from host_tools.simulator.placement import place_survey
from host_tools.simulator.seabed import Seabed
from host_tools.simulator.terrain import open_terrain
from host_tools.simulator.vehicle import SimulatedVehicle, TrueTrack
from protocol.settings import replace

ROOT = Path(__file__).resolve().parents[2]


def imported_names(source: str) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
    return names


@pytest.mark.parametrize("room", ["firmware", "protocol"])
def test_no_source_of_the_room_names_host_tools(room: str) -> None:
    for path in (ROOT / room).rglob("*.py"):
        source = path.read_text(encoding="utf-8")
        roots = {name.split(".")[0] for name in imported_names(source)}
        assert "host_tools" not in roots, path
        assert "hil" not in roots, path
        assert not ({"runpy", "inspect"} & roots), path


def test_loading_all_firmware_loads_nothing_of_host_tools() -> None:
    program = (
        "import importlib, pkgutil, sys, firmware, protocol\n"
        "for package in (firmware, protocol):\n"
        "    for module in pkgutil.walk_packages(package.__path__, package.__name__ + '.'):\n"
        "        importlib.import_module(module.name)\n"
        "print([name for name in sys.modules if name.split('.')[0] == 'host_tools'])\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


def reachable(start: object, limit: int = 100_000) -> list[object]:
    """Return the objects that can be reached from one by references, classes and modules aside."""
    seen: dict[int, object] = {id(start): start}
    queue = [start]
    while queue:
        for found in gc.get_referents(queue.pop()):
            if isinstance(found, type) or type(found).__name__ in {"module", "function"}:
                continue
            if id(found) not in seen:
                seen[id(found)] = found
                queue.append(found)
        assert len(seen) < limit
    return list(seen.values())


def test_truth_is_not_reachable_from_what_firmware_is_given() -> None:
    scenario = replace(named_scenario("paper-1"), {"duration_min": 1})
    site = place_survey(open_terrain(None), scenario, 1)
    vehicle = SimulatedVehicle(scenario, site.seabed, 0, 1)
    for k, (odometry, ping) in enumerate(vehicle.steps()):
        if k % 50:
            continue
        assert ping is not None
        for given in (odometry, ping):
            found = reachable(given)
            assert not any(
                isinstance(item, Seabed | SimulatedVehicle | TrueTrack) for item in found
            )
            arrays = [item for item in found if isinstance(item, np.ndarray)]
            # Neither the truth nor pings that are still to come.
            assert all(array.base is None and array.size == scenario.beams for array in arrays)
