"""A mission whose modems lose power and whose cables are pulled, a hundred times."""

import json
from pathlib import Path

import pytest

from host_tools.cli import main
from host_tools.mission import Progress
from host_tools.processes.emulated_modems import EmulatedModems
from host_tools.processes.remote_node import RemoteNode

FIRST_S, EVERY_S, PULLED_S, TIMES = 60, 8, 3, 100
SHORT = ["duration_min=15", "follower_duration_min=15", "leg_m=100", "beams=32"]


class Mishaps:
    """In turn: a modem loses power, a cable is out for a while; the vehicles take turns too."""

    def __init__(self, modems: EmulatedModems, nodes: dict[int, RemoteNode]) -> None:
        self.count, self._modems, self._nodes = 0, modems, nodes

    def befall(self, now_s: float) -> None:
        turn, rest_s = divmod(now_s - FIRST_S, EVERY_S)
        if not 0 <= turn < TIMES:
            return
        vehicle, is_pull = int(turn) % 2, int(turn) // 2 % 2
        if is_pull and rest_s == PULLED_S:
            self._nodes[vehicle].port.plug()
        if rest_s:
            return
        self.count += 1
        if is_pull:
            self._nodes[vehicle].port.unplug()
        else:
            self._modems.bench.units[vehicle].power_cycle(now_s)


@pytest.mark.slow
def test_a_mission_goes_on_through_a_hundred_power_cycles_and_pulled_cables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, told = EmulatedModems.run, list[Mishaps]()

    def disturbed(
        self: EmulatedModems,
        nodes: dict[int, RemoteNode],
        *,
        duration_s: float,
        tick_s: float,
        progress: Progress,
    ) -> None:
        mishaps = Mishaps(self, nodes)
        told.append(mishaps)

        def both(now_s: float) -> None:
            mishaps.befall(now_s)
            progress(now_s)

        run(self, nodes, duration_s=duration_s, tick_s=tick_s, progress=both)

    monkeypatch.setattr(EmulatedModems, "run", disturbed)
    changes = [part for change in SHORT for part in ("--set", change)]
    assert main(["demo", "--modems", "micromodem", "--out", str(tmp_path), *changes]) == 0
    assert [mishaps.count for mishaps in told] == [TIMES]
    for name, handed_over in (("leader", "answers_sent"), ("follower_1", "frames_sent")):
        counters = json.loads((tmp_path / "processes" / f"{name}.json").read_text())
        assert counters["modem_dropped"] == 0
        assert counters["modem_reopened"] == TIMES // 4
        assert counters[handed_over] == counters["modem_confirmed"] + counters["modem_queued"]
        assert counters["modem_confirmed"] >= 50
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["closures"]["active"]["number"] >= 5
