"""`benchmarks.days`: missions whose vehicles are processes that tell what they cost."""

import sys

import pytest

from benchmarks.days import lasting, mission
from host_tools.mission_settings import MissionSettings

HALF_A_MINUTE = lasting(MissionSettings(), 0.5 / 60.0)


def test_the_row_of_a_mission_tells_the_processor_time_of_each_vehicle() -> None:
    (row,), _ = mission(HALF_A_MINUTE, None, seed=1)
    assert row.hours == 0.5 / 60.0
    assert 0.0 < row.leader_cpu_s < 60.0
    assert 0.0 < row.follower_cpu_s < 60.0


def test_a_vehicle_that_dies_at_its_start_ends_the_mission_with_its_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(SystemExit, match=r"leader: its process ended at 0 s .* with status 1"):
        mission(HALF_A_MINUTE, None, seed=1)
