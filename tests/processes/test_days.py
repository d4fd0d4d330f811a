"""`benchmarks.days` beside vehicles whose processes fail."""

import sys

import pytest

from benchmarks.days import mission
from host_tools.mission_settings import MissionSettings, changed


def test_a_vehicle_that_dies_at_its_start_ends_the_mission_with_its_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/false")
    settings = changed(MissionSettings(), {"duration_min": 0.5, "follower_duration_min": 0.5})
    with pytest.raises(SystemExit, match=r"leader: its process ended at 0 s .* with status 1"):
        mission(settings, None, seed=1)
