"""`fathomlink channel`: the water between vehicles' processes, and their clock."""

import argparse
import contextlib
import shlex
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from tqdm import tqdm

from host_tools.collect import Mission, result_of_record
from host_tools.commands import Command, folder_of
from host_tools.evaluation import evaluate
from host_tools.mapping import DepthMap
from host_tools.mission import Progress, run, simulated_vehicles, water_between
from host_tools.processes.emulated_modems import MODEMS, EmulatedModems, check_frames
from host_tools.processes.pace import Pace
from host_tools.processes.process_group import OnWait, ProcessGroup
from host_tools.processes.records import FOLDER, VehicleFiles
from host_tools.processes.remote_node import RemoteNode
from host_tools.processes.voyage import Voyage, add_voyage_arguments, voyage_of
from host_tools.report import write_report
from host_tools.results import MissionResult
from host_tools.simulate import advance, outcome_lines
from host_tools.simulator.vehicle import SimulatedVehicle
from host_tools.writers import forget_mission, prepare_folder, write_air, write_outputs
from protocol.acoustics import Delivery

Ready = Callable[[ProcessGroup], None]


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Let a request to terminate end things as an interrupt from the keyboard does."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def host_mission(
    voyage: Voyage,
    out: Path,
    *,
    ready: Ready,
    on_wait: OnWait,
    progress: Progress,
    ports: Path | None = None,
    pace: Pace | None = None,
    modems: str = "raw",
) -> MissionResult:
    """Return a mission whose vehicles are processes, from the files that they leave in out.

    ready is called when the ports are there; on_wait while processes are missing. modems says what
    is at the ports: raw lines that carry frames, or emulated modems of a dialect.
    """
    check_frames(modems, voyage.settings)
    vehicles = simulated_vehicles(voyage.settings, voyage.site, voyage.seed)
    water = water_between(voyage.settings, vehicles, voyage.seed)
    deliveries: list[Delivery] = []
    emulated = None if modems == "raw" else EmulatedModems(modems, water, deliveries.append)
    paced = progress if pace is None else pace.after(progress)
    duration_s, tick_s = voyage.settings.scenario.duration_s, voyage.tick_s
    with ProcessGroup(
        water,
        voyage.fingerprint,
        on_wait=on_wait,
        folder=ports,
        pace=pace,
        modems=emulated,
    ) as group:
        forget_mission(out, voyage.site.raster.path)
        ready(group)
        group.wait_for_all()
        if pace is not None:
            pace.start()
        if emulated is not None:
            emulated.run(group.nodes, duration_s=duration_s, tick_s=tick_s, progress=paced)
        else:
            run(
                group.nodes,
                water,
                duration_s=duration_s,
                tick_s=tick_s,
                record=deliveries.append,
                progress=paced,
            )
        group.end()
        lines = {f"line_{node.name}": node.status() for node in group.nodes.values()}
    return result_of_files(voyage, vehicles, out, deliveries, lines)


def result_of_files(
    voyage: Voyage,
    vehicles: Sequence[SimulatedVehicle],
    out: Path,
    deliveries: list[Delivery],
    lines: dict[str, dict[str, int]],
) -> MissionResult:
    """Return a mission from the files in out, as far as its vehicles lived to write them.

    Writes the air there first. Raises ConfigError where a vehicle left no beliefs.
    """
    write_air(deliveries, prepare_folder(out) / "air.jsonl")
    files = {vehicle.index: VehicleFiles(out, vehicle.index) for vehicle in vehicles}
    truth_map = DepthMap(voyage.site.window)
    for each in files.values():
        each.add_soundings(truth_map)
    result = result_of_record(
        Mission(
            settings=voyage.settings,
            site=voyage.site,
            seed=voyage.seed,
            vehicles=vehicles,
            deliveries=deliveries,
            truth_map=truth_map,
        ),
        [files[v.index].beliefs(v.true_track().time_s) for v in vehicles],
        files[0].record(),
        {**{each.name: each.counters() for each in files.values()}, **lines},
    )
    return replace(result, remarks=[*result.remarks, *missing_lines(result, out)])


def vehicle_command(group: ProcessGroup, node: RemoteNode, voyage: Voyage, out: Path) -> list[str]:
    """Return the arguments after `fathomlink` that start a vehicle's process."""
    name = ["leader"] if node.vehicle == 0 else ["follower", "--vehicle", str(node.vehicle)]
    ports = ["--modem", group.modem_url(node.vehicle), "--clock", group.clock_url]
    return [*name, *ports, "--out", str(out), *voyage.arguments]


def finish(result: MissionResult, out: Path, *, report: bool = True) -> list[str]:
    """Write everything of the contract; return the table of errors, and what else to tell."""
    evaluation = evaluate(result)
    write_outputs(result, evaluation, out)
    if report:
        write_report(result, evaluation, out / "report.html")
    missing = missing_lines(result, out)
    said = [*result.site.remarks, *failure_lines(result, out), *missing]
    return [*outcome_lines(evaluation), *said]


def failure_lines(result: MissionResult, out: Path) -> list[str]:
    """Return a line for every vehicle in whose loop something went wrong."""
    return [
        f"{owner}: {name} {count:g} times; see {out / FOLDER / owner}.log"
        for owner, counters in result.counters.items()
        for name, count in counters.items()
        if name.endswith("_failed")
    ]


def missing_lines(result: MissionResult, out: Path) -> list[str]:
    """Return a line for every vehicle whose process was not there to write all of its files."""
    all_files = [VehicleFiles(out, vehicle.vehicle) for vehicle in result.vehicles]
    return [
        f"{files.name} left no {', '.join(missing)}: its process was not there at the end; what it"
        f" believed ends at {files.last_belief_s():g} s, and stands still from there in all figures"
        for files in all_files
        if (missing := files.missing())
    ]


class WaitNotice:
    """Says once, each time, which processes are missing and how to start them."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._said: list[str] = []

    def __call__(self, missing: Sequence[RemoteNode]) -> None:
        """Tell of those that are missing now."""
        names = [node.name for node in missing]
        if names != self._said and names:
            at = f"the clock stands still at {missing[0].now_s:g} s: "
            self._say(f"{at}waiting for {', '.join(names)}")
        self._said = names


def add_modem_argument(parser: argparse.ArgumentParser) -> None:
    """Add what is at the ports."""
    parser.add_argument(
        "--modems",
        choices=MODEMS,
        default="raw",
        help="raw lines that carry frames (default), or emulated modems",
    )


def _configure(parser: argparse.ArgumentParser) -> None:
    add_voyage_arguments(parser)
    add_modem_argument(parser)
    parser.add_argument(
        "--real-time", action="store_true", help="follow the wall clock; default: virtual time"
    )
    parser.add_argument(
        "--ports",
        type=Path,
        metavar="DIR",
        help="where the ports' names go (default: a new one in /tmp)",
    )
    parser.add_argument(
        "--out",
        type=folder_of,
        default=Path("out/channel"),
        metavar="DIR",
        help="where the outputs go (default: %(default)s)",
    )
    parser.add_argument("--no-report", action="store_true", help="leave report.html out")


def _run(arguments: argparse.Namespace) -> None:
    out = prepare_folder(arguments.out)
    arguments.changes = [*MODEMS[arguments.modems], *arguments.changes]
    voyage = voyage_of(arguments)

    def ready(group: ProcessGroup) -> None:
        print("the ports are open; start each vehicle in a terminal of its own:")
        for node in group.nodes.values():
            print(f"\n{node.name} at {node.port.name}:")
            print("  fathomlink " + shlex.join(vehicle_command(group, node, voyage, out)))
        print(flush=True)

    total_s = round(voyage.settings.scenario.duration_s)
    mission_bar = tqdm(total=total_s, unit="s", desc="mission", leave=False, disable=None)
    with interruptible(), mission_bar as bar:
        result = host_mission(
            voyage,
            out,
            ready=ready,
            on_wait=WaitNotice(lambda line: tqdm.write(line, file=sys.stderr)),
            progress=lambda now_s: advance(bar, now_s),
            ports=arguments.ports,
            pace=Pace(voyage.tick_s) if arguments.real_time else None,
            modems=arguments.modems,
        )
    print("\n".join(finish(result, out, report=not arguments.no_report)))
    print(f"outputs in {out}")


COMMAND = Command(
    name="channel",
    help="make ports, and be the water and the clock between the vehicles on them",
    configure=_configure,
    run=_run,
)
