import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from firmware.dead_reckoning import ReckonedState
from firmware.follower.core import FollowerCore
from firmware.follower.settings import FollowerSettings
from firmware.ports import ModemPort
from host_tools.cli import main
from host_tools.link_status import advice_lines, status_lines
from protocol.acoustics import Water, WaterSettings
from protocol.codec import encode
from protocol.modems.loopback import LoopbackMedium
from protocol.modems.sealed import SealedLink, SealedModem
from protocol.schedule import Slots, SlotSettings
from protocol.seal import Keys, Opener, Sealer
from protocol.seal_state import FileMarks, ReservedCounter
from tests.protocol.strategies import paper_packet
from tests.protocol.test_seal import sealed_frame

START = ReckonedState(time_s=0.0, north_m=0.0, east_m=0.0, yaw_rad=0.0, depth_m=0.0)


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
    marks.failed_writes = 2
    counter.next()
    core = FollowerCore(1, 0, START, settings=FollowerSettings(), slots=Slots(SlotSettings()))
    core.receive_frame(bytes(30), None, 0.0)
    lines = list(status_lines(folder_of(tmp_path, {**core.status(), **port.status()})))
    assert "  rejected    crc 1, size 1" in lines
    assert "  seal        marks unwritten 2" in lines
    assert "  fragments   waiting 0, wanted 0" in lines
    assert lines[-1] == "seal_1: counters reserved up to 64, highest accepted by sender {}"


def test_boots_without_end_are_told(tmp_path: Path) -> None:
    lines = list(status_lines(folder_of(tmp_path, {"boots_refused": 3})))
    assert "  frames      boots refused 3" in lines
    assert any("two bear one number" in line for line in lines)


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


@pytest.mark.parametrize(
    "content",
    [None, "", "[1]", "{", "[" * 100_000, '{"counters": 5}', '{"counters": {"leader": 5}}'],
)
def test_a_folder_without_a_mission_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str | None
) -> None:
    if content is not None:
        (tmp_path / "summary.json").write_text(content)
    assert main(["link", "status", str(tmp_path)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize("suffix", ["counter", "marks"])
def test_a_damaged_file_of_a_store_is_told(tmp_path: Path, suffix: str) -> None:
    (tmp_path / "seal_1.counter").write_text("64\n")
    (tmp_path / f"seal_1.{suffix}").write_bytes(b"\xff\xfe")
    assert "damaged" in next(status_lines(tmp_path))


def test_numbers_and_addresses_given_twice_are_told_with_what_to_do() -> None:
    def told(**counters: float) -> list[str]:
        return list(advice_lines(counters))

    assert told(modem_own_echoes=0) == []
    assert "its own ?address=" in told(modem_own_echoes=2)[0]
    assert "its own --vehicle" in told(frames_with_our_number=1)[0]
    assert "its own --vehicle" in told(modem_rejected_reflected=1)[0]
    assert "one release" in told(rejected_version=1)[0]
    assert "--key" in told(modem_rejected_plain=1)[0]
    assert "--key" in told(frames_sealed=1)[0]


def test_a_vehicle_counts_frames_with_its_own_number_and_sealed_ones() -> None:
    slots = Slots(SlotSettings(followers=2))
    core = FollowerCore(2, 0, START, settings=FollowerSettings(), slots=slots)
    packet = paper_packet()
    core.receive_frame(encode(replace(packet, header=replace(packet.header, vehicle=2))), None, 0.0)
    core.receive_frame(sealed_frame(), None, 0.0)
    status = core.status()
    assert (status["frames_with_our_number"], status["frames_sealed"]) == (1, 1)
