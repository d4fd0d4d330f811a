"""A vehicle of `benchmarks.days`: a process of its own that imports only what is aboard.

    python -m benchmarks.days_vehicle FD

has a link to the mission at this descriptor, is told what it is, and then answers orders until
there are no more.
"""

import resource
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from firmware.dead_reckoning import ReckonedState
from firmware.heap import give_back_large_blocks
from firmware.journal import Journal, JournalSettings, Owner
from firmware.journaled import bare
from firmware.ports import SensorStep
from host_tools.nodes import BeliefLog, FollowerNode, LeaderNode
from protocol.schedule import Slots, SlotSettings

PAGE_BYTES = resource.getpagesize()
Heard = tuple[bytes, float | None, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Aboard:
    """What a vehicle's process is told first; its store lies in a folder."""

    vehicle: int
    settings: Any  # FollowerSettings or LeaderSettings, neither of which all vehicles know
    slots: SlotSettings
    start: ReckonedState
    folder: Path


@dataclass(frozen=True, slots=True, kw_only=True)
class Gauge:
    """One vehicle at one moment; what is not a leader's is zero.

    position_m is its belief (2,), or, where estimates were compared, their distances (T,).
    """

    time_s: float
    cpu_s: float  # of all threads since the process began
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


def serve(link: Connection) -> None:
    """Be the vehicle that the first message tells of, and answer orders until there are no more."""
    aboard: Aboard = link.recv()
    owner = Owner(vehicle=aboard.vehicle, fingerprint="days")
    journal = Journal(aboard.folder, owner, JournalSettings())
    orders = _Orders()
    node = _node(aboard, journal, orders)
    node.log = NoLog()
    with threadpool_limits(1):
        while (order := link.recv()) is not None:
            if order.gauge or order.compare:
                link.send(_gauge(node, order.now_s, compare=order.compare))
                continue
            began_s = time.thread_time()
            for heard in order.heard:
                node.hear(*heard)
            orders.step = order.step
            frame = node.tick(order.now_s)
            link.send((frame, time.thread_time() - began_s))
    journal.close()


class _Orders(Iterator[SensorStep]):
    """The sensors' step of the present order."""

    step: SensorStep | None = None

    def __next__(self) -> SensorStep:
        if self.step is None:
            raise StopIteration
        return self.step


def _gauge(node: LeaderNode | FollowerNode, now_s: float, *, compare: bool) -> Gauge:
    cpu_s = time.process_time()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    resident_mb = pages * PAGE_BYTES / 1e6
    if isinstance(node, FollowerNode):
        position_m = node.core.belief().position_m
        return Gauge(time_s=now_s, cpu_s=cpu_s, resident_mb=resident_mb, position_m=position_m)
    core = bare(node.core)
    if compare:
        before_m = np.concatenate([core.trajectory(v).position_m for v in core.vehicles()])
        core.graph.solve_batch()
        after_m = np.concatenate([core.trajectory(v).position_m for v in core.vehicles()])
        position_m = np.hypot(*(after_m - before_m).T)
    else:
        position_m = node.core.belief().position_m
    return Gauge(
        time_s=now_s,
        cpu_s=cpu_s,
        resident_mb=resident_mb,
        nodes=core.graph.nodes,
        records=core.graph.records,
        closures=sum(verdict.active for verdict in core.verdicts()),
        sheets=len(core.atlas),
        position_m=position_m,
    )


def _node(aboard: Aboard, journal: Journal, orders: "_Orders") -> LeaderNode | FollowerNode:
    """Return the vehicle; the other kind's modules stay out of the process."""
    slots, settings = Slots(aboard.slots), aboard.settings
    if aboard.vehicle == 0:
        from firmware.leader.journaled import JournaledLeader  # noqa: PLC0415

        leader = JournaledLeader(journal, aboard.start, settings=settings, slots=slots)
        return LeaderNode(leader, orders)
    from firmware.follower.journaled import JournaledFollower  # noqa: PLC0415

    follower = JournaledFollower(
        journal, aboard.vehicle, aboard.start, settings=settings, slots=slots
    )
    return FollowerNode(follower, orders)


if __name__ == "__main__":
    from benchmarks import days_vehicle  # so that what is sent is not of a __main__ of its own

    give_back_large_blocks()
    with Connection(int(sys.argv[1])) as mission:
        days_vehicle.serve(mission)
