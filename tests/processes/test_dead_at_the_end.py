"""A mission in real time that not all vehicles lived to the end of."""

import argparse
from pathlib import Path

import numpy as np
import pytest

from firmware.belief import Belief
from firmware.dead_reckoning import ReckonedState
from host_tools.mission import simulated_vehicles
from host_tools.processes.channel import finish, result_of_files
from host_tools.processes.records import VehicleFiles
from host_tools.processes.voyage import Voyage, add_voyage_arguments, voyage_of
from protocol.acoustics import Delivery
from protocol.errors import ConfigError

SHORT = ["--set", "duration_min=0.5", "--set", "follower_duration_min=0.5", "--set", "beams=32"]
LOST = Delivery(
    source=1,
    destination=0,
    t_tx_s=4.0,
    t_rx_s=None,
    t_delivered_s=4.5,
    frame=bytes(12),
    fate="lost",
)


@pytest.fixture
def voyage() -> Voyage:
    parser = argparse.ArgumentParser()
    add_voyage_arguments(parser)
    return voyage_of(parser.parse_args(SHORT))


def believed(out: Path, vehicle: int, until_s: int) -> VehicleFiles:
    files = VehicleFiles(out, vehicle)
    files.prepare()
    for second in range(until_s):
        belief = Belief(time_s=second, position_m=np.zeros(2), covariance_m2=np.eye(2))
        state = ReckonedState(time_s=second, north_m=0.0, east_m=0.0, yaw_rad=0.0, depth_m=5.0)
        files.note(belief, state)
    return files


def test_what_is_there_is_written_and_what_is_missing_named(voyage: Voyage, tmp_path: Path) -> None:
    believed(tmp_path, 0, 31).write_counters({"frames_sent": 3})
    believed(tmp_path, 1, 12)
    vehicles = simulated_vehicles(voyage.settings, voyage.site, voyage.seed)
    result = result_of_files(voyage, vehicles, tmp_path, [LOST], {})
    lines = finish(result, tmp_path)
    assert "leader left no leader.soundings.npz, leader.npz" in "".join(lines)
    assert "follower_1 left no follower_1.json, follower_1.soundings.npz" in "".join(lines)
    assert "leader left no" in "".join(result.remarks)
    assert "what it believed ends at 11 s, and stands still" in "".join(result.remarks)
    assert (tmp_path / "report.html").exists()
    assert (tmp_path / "air.jsonl").read_text().count("\n") == 1


def test_the_air_is_written_though_no_vehicle_left_anything(voyage: Voyage, tmp_path: Path) -> None:
    vehicles = simulated_vehicles(voyage.settings, voyage.site, voyage.seed)
    with pytest.raises(ConfigError, match=r"leader\.beliefs holds no mission"):
        result_of_files(voyage, vehicles, tmp_path, [LOST], {})
    assert (tmp_path / "air.jsonl").read_text().count("\n") == 1
