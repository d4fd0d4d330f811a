import argparse

import numpy as np
import pytest

from firmware.follower.core import FollowerCore
from firmware.follower.settings import FollowerSettings
from host_tools.baselines import Originals, copied_steps, octree, unlimited
from host_tools.commands import add_mission_arguments, settings_of
from host_tools.mission import deployed
from host_tools.octree import octree_submap
from host_tools.scenario import named_scenario
from host_tools.simulate import simulate
from host_tools.simulator.placement import place_survey
from host_tools.simulator.terrain import open_terrain
from host_tools.simulator.vehicle import SimulatedVehicle
from protocol.errors import EstimationError
from protocol.reassembly import SubmapTransfer
from protocol.schedule import Slots, SlotSettings
from protocol.settings import replace


@pytest.fixture(scope="module")
def originals() -> Originals:
    scenario = replace(named_scenario("paper-1"), {"duration_min": 1.5, "beams": 64})
    site = place_survey(open_terrain(None), scenario, 1)
    vehicle = SimulatedVehicle(scenario, site.seabed, 1, 1)
    settings = FollowerSettings()
    core = FollowerCore(1, 0, deployed(vehicle), settings=settings, slots=Slots(SlotSettings()))
    kept = Originals(submaps={})
    copied = list(copied_steps(vehicle.steps(), core, settings, kept))
    plain = list(SimulatedVehicle(scenario, site.seabed, 1, 1).steps())
    assert [odometry for odometry, _ in copied] == [odometry for odometry, _ in plain]
    return kept


def transfer(submap: int, arrived: set[int]) -> SubmapTransfer:
    return SubmapTransfer(
        vehicle=1,
        boot_epoch=0,
        submap=submap,
        fragment_count=10,
        fragments=dict.fromkeys(arrived),  # type: ignore[arg-type]
        first_arrival_s=50.0,
        last_arrival_s=90.0,
        reason="complete",
    )


def test_originals_are_kept_as_measured(originals: Originals) -> None:
    assert set(originals.submaps) == {(1, 0, 0), (1, 0, 1)}
    track = originals.submaps[(1, 0, 0)].track
    np.testing.assert_allclose(track.time_s, np.arange(40.0))


def test_unlimited_gives_the_whole_submap_however_little_arrived(originals: Originals) -> None:
    rebuilt = unlimited(originals, 2.0)(transfer(1, {7}))
    known = np.isfinite(rebuilt.grid.depth_m)
    assert known.sum() > 1500
    assert rebuilt.track is originals.submaps[(1, 0, 1)].track
    with pytest.raises(EstimationError, match="never measured"):
        unlimited(originals, 2.0)(transfer(9, {7}))


def test_octree_is_lost_with_any_of_its_packets_and_only_with_those(originals: Originals) -> None:
    chunks = len(octree_submap(originals.submaps[(1, 0, 0)].bins))
    assert 1 <= chunks <= 10
    rebuild = octree(originals)
    assert np.isfinite(rebuild(transfer(0, set(range(chunks)))).grid.depth_m).any()
    for missing in range(chunks):
        with pytest.raises(EstimationError, match="lost"):
            rebuild(transfer(0, set(range(10)) - {missing}))


def test_octrees_travel_whole_whatever_the_default_profile_needs() -> None:
    parser = argparse.ArgumentParser()
    add_mission_arguments(parser)
    short = ["--set", "duration_min=3", "--set", "follower_duration_min=3", "--loss", "0"]
    arguments = parser.parse_args(["--baseline", "octree", *short])
    result = simulate(settings_of(arguments), None, arguments.seed, arguments.baseline)
    status = result.counters["leader"]
    assert status["reassembly_complete"] >= 2
    assert status.get("submaps_not_rebuilt", 0) == 0


@pytest.mark.parametrize(
    ("profile", "water"),
    [
        ("lattice", ["--loss", "0.9"]),
        ("paper", ["--loss", "0.9"]),
        ("lattice", ["--loss", "0.1", "--set", "corruption=0.9"]),
    ],
)
def test_unlimited_loses_no_submap_whatever_the_water_does(profile: str, water: list[str]) -> None:
    parser = argparse.ArgumentParser()
    add_mission_arguments(parser)
    short = ["--set", "duration_min=4", "--set", "follower_duration_min=4", "--set", "beams=48"]
    arguments = parser.parse_args(["--baseline", "unlimited", "--profile", profile, *water, *short])
    result = simulate(settings_of(arguments), None, arguments.seed, arguments.baseline)
    status = result.counters["leader"]
    assert status["reassembly_complete"] == 4  # the fifth is yet to be sent
    assert status.get("submaps_off_track", 0) == 0
    assert {patch.vehicle for patch in result.patches} == {0, 1}
    assert sum(d.fate in {"lost", "corrupt"} for d in result.deliveries) > 40
