"""`fathomlink demo`: a mission of two processes over ports of this computer, in virtual time."""

import argparse
import contextlib
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from tqdm import tqdm

from host_tools.commands import Command, folder_of
from host_tools.processes.channel import (
    add_modem_argument,
    finish,
    host_mission,
    interruptible,
    vehicle_command,
)
from host_tools.processes.emulated_modems import MODEMS
from host_tools.processes.process_group import ProcessGroup
from host_tools.processes.records import FOLDER
from host_tools.processes.remote_node import RemoteNode
from host_tools.processes.voyage import Voyage, add_voyage_arguments, voyage_of
from host_tools.simulate import advance
from host_tools.writers import prepare_folder
from protocol.errors import FathomError

SHORTENED = ("duration_min=24", "follower_duration_min=18")
"""Unless told: in paper-1 the first closures and what they mend, within three minutes."""
GRACE_S = 5.0
"""Of real time, that a process is given to end before it is killed."""


class ProcessEndedError(FathomError):
    """A vehicle's process ended before the mission did."""


@dataclass(slots=True)
class _Child:
    """A vehicle's process, and what it says on stderr."""

    name: str
    process: "subprocess.Popen[bytes]"
    log: Path


class Crew:
    """The vehicles' processes: started together, ended together."""

    def __init__(self) -> None:
        self._children: list[_Child] = []

    def start(self, name: str, arguments: Sequence[str], log: Path) -> None:
        """Start one process of this program."""
        stream: IO[bytes]
        with log.open("wb") as stream:
            process = subprocess.Popen(
                [sys.executable, "-m", "host_tools.cli", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=stream,
                start_new_session=True,  # Ctrl-C is for this program, which ends the others
            )
        self._children.append(_Child(name, process, log))

    def check(self, missing: Sequence[RemoteNode]) -> None:
        """Raise ProcessEndedError when a process has ended that is missing."""
        names = {node.name for node in missing}
        for child in self._children:
            status = child.process.poll()
            if status is not None and child.name in names:
                raise ProcessEndedError(
                    f"{child.name} ended with status {status}: {_last_line(child)}"
                )

    def end(self) -> None:
        """End all processes that still run, in bounded time."""
        for child in self._children:
            if child.process.poll() is None:
                child.process.terminate()
        end_s = time.monotonic() + GRACE_S
        for child in self._children:
            try:
                child.process.wait(max(0.0, end_s - time.monotonic()))
            except subprocess.TimeoutExpired:
                child.process.kill()
                child.process.wait()


@contextlib.contextmanager
def crew() -> Iterator[Crew]:
    """Give a crew, and end its processes whatever happens, a request to terminate among it."""
    processes = Crew()
    with interruptible():
        try:
            yield processes
        finally:
            processes.end()


def run_demo(
    voyage: Voyage,
    out: Path,
    progress: Callable[[float], None],
    *,
    report: bool = True,
    modems: str = "raw",
) -> list[str]:
    """Run a mission with every vehicle in its own process; return the table of errors."""
    with crew() as processes:

        def ready(group: ProcessGroup) -> None:
            (out / FOLDER).mkdir(exist_ok=True)
            for node in group.nodes.values():
                arguments = vehicle_command(group, node, voyage, out)
                processes.start(node.name, arguments, out / FOLDER / f"{node.name}.log")

        result = host_mission(
            voyage, out, ready=ready, on_wait=processes.check, progress=progress, modems=modems
        )
    return finish(result, out, report=report)


def _last_line(child: _Child) -> str:
    lines = child.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1] if lines else f"see {child.log}"


def _configure(parser: argparse.ArgumentParser) -> None:
    add_voyage_arguments(parser)
    add_modem_argument(parser)
    parser.add_argument(
        "--out", type=folder_of, default=Path("out/demo"), metavar="DIR", help="default: out/demo"
    )


def _run(arguments: argparse.Namespace) -> None:
    out = prepare_folder(arguments.out)
    told = Path(arguments.scenario).is_file() or any("duration_min" in c for c in arguments.changes)
    shortened = () if told else SHORTENED
    arguments.changes = [*MODEMS[arguments.modems], *shortened, *arguments.changes]
    voyage = voyage_of(arguments)
    total_s = round(voyage.settings.scenario.duration_s)
    began_s = time.monotonic()
    scenario = voyage.settings.scenario
    print(
        f"{scenario.name}{' cut to' if shortened else ','} {scenario.duration_min:g} minutes "
        "(--set duration_min=...), "
        f"{1 + scenario.followers} vehicles, each a process, over a "
        f"{scenario.water.rate_bps / 1000.0:g} kbit/s link that loses "
        f"{scenario.water.loss:.0%}; time is virtual",
        flush=True,
    )
    with tqdm(total=total_s, unit="s", desc="mission", leave=False, disable=None) as bar:
        lines = run_demo(voyage, out, lambda now_s: advance(bar, now_s), modems=arguments.modems)
    print("\n".join(lines))
    took_s = time.monotonic() - began_s
    print(f"{took_s:.0f} s in all; {out / 'report.html'}")


COMMAND = Command(
    name="demo",
    help="run a leader and a follower as processes of their own, and report",
    configure=_configure,
    run=_run,
)
