"""A mission: every vehicle's node, the water between them, and one clock that drives them all."""

import itertools
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from firmware.dead_reckoning import ReckonedState
from firmware.follower.core import FollowerCore
from firmware.leader.core import LeaderCore
from host_tools.baselines import Originals, copied_steps, rebuild_of
from host_tools.mission_settings import MissionSettings
from host_tools.nodes import FollowerNode, LeaderNode, Node
from host_tools.simulator.placement import Site
from host_tools.simulator.vehicle import SimulatedVehicle
from host_tools.stored_nodes import stored_nodes
from protocol.acoustics import Delivery, Water
from protocol.errors import ConfigError
from protocol.schedule import Slots

_WATER_STREAM = 0x57A7E2  # keeps the water's draws apart from the vehicles'
Progress = Callable[[float], None]


def simulated_vehicles(
    settings: MissionSettings,
    site: Site,
    seed: int,
    on_soundings: Callable[[np.ndarray], None] | None = None,
) -> list[SimulatedVehicle]:
    """Return the leader and the followers of a scenario, with their simulated sensors."""
    return [
        SimulatedVehicle(settings.scenario, site.seabed, index, seed, on_soundings)
        for index in range(settings.scenario.followers + 1)
    ]


def water_between(settings: MissionSettings, vehicles: list[SimulatedVehicle], seed: int) -> Water:
    """Return the medium; the vehicles' true distances are known to it alone."""
    rng = np.random.default_rng([seed, _WATER_STREAM])
    return Water(
        settings.scenario.water,
        rng,
        lambda node, time_s: vehicles[node].true_position(time_s),
        nodes=range(len(vehicles)),
    )


def local_nodes(
    settings: MissionSettings,
    vehicles: list[SimulatedVehicle],
    baseline: str = "none",
    store: Path | None = None,
) -> tuple[LeaderNode, list[FollowerNode]]:
    """Return every vehicle with its core, in this process; with stores in a new folder, if given.

    Raises
    ------
    ConfigError
        For a store beside a baseline, which has no packets to keep, or one that is there already.
    """
    if store is not None:
        if baseline != "none":
            raise ConfigError(f"--store is for vehicles; --baseline {baseline} is none")
        return stored_nodes(settings, vehicles, [deployed(v) for v in vehicles], store)
    slots = Slots(settings.slots)
    originals = Originals(submaps={})
    rebuild = rebuild_of(baseline, originals, settings.leader.reconstruction.cell_m)
    leader = LeaderCore(
        0, deployed(vehicles[0]), settings=settings.leader, slots=slots, rebuild=rebuild
    )
    followers = []
    for vehicle in vehicles[1:]:
        core = FollowerCore(
            vehicle.index, 0, deployed(vehicle), settings=settings.follower, slots=slots
        )
        steps = vehicle.steps()
        if rebuild is not None:
            steps = copied_steps(steps, core, settings.follower, originals)
        followers.append(FollowerNode(core, steps))
    return LeaderNode(leader, vehicles[0].steps()), followers


def deployed(vehicle: SimulatedVehicle) -> ReckonedState:
    """Return where and how a vehicle was put into the water: the start of its dead reckoning."""
    north_m, east_m, depth_m = vehicle.told_start()
    return ReckonedState(time_s=0.0, north_m=north_m, east_m=east_m, yaw_rad=0.0, depth_m=depth_m)


def run(
    nodes: Mapping[int, Node],
    water: Water,
    *,
    duration_s: float,
    tick_s: float,
    record: Callable[[Delivery], None],
    progress: Progress | None = None,
) -> None:
    """Drive all nodes to the end: deliveries in the order of time, then each tick in turn.

    What is under way at the end is recorded, too, though nobody hears it any more.
    """
    for step in itertools.count():
        now_s = step * tick_s
        if now_s > duration_s + 1e-9:
            break
        for delivery in water.deliveries_until(now_s):
            record(delivery)
            if delivery.was_received:
                node = nodes[delivery.destination]
                node.hear(delivery.frame, delivery.t_rx_s, delivery.t_delivered_s)
        for number, node in nodes.items():
            frame = node.tick(now_s)
            if frame is not None:
                water.transmit(number, now_s, frame)
        if progress is not None:
            progress(now_s)
    for delivery in water.deliveries_until(np.inf):
        record(delivery)
