"""A short survey of two vehicles, measured once, and played to every mission that is tried."""

import dataclasses
from collections.abc import Iterator

from firmware.dead_reckoning import ReckonedState
from firmware.ports import SensorStep
from host_tools.faults.computer import LocalClock
from host_tools.mission import deployed, simulated_vehicles
from host_tools.mission_settings import MissionSettings, changed
from host_tools.simulator.placement import place_survey
from host_tools.simulator.terrain import open_terrain
from host_tools.simulator.vehicle import SimulatedVehicle

CHEAP = {
    "duration_min": 20.0,
    "follower_duration_min": 20.0,
    "leg_m": 100.0,
    "beams": 24,
    "follower.compression.sealed": True,
    "leader.reconstruction.sealed": True,
    "leader.closures.pairs_per_submap": 1,
    "leader.closures.screened_per_submap": 4,
    "leader.reconstruction.cell_m": 6.0,
    "leader.answers": "extended",
    "leader.hop_s": 40.0,
}
"""What is matched little says as much about faults as what is matched well."""


class Survey:
    """Settings, starts, and the sensors' steps as far as any mission has asked for them."""

    def __init__(self, seed: int = 4) -> None:
        self.settings = changed(MissionSettings(), CHEAP)
        site = place_survey(open_terrain(None, 1), self.settings.scenario, seed)
        self.vehicles: list[SimulatedVehicle] = simulated_vehicles(self.settings, site, seed)
        self._sources = [vehicle.steps() for vehicle in self.vehicles]
        self._tapes: list[list[SensorStep]] = [[], []]

    def start(self, vehicle: int) -> ReckonedState:
        """Return the start of a vehicle's dead reckoning."""
        return deployed(self.vehicles[vehicle])

    def steps(self, vehicle: int, clock: LocalClock, from_s: float) -> Iterator[SensorStep]:
        """Yield a vehicle's steps, stamped by its clock; those before from_s as it is then."""
        for odometry, ping in self._steps(vehicle):
            true_s = odometry.time_s
            off_s = clock(max(true_s, from_s)) - max(true_s, from_s)
            if off_s == 0.0:
                yield odometry, ping
                continue
            time_s = true_s + off_s
            late = None if ping is None else dataclasses.replace(ping, time_s=time_s)
            yield dataclasses.replace(odometry, time_s=time_s), late

    def _steps(self, vehicle: int) -> Iterator[SensorStep]:
        tape, at = self._tapes[vehicle], 0
        while True:
            if at == len(tape):
                step = next(self._sources[vehicle], None)
                if step is None:
                    return
                tape.append(step)
            yield tape[at]
            at += 1
