import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from firmware.dead_reckoning import ReckonedState
from firmware.follower.core import FollowerCore
from firmware.follower.settings import FollowerSettings
from firmware.ports import ModemPort
from host_tools.cli import main
from host_tools.link_status import status_lines
from protocol.acoustics import Water, WaterSettings
from protocol.modems.loopback import LoopbackMedium
from protocol.modems.sealed import SealedLink, SealedModem
from protocol.schedule import Slots, SlotSettings
from protocol.seal import Keys, Opener, Sealer
from protocol.seal_state import FileMarks, ReservedCounter


def folder_of(tmp_path: Path, counters: Mapping[str, float]) -> Path:
    (tmp_path / "processes").mkdir()
    (tmp_path / "processes" / "leader.json").write_text(json.dumps(counters))
    return tmp_path


def test_rejects_are_told_by_cause_and_queues_though_empty(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    counters = {
        "modem_sent": 4,
        "modem_queued": 0,
        "modem_rejected_tag": 3,
        "rejected_crc": 2,
        "frames_rejected": 2,
        "reassembly_open": 0,
        "reassembly_late": 0,
        "speak_failed": 1,
        "graph_rebuilds": 5,
    }
    assert main(["link", "status", str(folder_of(tmp_path, counters))]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "leader",
        "  modem       sent 4, queued 0",
        "  rejected    tag 3, crc 2",
        "  frames      rejected 2",
        "  reassembly  open 0",
        "  failed      speak 1",
    ]


def test_what_a_vehicle_counts_has_its_place(tmp_path: Path) -> None:
    water = Water(WaterSettings(), np.random.default_rng(1), lambda node, _: (9.0 * node, 0.0, 0.0))
    keys = Keys(bytes(32))
    counter, marks = (
        ReservedCounter(tmp_path / "seal_1.counter"),
        FileMarks(tmp_path / "seal_1.marks"),
    )
    link = SealedLink(Sealer(keys, counter), Opener(1, keys, marks))
    modem = LoopbackMedium(water).modem(1)
    port = ModemPort(SealedModem(modem, link))
    link.open(b"noise")
    counter.next()
    start = ReckonedState(time_s=0.0, north_m=0.0, east_m=0.0, yaw_rad=0.0, depth_m=0.0)
    core = FollowerCore(1, 0, start, settings=FollowerSettings(), slots=Slots(SlotSettings()))
    core.receive_frame(bytes(30), None, 0.0)
    lines = list(status_lines(folder_of(tmp_path, {**core.status(), **port.status()})))
    assert "  rejected    crc 1, size 1" in lines
    assert "  fragments   waiting 0, wanted 0" in lines
    assert lines[-1] == "seal_1: counters reserved up to 64, highest accepted by sender {}"


def test_a_finished_simulation_is_read_from_its_summary(tmp_path: Path) -> None:
    summary = {"counters": {"follower_1": {"answers_used": 2}, "line_leader": {"joined": 1}}}
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    assert list(status_lines(tmp_path)) == [
        "follower_1",
        "  answers     used 2",
        "  rejected    nothing",
        "line_leader",
        "  line        joined 1",
        "  rejected    nothing",
    ]


@pytest.mark.parametrize("content", [None, "", "[1]", "{"])
def test_a_folder_without_a_mission_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str | None
) -> None:
    if content is not None:
        (tmp_path / "summary.json").write_text(content)
    assert main(["link", "status", str(tmp_path)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
