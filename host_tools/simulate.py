"""`fathomlink simulate`: one mission from terrain to report."""

import argparse
import dataclasses
import time
from pathlib import Path
from typing import Never

from tqdm import tqdm

from host_tools.baselines import Unheard
from host_tools.collect import Mission, mission_result
from host_tools.commands import Command, add_mission_arguments, folder_of, settings_of
from host_tools.evaluation import Evaluation, evaluate
from host_tools.mapping import DepthMap
from host_tools.mission import Progress, local_nodes, run, simulated_vehicles, water_between
from host_tools.mission_settings import MissionSettings, check_air
from host_tools.registration import SEARCH_M, TileShifts
from host_tools.report import write_report
from host_tools.results import MissionResult
from host_tools.simulator.placement import place_survey
from host_tools.simulator.terrain import open_terrain
from host_tools.stored_nodes import close_stores
from host_tools.writers import forget_mission, prepare_folder, write_outputs
from protocol.acoustics import Delivery


def simulate(
    settings: MissionSettings,
    terrain: Path | None,
    seed: int,
    baseline: str = "none",
    progress: Progress | None = None,
    store: Path | None = None,
    out: Path | None = None,
) -> MissionResult:
    """Return a whole mission, all vehicles in this process; they keep stores if asked to.

    What an earlier one left in out is removed once this one can begin.
    """
    check_air(settings)
    scenario = settings.scenario
    site = place_survey(open_terrain(terrain, scenario.relief_seed), scenario, seed)
    truth_map = DepthMap(site.window)
    vehicles = simulated_vehicles(settings, site, seed, truth_map.add)
    leader, followers = local_nodes(settings, vehicles, baseline, store)
    if out is not None:
        forget_mission(out, terrain)
    deliveries: list[Delivery] = []
    unheard = Unheard(leader) if baseline == "unlimited" else None

    def record(delivery: Delivery) -> None:
        deliveries.append(delivery)
        if unheard is not None:
            unheard.note(delivery)

    run(
        {0: leader, **{node.core.vehicle: node for node in followers}},
        water_between(settings, vehicles, seed),
        duration_s=scenario.duration_s,
        tick_s=scenario.tick_s,
        record=record,
        progress=progress,
    )
    mission = Mission(
        settings=settings,
        site=site,
        seed=seed,
        baseline=baseline,
        vehicles=vehicles,
        deliveries=deliveries,
        truth_map=truth_map,
    )
    result = mission_result(mission, leader, followers)
    if store is not None:  # the shelf is in the leader's
        result = dataclasses.replace(result, patches=list(result.patches))
        close_stores([leader, *followers])
    return result


def outcome_lines(evaluation: Evaluation) -> list[str]:
    """Return the mission's errors as a table: what is left of dead reckoning's."""
    lines = [f"{'':<12} {'dead reckoning':>15} {'live':>18} {'final':>18} {'at the end':>11}"]
    for name, errors in evaluation.vehicles.items():
        live, final = errors.live, errors.final
        lines.append(
            f"{name:<12} {errors.dead_reckoning.mean_m:13.2f} m "
            f"{live.mean_m:8.2f} m {live.share_of_dead_reckoning:6.1%} "
            f"{final.mean_m:9.2f} m {final.share_of_dead_reckoning:6.1%} {final.end_m:8.2f} m"
        )
    error = evaluation.registration
    if not error.mapped_share > 0.0:
        return [*lines, "nothing was mapped: too high above the seabed, or no sonar was on?"]
    lines.append(
        f"map against truth-navigated map, {error.mapped_share:.1%} of it: "
        f"mean {error.mean_m:.3f} m, "
        f"median {error.median_m:.3f} m, {error.share_under_1m:.1%} under 1 m; "
        f"{_shifts(evaluation.tiles)}"
    )
    return lines


def _shifts(tiles: TileShifts) -> str:
    if tiles.tiles:
        far = f", {tiles.far_tiles} by {SEARCH_M:.0f} m or more" if tiles.far_tiles else ""
        return f"tiles shifted by {tiles.median_m:.2f} m in the median{far}"
    if tiles.far_tiles:
        return f"all tiles that tell their shift are off by {SEARCH_M:.0f} m or more"
    return "no tile has relief enough to tell its shift"


def _configure(parser: argparse.ArgumentParser) -> None:
    add_mission_arguments(parser)
    parser.add_argument(
        "--out", type=folder_of, required=True, metavar="DIR", help="where the outputs go"
    )
    parser.add_argument(
        "--store", type=Path, metavar="DIR", help="where vehicles keep their stores; default: none"
    )
    parser.add_argument("--no-report", action="store_true", help="leave report.html out")


def _run(arguments: argparse.Namespace) -> None:
    settings = settings_of(arguments)
    folder = prepare_folder(arguments.out)
    began_s = time.perf_counter()
    with tqdm(
        total=round(settings.scenario.duration_s),
        unit="s",
        desc="mission",
        delay=2.0,
        leave=False,
        disable=None,  # unless stderr is a terminal
    ) as bar:
        result = simulate(
            settings,
            arguments.terrain,
            arguments.seed,
            arguments.baseline,
            lambda now_s: advance(bar, now_s),
            arguments.store,
            folder,
        )
    evaluation = evaluate(result)
    write_outputs(result, evaluation, folder)
    took_s = time.perf_counter() - began_s
    if not arguments.no_report:
        write_report(result, evaluation, folder / "report.html")
    print("\n".join([*outcome_lines(evaluation), *result.site.remarks]))
    print(f"{settings.scenario.duration_s / took_s:.0f} x real time; outputs in {folder}")


def advance(bar: "tqdm[Never]", now_s: float) -> None:
    """Move a bar of seconds."""
    if now_s - bar.n >= 1.0:
        bar.update(int(now_s) - bar.n)


COMMAND = Command(
    name="simulate",
    help="run a mission and write its outputs",
    configure=_configure,
    run=_run,
)
