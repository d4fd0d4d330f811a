"""Vehicles of a simulation that keep stores as at sea: to measure, and to be read afterwards."""

from pathlib import Path

from firmware.dead_reckoning import ReckonedState
from firmware.follower.journaled import JournaledFollower
from firmware.journal import Journal, JournalSettings, Owner
from firmware.journaled import Journaled
from firmware.leader.journaled import JournaledLeader
from host_tools.mission_settings import MissionSettings
from host_tools.nodes import FollowerNode, LeaderNode
from host_tools.processes.resume import prepare_store
from host_tools.simulator.vehicle import SimulatedVehicle
from protocol.errors import ConfigError
from protocol.schedule import Slots


def stored_nodes(
    settings: MissionSettings,
    vehicles: list[SimulatedVehicle],
    starts: list[ReckonedState],
    folder: Path,
) -> tuple[LeaderNode, list[FollowerNode]]:
    """Return every vehicle with its core and a new store in the folder.

    Raises
    ------
    ConfigError
        When the folder cannot be made or holds stores: a simulation cannot take up an earlier one.
    """
    prepare_store(folder)
    if any(folder.glob("*.sqlite")):
        raise ConfigError(
            f"--store {folder} holds the stores of an earlier mission; give a new folder "
            "(only the processes follower and leader can resume)"
        )
    slots = Slots(settings.slots)
    leader = JournaledLeader(_new(folder, 0), starts[0], settings=settings.leader, slots=slots)
    followers = [
        JournaledFollower(
            _new(folder, vehicle.index),
            vehicle.index,
            start,
            settings=settings.follower,
            slots=slots,
        )
        for vehicle, start in zip(vehicles[1:], starts[1:], strict=True)
    ]
    return LeaderNode(leader, vehicles[0].steps()), [
        FollowerNode(core, vehicle.steps())
        for core, vehicle in zip(followers, vehicles[1:], strict=True)
    ]


def close_stores(nodes: list[LeaderNode | FollowerNode]) -> None:
    """Commit and close the stores of nodes that have one."""
    for node in nodes:
        if isinstance(node.core, Journaled):
            node.core.recorder.journal.close()


def _new(folder: Path, vehicle: int) -> Journal:
    return Journal(folder, Owner(vehicle=vehicle, fingerprint="simulation"), JournalSettings())
