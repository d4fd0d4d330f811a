"""Fifty kills in one mission against the same mission undisturbed.

    python -m benchmarks.kills [--kills 50] [--seed 1] [--terrain FILE] [--set KEY=VALUE]

Both runs keep stores; kills strike leader and follower alike, at drawn events of their journals:
before an input is taken, before a commit, after it and before what it allows. Prints whether every
frame in the water was the same, how far the final estimates lie apart, and what the stores cost.
"""

import argparse
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from firmware.follower.journaled import JournaledFollower
from firmware.geometry import Array
from firmware.journal import JournalSettings, Owner
from firmware.leader.journaled import JournaledLeader
from host_tools.commands import (
    add_seed_argument,
    add_survey_arguments,
    count,
    settings_of,
    status_of,
)
from host_tools.kills import Fate, MortalJournal, MortalNode, SensorTape
from host_tools.mission import deployed, run, simulated_vehicles, water_between
from host_tools.mission_settings import MissionSettings
from host_tools.nodes import FollowerNode, LeaderNode
from host_tools.simulator.placement import Site, place_survey
from host_tools.simulator.terrain import open_terrain
from host_tools.simulator.vehicle import SimulatedVehicle
from protocol.acoustics import Delivery
from protocol.schedule import Slots


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """A mission in which computers may have died."""

    leader: JournaledLeader
    nodes: dict[int, MortalNode]
    deliveries: list[Delivery]
    kills: int
    took_s: float


def mortal_mission(
    settings: MissionSettings, site: Site, seed: int, folder: Path, kills: int
) -> Outcome:
    """Return a mission with a number of kills shared among its vehicles."""
    vehicles = simulated_vehicles(settings, site, seed)
    tick_s = settings.scenario.tick_s
    events = 5.0 * settings.scenario.duration_s * settings.scenario.ping_hz
    share = [len(part) for part in np.array_split(np.arange(kills), len(vehicles))]
    fates = [
        Fate(np.random.default_rng([seed, 0xDEAD, k]), share[k], 0.8 * events / max(share[k], 1))
        for k in range(len(vehicles))
    ]
    nodes = {
        vehicle.index: MortalNode(
            lambda tape, v=vehicle: _board(settings, v, fates[v.index], folder, tape),  # type: ignore[misc]
            vehicle.steps(),
            tick_s,
        )
        for vehicle in vehicles
    }
    deliveries: list[Delivery] = []
    began_s = time.perf_counter()
    run(
        nodes,
        water_between(settings, vehicles, seed),
        duration_s=settings.scenario.duration_s,
        tick_s=tick_s,
        record=deliveries.append,
    )
    took_s = time.perf_counter() - began_s
    leader = nodes[0].core
    assert isinstance(leader, JournaledLeader)
    return Outcome(
        leader=leader,
        nodes=nodes,
        deliveries=deliveries,
        kills=sum(fate.kills for fate in fates),
        took_s=took_s,
    )


def apart_m(one: Outcome, other: Outcome) -> float:
    """Return the largest distance between the final estimates of any vehicle at any second."""
    return max(
        _apart_m(one.leader, other.leader, vehicle) for vehicle in one.leader.core.vehicles()
    )


def _apart_m(one: JournaledLeader, other: JournaledLeader, vehicle: int) -> float:
    track = one.core.track(vehicle)
    reckoned_m: Array = np.column_stack([track.north_m, track.east_m])
    ends = [
        leader.core.trajectory(vehicle).correct(track.time_s, reckoned_m) for leader in (one, other)
    ]
    return float(np.max(np.hypot(*(ends[0] - ends[1]).T)))


def _board(
    settings: MissionSettings, vehicle: SimulatedVehicle, fate: Fate, folder: Path, tape: SensorTape
) -> LeaderNode | FollowerNode:
    owner = Owner(vehicle=vehicle.index, fingerprint="benchmark")
    journal = MortalJournal(folder, owner, JournalSettings(), fate)
    start, slots = deployed(vehicle), Slots(settings.slots)
    if vehicle.index == 0:
        leader = JournaledLeader(journal, start, settings=settings.leader, slots=slots)
        return LeaderNode(leader, tape)
    follower = JournaledFollower(
        journal, vehicle.index, start, settings=settings.follower, slots=slots
    )
    return FollowerNode(follower, tape)


def _print_stores(folder: Path, settings: MissionSettings, site: Site, seed: int) -> None:
    hours = settings.scenario.duration_s / 3600.0
    for vehicle in simulated_vehicles(settings, site, seed):
        owner = Owner(vehicle=vehicle.index, fingerprint="benchmark")
        size = sum(path.stat().st_size for path in folder.glob(f"{owner.name}.sqlite*"))
        began_s = time.process_time()
        fate = Fate(np.random.default_rng(0), 0, 1.0)
        node = _board(settings, vehicle, fate, folder, SensorTape(iter(())))
        took_s = time.process_time() - began_s
        print(
            f"{owner.name:<11} store {size / 1e6:.1f} MB, {size / 1e6 / hours:.1f} MB an hour; "
            f"a restart at the end takes {took_s:.1f} s of one core, "
            f"{took_s / hours:.1f} s an hour"
        )
        del node


def main() -> None:
    """Run both missions and compare."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.kills", description=__doc__)
    parser.add_argument("--kills", type=count, default=50)
    add_survey_arguments(parser)
    add_seed_argument(parser)
    arguments = parser.parse_args()
    settings = settings_of(arguments)
    terrain = open_terrain(arguments.terrain, settings.scenario.relief_seed)
    site = place_survey(terrain, settings.scenario, arguments.seed)
    outcomes = []
    with tempfile.TemporaryDirectory() as name:
        for kills in (0, arguments.kills):
            folder = Path(name) / str(kills)
            outcome = mortal_mission(settings, site, arguments.seed, folder, kills)
            outcomes.append(outcome)
            print(
                f"{outcome.kills} kills: {outcome.took_s:.1f} s, {len(outcome.deliveries)} frames"
            )
            for node in outcome.nodes.values():
                journal = node.core.recorder.journal
                journal.close()
                print(f"  {dict(journal.counters)}; stray frames {node.stray_frames}")
        _print_stores(Path(name) / "0", settings, site, arguments.seed)
    undisturbed, killed = outcomes
    same = undisturbed.deliveries == killed.deliveries
    differing = sum(node.differing for node in killed.nodes.values())
    print(f"every frame in the water the same: {same}; beliefs told twice and unlike: {differing}")
    print(f"final estimates at most {apart_m(undisturbed, killed):.2e} m apart")


if __name__ == "__main__":
    sys.exit(status_of("benchmarks.kills", main))
