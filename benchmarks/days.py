"""What a long mission costs: time per step, processor and memory, hour by hour.

    python -m benchmarks.days --hours 3 [--plot days.png] [--terrain FILE] [--seed 1] [--set ...]

runs `day-1`, shortened to the hours given (1, 3, 10, 24). Every vehicle is a process of its own, as
aboard, with a store; so its resident memory is its own. A step is a quarter of a second: sensors,
frames, matches, estimate and answer. Costs are of the processor, not of the clock: of steps that
of their thread, of a minute of the mission that of the whole process.
"""

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import Pipe
from pathlib import Path

import matplotlib as mpl
import numpy as np

from benchmarks.days_vehicle import Aboard, Gauge, Heard, NoLog, Order
from host_tools.commands import add_seed_argument, add_survey_arguments, settings_of, status_of
from host_tools.mission import deployed, run, simulated_vehicles, water_between
from host_tools.mission_settings import MissionSettings, changed
from host_tools.nodes import BeliefLog
from host_tools.simulator.placement import place_survey
from host_tools.simulator.terrain import open_terrain
from host_tools.simulator.vehicle import SimulatedVehicle
from protocol.vehicles import name_of

mpl.use("Agg")
from matplotlib import pyplot as plt


class Remote:
    """A vehicle's process as the mission's clock sees it; SystemExit where it ends too soon."""

    def __init__(self, vehicle: SimulatedVehicle, aboard: Aboard) -> None:
        self.log: BeliefLog = NoLog()
        self.costs_s: list[float] = []
        self._name, self._steps = name_of(vehicle.index), vehicle.steps()
        self._heard: list[Heard] = []
        self._link, end = Pipe()
        command = [sys.executable, "-m", "benchmarks.days_vehicle", str(end.fileno())]
        with end:  # once it is closed here, a process that ends closes the link
            self._process = subprocess.Popen(command, pass_fds=[end.fileno()])
        with suppress(OSError):  # the first order finds that the process has ended
            self._link.send(aboard)

    def hear(self, frame: bytes, toa_s: float | None, now_s: float) -> None:
        """Keep a frame for the order of the next instant."""
        self._heard.append((frame, toa_s, now_s))

    def tick(self, now_s: float) -> bytes | None:
        """Order one step, and note what it cost."""
        order = Order(now_s=now_s, step=next(self._steps, None), heard=tuple(self._heard))
        self._heard.clear()
        with self._alive(now_s):
            self._link.send(order)
            frame, cost_s = self._link.recv()
        self.costs_s.append(cost_s)
        return None if frame is None else bytes(frame)

    def gauge(self, now_s: float, *, compare: bool = False) -> Gauge:
        """Ask how the vehicle stands."""
        with self._alive(now_s):
            self._link.send(Order(now_s=now_s, gauge=True, compare=compare))
            gauge: Gauge = self._link.recv()
        return gauge

    def close(self) -> None:
        """Let the process end, and wait for it."""
        with suppress(OSError):  # it has ended already
            self._link.send(None)
        self._process.wait()

    @contextmanager
    def _alive(self, now_s: float) -> Iterator[None]:
        try:
            yield
        except (EOFError, OSError):
            raise SystemExit(
                f"{self._name}: its process ended at {now_s:g} s of the mission with"
                f" status {self._process.wait()}; its own words, if any, stand above"
            ) from None


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One hour, or what there is of it; a follower's figures are those of the costliest."""

    hours: float
    steps_ms: np.ndarray  # the leader's: (median, 99 %, 99.9 %, longest)
    leader_cpu_s: float  # a minute of the mission
    follower_cpu_s: float  # a minute of the mission
    leader: Gauge
    follower_mb: float
    miss_m: float  # of the leader's belief


HEAD = (
    f"{'hour':>5} {'median':>8} {'99 %':>7} {'99.9 %':>7} {'longest':>8} {'leader':>7} "
    f"{'follower':>8} {'leader':>7} {'follower':>8} {'nodes':>6} {'records':>8} {'active':>7} "
    f"{'matched':>8} {'error':>6}\n"
    f"{'':>5} {'ms':>8} {'ms':>7} {'ms':>7} {'ms':>8} {'s/min':>7} "
    f"{'s/min':>8} {'MB':>7} {'MB':>8} {'':>6} {'':>8} {'':>7} {'sheets':>8} {'m':>6}"
)


def _line(row: Row) -> str:
    median, p99, p999, longest = row.steps_ms
    g = row.leader
    return (
        f"{row.hours:5.1f} {median:8.2f} {p99:7.1f} {p999:7.1f} {longest:8.0f} "
        f"{row.leader_cpu_s:7.2f} {row.follower_cpu_s:8.2f} "
        f"{g.resident_mb:7.0f} {row.follower_mb:8.0f} {g.nodes:6d} {g.records:8d} "
        f"{g.closures:7d} {g.sheets:8d} {row.miss_m:6.2f}"
    )


def _row(
    before: list[Gauge], after: list[Gauge], costs_s: list[float], true_m: tuple[float, float]
) -> Row:
    """Return what happened between two gauges of all vehicles; the leader comes first."""
    minutes = (after[0].time_s - before[0].time_s) / 60.0
    cpu_s = [(b.cpu_s - a.cpu_s) / minutes for a, b in zip(before, after, strict=True)]
    return Row(
        hours=after[0].time_s / 3600.0,
        steps_ms=np.percentile(1e3 * np.array(costs_s), [50.0, 99.0, 99.9, 100.0]),
        leader_cpu_s=cpu_s[0],
        follower_cpu_s=max(cpu_s[1:]),
        leader=after[0],
        follower_mb=max(gauge.resident_mb for gauge in after[1:]),
        miss_m=float(np.hypot(*(after[0].position_m - np.array(true_m)))),
    )


def mission(
    settings: MissionSettings, terrain: Path | None, seed: int
) -> tuple[list[Row], np.ndarray]:
    """Run a mission and print a line an hour; return them as rows.

    The second value is how far, in m (T,), a batch solution lies from the estimate at the end.
    """
    scenario = settings.scenario
    site = place_survey(open_terrain(terrain, scenario.relief_seed), scenario, seed)
    vehicles = simulated_vehicles(settings, site, seed)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as processes:
        remotes = {}
        for vehicle in vehicles:
            aboard = Aboard(
                vehicle=vehicle.index,
                settings=settings.follower if vehicle.index else settings.leader,
                slots=settings.slots,
                start=deployed(vehicle),
                folder=Path(folder),
            )
            remote = processes.enter_context(closing(Remote(vehicle, aboard)))
            remotes[vehicle.index] = remote
        rows: list[Row] = []
        gauges = [[remote.gauge(0.0) for remote in remotes.values()]]

        def watch(now_s: float) -> None:
            if now_s == 0.0 or (now_s % 3600.0 and now_s != scenario.duration_s):
                return
            gauges.append([remote.gauge(now_s) for remote in remotes.values()])
            true_m = vehicles[0].true_position(now_s)[:2]
            rows.append(_row(gauges[-2], gauges[-1], remotes[0].costs_s, true_m))
            remotes[0].costs_s.clear()
            print(_line(rows[-1]), flush=True)

        run(
            remotes,
            water_between(settings, vehicles, seed),
            duration_s=scenario.duration_s,
            tick_s=scenario.tick_s,
            record=lambda _: None,
            progress=watch,
        )
        return rows, remotes[0].gauge(scenario.duration_s, compare=True).position_m


def lasting(settings: MissionSettings, hours: float) -> MissionSettings:
    """Return the settings of a mission in which all vehicles survey for some hours."""
    minutes = round(3600.0 * hours) / 60.0  # whole seconds: an hour's end is a tick
    return changed(settings, {"duration_min": minutes, "follower_duration_min": minutes})


def draw(rows: list[Row], path: Path) -> None:
    """Draw cost and memory over the hours."""
    figure, axes = plt.subplots(1, 2, figsize=(11.0, 4.0), layout="constrained")
    hours = [row.hours for row in rows]
    for k, name in enumerate(("median", "99 %", "99.9 %", "longest")):
        axes[0].semilogy(hours, [row.steps_ms[k] for row in rows], "o-", ms=3, label=name)
    axes[0].set(xlabel="hours", ylabel="leader's step (ms of one core)")
    axes[1].plot(hours, [row.leader.resident_mb for row in rows], "o-", ms=3, label="leader")
    axes[1].plot(hours, [row.follower_mb for row in rows], "o-", ms=3, label="follower")
    axes[1].set(xlabel="hours", ylabel="resident (MB)", ylim=(0.0, None))
    for panel in axes:
        panel.grid(alpha=0.3)
        panel.legend()
    figure.savefig(path, dpi=120)


def main() -> None:
    """Run the mission; print a line an hour, how steps grew, and how far a batch lies."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.days", description=__doc__)
    add_survey_arguments(parser)
    add_seed_argument(parser)
    parser.set_defaults(scenario="day-1")
    parser.add_argument("--hours", type=float, default=3.0)
    parser.add_argument("--plot", type=Path, help="a .png or .svg")
    arguments = parser.parse_args()
    settings = lasting(settings_of(arguments), arguments.hours)
    print(HEAD)
    hours, batch_m = mission(settings, arguments.terrain, arguments.seed)
    if len(hours) > 2:
        ratio = hours[-1].steps_ms[1] / hours[1].steps_ms[1]
        print(f"99 % of the last hour's steps over that of the second: {ratio:.2f}")
    print(f"incremental against batch, farthest node: {batch_m.max():.4f} m")
    if arguments.plot:
        draw(hours, arguments.plot)


if __name__ == "__main__":
    sys.exit(status_of("benchmarks.days", main))
