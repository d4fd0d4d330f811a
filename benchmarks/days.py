"""What a long mission costs: the leader's time per step, and both vehicles' memory, hour by hour.

    python -m benchmarks.days --hours 3 [--plot days.png] [--terrain FILE] [--seed 1] [--set ...]

runs `day-1`, shortened to the hours given (1, 3, 10, 24). Every vehicle is a process of its own, as
aboard, with a store; so its resident memory is its own. A step is a quarter of a second: sensors,
frames, matches, estimate and answer. Costs are of the processor, not of the clock.
"""

import argparse
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import matplotlib as mpl
import numpy as np
from threadpoolctl import threadpool_limits

from firmware.dead_reckoning import ReckonedState
from firmware.follower.core import FollowerCore
from firmware.follower.journaled import JournaledFollower
from firmware.journal import Journal, JournalSettings, Owner
from firmware.leader.journaled import JournaledLeader
from firmware.ports import SensorStep
from host_tools.commands import add_mission_arguments, settings_of
from host_tools.mission import deployed, run, simulated_vehicles, water_between
from host_tools.mission_settings import MissionSettings, changed
from host_tools.nodes import BeliefLog, FollowerNode, LeaderNode
from host_tools.simulator.placement import place_survey
from host_tools.simulator.terrain import open_terrain
from host_tools.simulator.vehicle import SimulatedVehicle
from protocol.schedule import Slots

mpl.use("Agg")
from matplotlib import pyplot as plt

PAGE_BYTES = resource.getpagesize()
Heard = tuple[bytes, float | None, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Gauge:
    """One vehicle at one moment; what is not a leader's is zero.

    position_m is its belief (2,), or, where estimates were compared, their distances (T,).
    """

    resident_mb: float
    position_m: np.ndarray
    nodes: int = 0
    records: int = 0
    closures: int = 0
    sheets: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """What a vehicle's process is told: a step of its sensors, what it heard, or to be gauged."""

    now_s: float
    step: SensorStep | None = None
    heard: tuple[Heard, ...] = ()
    gauge: bool = False
    compare: bool = False


class NoLog(BeliefLog):
    """A mission of a day keeps no beliefs in the vehicle's process."""

    def note(self, *_: object) -> None:
        """Keep nothing."""


def serve(
    link: Connection, settings: MissionSettings, vehicle: int, start: ReckonedState, folder: Path
) -> None:
    """Be a vehicle: a process that answers orders until there are no more."""
    journal = Journal(folder, Owner(vehicle=vehicle, fingerprint="days"), JournalSettings())
    slots, orders = Slots(settings.slots), _Orders()
    node: LeaderNode | FollowerNode
    if vehicle == 0:
        leader = JournaledLeader(journal, start, settings=settings.leader, slots=slots)
        node = LeaderNode(leader, orders)
    else:
        follower = JournaledFollower(
            journal, vehicle, start, settings=settings.follower, slots=slots
        )
        node = FollowerNode(follower, orders)
    node.log = NoLog()
    with threadpool_limits(1):
        while (order := link.recv()) is not None:
            if order.gauge or order.compare:
                link.send(_gauge(node, compare=order.compare))
                continue
            began_s = time.process_time()
            for heard in order.heard:
                node.hear(*heard)
            orders.step = order.step
            frame = node.tick(order.now_s)
            link.send((frame, time.process_time() - began_s))
    journal.close()


class _Orders(Iterator[SensorStep]):
    """The sensors' step of the present order."""

    step: SensorStep | None = None

    def __next__(self) -> SensorStep:
        if self.step is None:
            raise StopIteration
        return self.step


def _gauge(node: LeaderNode | FollowerNode, *, compare: bool) -> Gauge:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    resident_mb = pages * PAGE_BYTES / 1e6
    core = node.core
    if isinstance(core, FollowerCore):
        position_m = core.belief().position_m
        return Gauge(resident_mb=resident_mb, position_m=position_m)
    if compare:
        before_m = np.concatenate([core.trajectory(v).position_m for v in core.vehicles()])
        core.graph.solve_batch()
        after_m = np.concatenate([core.trajectory(v).position_m for v in core.vehicles()])
        position_m = np.hypot(*(after_m - before_m).T)
    else:
        position_m = core.belief().position_m
    return Gauge(
        resident_mb=resident_mb,
        nodes=core.graph.nodes,
        records=core.graph.records,
        closures=sum(verdict.active for verdict in core.verdicts()),
        sheets=len(core.atlas),
        position_m=position_m,
    )


class Remote:
    """A vehicle's process as the mission's clock sees it."""

    def __init__(self, process_link: Connection, vehicle: SimulatedVehicle) -> None:
        self.log: BeliefLog = NoLog()
        self.costs_s: list[float] = []
        self._link, self._steps = process_link, vehicle.steps()
        self._heard: list[Heard] = []

    def hear(self, frame: bytes, toa_s: float | None, now_s: float) -> None:
        """Keep a frame for the order of the next instant."""
        self._heard.append((frame, toa_s, now_s))

    def tick(self, now_s: float) -> bytes | None:
        """Order one step, and note what it cost."""
        order = Order(now_s=now_s, step=next(self._steps, None), heard=tuple(self._heard))
        self._heard.clear()
        self._link.send(order)
        frame, cost_s = self._link.recv()
        self.costs_s.append(cost_s)
        return None if frame is None else bytes(frame)

    def gauge(self, now_s: float, *, compare: bool = False) -> Gauge:
        """Ask how the vehicle stands."""
        self._link.send(Order(now_s=now_s, gauge=True, compare=compare))
        gauge: Gauge = self._link.recv()
        return gauge

    def close(self) -> None:
        """Let the process end."""
        self._link.send(None)


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One hour, or what there is of it."""

    hours: float
    steps_ms: np.ndarray  # (median, 99 %, 99.9 %, longest)
    leader: Gauge
    follower_mb: float
    miss_m: float  # of the leader's belief


HEAD = (
    f"{'hour':>5} {'median':>8} {'99 %':>7} {'99.9 %':>7} {'longest':>8} {'leader':>7} "
    f"{'follower':>8} {'nodes':>6} {'records':>8} {'active':>7} {'matched':>8} {'error':>6}\n"
    f"{'':>5} {'ms':>8} {'ms':>7} {'ms':>7} {'ms':>8} {'MB':>7} "
    f"{'MB':>8} {'':>6} {'':>8} {'':>7} {'sheets':>8} {'m':>6}"
)


def _line(row: Row) -> str:
    median, p99, p999, longest = row.steps_ms
    g = row.leader
    return (
        f"{row.hours:5.1f} {median:8.2f} {p99:7.1f} {p999:7.1f} {longest:8.0f} "
        f"{g.resident_mb:7.0f} {row.follower_mb:8.0f} {g.nodes:6d} {g.records:8d} "
        f"{g.closures:7d} {g.sheets:8d} {row.miss_m:6.2f}"
    )


def mission(settings: MissionSettings, terrain: Path | None, seed: int) -> Iterator[Row | Gauge]:
    """Yield a row an hour, and at the end how far a batch solution lies from the estimate."""
    scenario = settings.scenario
    site = place_survey(open_terrain(terrain, scenario.relief_seed), scenario, seed)
    vehicles = simulated_vehicles(settings, site, seed)
    rate_hz, duration_s = scenario.ping_hz, scenario.duration_s
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder:
        remotes, processes = {}, []
        for vehicle in vehicles:
            ours, theirs = context.Pipe()
            parts = (theirs, settings, vehicle.index, deployed(vehicle), Path(folder))
            processes.append(context.Process(target=serve, args=parts, daemon=True))
            processes[-1].start()
            remotes[vehicle.index] = Remote(ours, vehicle)
        rows: list[Row] = []

        def watch(now_s: float) -> None:
            if now_s == 0.0 or (now_s % 3600.0 and now_s != duration_s):
                return
            steps = round((now_s - (rows[-1].hours * 3600.0 if rows else 0.0)) * rate_hz)
            costs_ms = 1e3 * np.array(remotes[0].costs_s[-steps:])
            leader, true_m = remotes[0].gauge(now_s), vehicles[0].true_position(now_s)
            rows.append(
                Row(
                    hours=now_s / 3600.0,
                    steps_ms=np.percentile(costs_ms, [50.0, 99.0, 99.9, 100.0]),
                    leader=leader,
                    follower_mb=max((r.gauge(now_s).resident_mb for v, r in remotes.items() if v)),
                    miss_m=float(np.hypot(*(leader.position_m - true_m[:2]))),
                )
            )
            print(_line(rows[-1]), flush=True)

        run(
            remotes,
            water_between(settings, vehicles, seed),
            duration_s=duration_s,
            tick_s=1.0 / rate_hz,
            record=lambda _: None,
            progress=watch,
        )
        yield from rows
        yield remotes[0].gauge(duration_s, compare=True)
        for remote, process in zip(remotes.values(), processes, strict=True):
            remote.close()
            process.join()


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
    """Run the mission; print a line an hour, and what the issue asks of them."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.days", description=__doc__)
    add_mission_arguments(parser)
    parser.set_defaults(scenario="day-1")
    parser.add_argument("--hours", type=float, default=3.0)
    parser.add_argument("--plot", type=Path, help="a .png or .svg")
    arguments = parser.parse_args()
    minutes = 60.0 * arguments.hours
    settings = changed(
        settings_of(arguments), {"duration_min": minutes, "follower_duration_min": minutes}
    )
    print(HEAD)
    *rows, end = mission(settings, arguments.terrain, arguments.seed)
    hours = [row for row in rows if isinstance(row, Row)]
    if len(hours) > 1:
        ratio = hours[-1].steps_ms[1] / hours[1].steps_ms[1]
        print(f"99 % of the last hour's steps over that of the second: {ratio:.2f}")
    assert isinstance(end, Gauge)
    print(f"incremental against batch, farthest node: {end.position_m.max():.4f} m")
    if arguments.plot:
        draw(hours, arguments.plot)


if __name__ == "__main__":
    main()
