"""Does the proposed manoeuvre help? The same mission with and without it, seed by seed.

    python -m benchmarks.manoeuvre [--seeds 3] [--survey-min 12] [--terrain FILE] [--set KEY=VALUE]

Two vehicles survey. Then both would go straight on as the leader believes they go; it is
asked for a proposal, and in a second run of the same seed the vehicle that it names steers so. What
it promised stands beside what came of it: errors of both at the end of the way, as the leader
estimates them. One error is a draw; only their root mean square over seeds can keep a promise.
The proposal is found from the estimate alone; the truth is used to measure.
"""

import argparse
import math
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from firmware.geometry import Array
from firmware.journaled import bare
from firmware.leader.core import LeaderCore
from firmware.leader.manoeuvre import Proposal
from host_tools.commands import add_survey_arguments, count, settings_of, status_of
from host_tools.mission import local_nodes, run, simulated_vehicles, water_between
from host_tools.mission_settings import MissionSettings, changed
from host_tools.simulator.placement import place_survey
from host_tools.simulator.terrain import open_terrain
from host_tools.simulator.vehicle import CHUNK_S, SimulatedVehicle


@dataclass(slots=True)
class Outcome:
    """What was proposed, and the vehicles' errors (V,) at the end, after the way and a minute."""

    proposal: Proposal | None
    errors_m: Array


def sail(
    settings: MissionSettings, terrain: Path | None, seed: int, survey_s: float, *, follow: bool
) -> Outcome:
    """Run one mission: survey, then straight on, but for the vehicle that follows a proposal."""
    scenario = settings.scenario
    site = place_survey(open_terrain(terrain, scenario.relief_seed), scenario, seed)
    vehicles = simulated_vehicles(settings, site, seed)
    leader, followers = local_nodes(settings, vehicles)
    outcome = Outcome(proposal=None, errors_m=np.full(len(vehicles), np.nan))

    def watch(now_s: float) -> None:
        if now_s == survey_s:
            outcome.proposal = bare(leader.core).outlook.propose()
            for vehicle in vehicles:
                vehicle.steer(survey_s + CHUNK_S, _heading(outcome.proposal, vehicle, follow))

    run(
        {0: leader, **{node.core.vehicle: node for node in followers}},
        water_between(settings, vehicles, seed),
        duration_s=scenario.duration_s,
        tick_s=scenario.tick_s,
        record=lambda _: None,
        progress=watch,
    )
    outcome.errors_m = np.array([_error_m(bare(leader.core), vehicle) for vehicle in vehicles])
    return outcome


def _heading(proposal: Proposal | None, vehicle: SimulatedVehicle, follow: bool) -> float | None:
    if proposal is None:
        return None
    if follow and proposal.vehicle == vehicle.index:
        return math.radians(proposal.heading_deg)
    return math.radians(proposal.going_on_deg[vehicle.index])


def _error_m(leader: LeaderCore, vehicle: SimulatedVehicle) -> float:
    """Return the error of the leader's estimate at the newest state that it knows."""
    track = leader.track(vehicle.index)
    end_s = float(track.time_s[-1])
    estimate_m = leader.trajectory(vehicle.index).correct(end_s, track.position_at(end_s))
    return float(np.hypot(*(estimate_m - vehicle.true_position(end_s)[:2])))


def main() -> None:
    """Run each seed twice and print the errors side by side."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.manoeuvre", description=__doc__, allow_abbrev=False
    )
    add_survey_arguments(parser)
    parser.add_argument("--seeds", type=count, default=3)
    parser.add_argument("--survey-min", type=float, default=12.0)
    arguments = parser.parse_args()
    settings = settings_of(arguments)
    survey_s = CHUNK_S * round(60.0 * arguments.survey_min / CHUNK_S)
    ahead_s = settings.leader.manoeuvre.horizon_s
    minutes = (survey_s + CHUNK_S + ahead_s + 60.0) / 60.0
    settings = changed(settings, {"duration_min": minutes, "follower_duration_min": minutes})
    errors_m = []  # of all vehicles, going on and as proposed
    with threadpool_limits(1):
        for seed in range(1, arguments.seeds + 1):
            without, taken = (
                sail(settings, arguments.terrain, seed, survey_s, follow=follow)
                for follow in (False, True)
            )
            errors_m.append([without.errors_m, taken.errors_m])
            print(f"seed {seed}: {without.proposal or 'nothing is proposed'}")
            for name, outcome in (("going on", without), ("as proposed", taken)):
                errors = ", ".join(f"{error_m:.1f}" for error_m in outcome.errors_m)
                print(f"  {name:<12} errors at the end (leader, followers): {errors} m", flush=True)
    rms_m = np.sqrt(np.mean(np.square(errors_m), axis=2))  # (seeds, 2)
    overall_m = np.sqrt(np.mean(np.square(rms_m), axis=0))
    print(
        f"root mean square over vehicles and {len(rms_m)} seeds: {overall_m[0]:.1f} m going on, "
        f"{overall_m[1]:.1f} m as proposed; better in {np.sum(rms_m[:, 1] < rms_m[:, 0])}"
    )


if __name__ == "__main__":
    sys.exit(status_of("benchmarks.manoeuvre", main))
