"""`fathomlink follower` and `fathomlink leader`: one vehicle, its loop on its modem's port."""

import argparse
import contextlib
import dataclasses
import datetime
import itertools
import logging
import math
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from firmware.boot_epochs import LIFE_S
from firmware.clock import WallClock
from firmware.follower.loop import FollowerLoop
from firmware.heap import give_back_large_blocks
from firmware.journaled import Journaled, bare
from firmware.leader.core import LeaderCore
from firmware.leader.journaled import JournaledLeader
from firmware.leader.loop import LeaderLoop
from firmware.leader.worker import InlineWorker, ThreadWorker, Worker
from firmware.ports import SensorStep
from firmware.vehicle_core import VehicleCore
from firmware.vehicle_loop import VehicleLoop
from host_tools.collect import leader_record
from host_tools.commands import Command, folder_of
from host_tools.link_status import advice_lines
from host_tools.mapping import DepthMap
from host_tools.mission import deployed
from host_tools.processes.records import VehicleFiles
from host_tools.processes.resume import (
    SilentModem,
    missed_instants,
    navigated,
    open_core,
    plain_core,
    prepare_store,
    steps_since,
)
from host_tools.processes.sealing import seal_of, sealed_voyage
from host_tools.processes.served_clock import CountedLine, ServedClock, StampedModem
from host_tools.processes.starts import NEXT, lasting_start_s, start_time_s
from host_tools.processes.voyage import Voyage, add_voyage_arguments, voyage_of
from host_tools.simulator.vehicle import SimulatedVehicle
from protocol.errors import ConfigError
from protocol.modems.base import Modem, ModemContext, Tap
from protocol.modems.dialect_driver import DialectDriver, await_identified, check_frame_size
from protocol.modems.raw_log import RawLog, new_log
from protocol.modems.registry import open_modem
from protocol.modems.sealed import SealedModem
from protocol.vehicles import BOOT_EPOCHS, LEADER, name_of

LOG = logging.getLogger(__name__)
STATUS_S = 60.0
WALL = "wall"


@dataclass(slots=True)
class Aboard:
    """A vehicle's loop with what it was started from."""

    loop: VehicleLoop
    worker: Worker
    voyage: Voyage
    truth_map: DepthMap
    files: VehicleFiles | None
    clock: WallClock | ServedClock | None = None

    def status(self) -> dict[str, int]:
        """Return every counter of the loop, and of a clock that counts."""
        counts = self.clock.status() if isinstance(self.clock, WallClock) else {}
        return {**self.loop.status(), **counts}


def run_vehicle(
    vehicle: int,
    modem_url: str,
    clock_url: str,
    voyage: Voyage,
    out: Path | None,
    start: str,
    store: Path | None = None,
    key: Path | None = None,
    *,
    encrypts: bool = False,
    tap: Tap | None = None,
) -> None:
    """Run one vehicle from its clock's first tick to its last, and write its files.

    What its modem says and hears goes to a tap as well.
    """
    if store is not None:
        prepare_store(store)
    seal = None if key is None else seal_of(vehicle, key, store, encrypts=encrypts)
    sealed = voyage if seal is None else sealed_voyage(voyage)
    is_at_sea = store is not None and (store / f"{name_of(vehicle)}.sqlite").exists()
    context = ModemContext(tap=tap) if seal is None else ModemContext(tap=tap, stamp=seal.stamp)
    modem, clock = _modem_and_clock(
        vehicle, modem_url, clock_url, voyage, start, store, context, must_answer=not is_at_sea
    )
    modem = modem if seal is None else SealedModem(modem, seal)
    files = None if out is None else VehicleFiles(out, vehicle)
    try:
        starts = None if files is None else files.prepare()
        follower = voyage.settings.follower
        check_frame_size(modem.largest_frame_bytes, follower.frame_bytes, follower.profile)
        ticks = clock.ticks(voyage.tick_s)
        first_s = next(ticks, None)
        if first_s is None and not is_at_sea:
            if isinstance(clock, ServedClock):
                clock.end()  # lest the others wait for our files
            raise ConfigError(
                "the mission is over and no store holds it; give a later --start, or --store DIR"
                " from the beginning"
            )
        if first_s is None:  # it was killed after its last instant: the store has the mission
            first_s = voyage.settings.scenario.duration_s + voyage.tick_s
            sailed: Iterator[float] = iter(())
        else:
            sailed = itertools.chain([first_s], ticks)
        aboard = _board(vehicle, starts, modem, clock, sealed, files, first_s, store)
        _sail(aboard, sailed, on_wall=isinstance(clock, WallClock))
        aboard.worker.close()
        with _committed(aboard.loop.core):
            _write(aboard, voyage)
        if isinstance(clock, ServedClock):
            clock.end()
    finally:
        if isinstance(clock, ServedClock):
            clock.close()
        modem.close()


def _sail(aboard: Aboard, ticks: Iterator[float], *, on_wall: bool) -> None:
    """Step the loop; Ctrl-C in real time ends the mission as its last tick does."""
    try:
        for now_s in ticks:
            aboard.loop.step(now_s)
            if now_s != math.floor(now_s):
                continue
            try:
                _report(aboard, now_s, on_wall=on_wall)
            except Exception:  # a full disk, say: the vehicle sails on without its report
                LOG.exception("no report at %g s", now_s)
    except KeyboardInterrupt:
        if not on_wall:
            raise


def _report(aboard: Aboard, now_s: float, *, on_wall: bool) -> None:
    """Write down a second's belief, and now and then what the counters say."""
    core = aboard.loop.core
    if aboard.files is not None:
        aboard.files.note(core.belief(), core.reckoned)
    if now_s % STATUS_S != 0.0:
        return
    if aboard.files is not None:
        aboard.files.write_counters(aboard.status())
    if on_wall:
        print(_status_line(now_s, aboard.status()), file=sys.stderr)
    for line in advice_lines(aboard.status()):
        print(line, file=sys.stderr)


def _board(
    vehicle: int,
    starts: int | None,
    modem: Modem,
    clock: WallClock | ServedClock,
    voyage: Voyage,
    files: VehicleFiles | None,
    first_s: float,
    store: Path | None,
) -> Aboard:
    """Return the vehicle with core, loop and sensors as of its first tick.

    starts is how often it started before; None where nobody knows, and the clock tells boots.
    """
    truth_map = DepthMap(voyage.site.window)
    simulated = SimulatedVehicle(
        voyage.settings.scenario, voyage.site.seabed, vehicle, voyage.seed, truth_map.add
    )
    start, passed, steps = navigated(deployed(simulated), simulated.steps(), first_s)
    boot = math.floor(first_s / LIFE_S) if starts is None else starts
    core = (
        plain_core(vehicle, boot % BOOT_EPOCHS, start, voyage)
        if store is None
        else open_core(vehicle, store, start, voyage, first_s)
    )
    in_real_time = isinstance(clock, WallClock) or clock.in_real_time
    worker: Worker = ThreadWorker() if in_real_time else InlineWorker()
    loop = _loop(core, modem, steps, worker, clock.now_s, voyage.tick_s)
    aboard = Aboard(
        loop=loop, worker=worker, voyage=voyage, truth_map=truth_map, files=files, clock=clock
    )
    if isinstance(core, Journaled):
        _catch_up(aboard, core, passed, first_s, in_real_time=in_real_time)
    return aboard


def _loop(
    core: VehicleCore,
    modem: Modem,
    steps: Iterator[SensorStep],
    worker: Worker,
    stopwatch: Callable[[], float],
    period_s: float,
) -> VehicleLoop:
    if isinstance(core, LeaderCore | JournaledLeader):
        return LeaderLoop(core, modem, steps, worker, stopwatch, period_s)
    return FollowerLoop(core, modem, steps, stopwatch, period_s)


def _catch_up(
    aboard: Aboard,
    core: Journaled[VehicleCore],
    passed: list[SensorStep],
    first_s: float,
    *,
    in_real_time: bool,
) -> None:
    """Take what the store lacks; in virtual time live it again, in real time only navigate it.

    The last instant that the store holds is noted again: its belief may have come after it.
    """
    if in_real_time:
        for odometry, _ in steps_since(core, passed, pings=False):
            core.receive_odometry(odometry)
        return
    tick_s, last_s = aboard.voyage.tick_s, core.recorder.last_tick_s
    missed, steps = missed_instants(core, first_s, tick_s), steps_since(core, passed, pings=True)
    is_whole = core.recorder.unfinished_from_s(tick_s) > last_s and last_s == math.floor(last_s)
    if is_whole and aboard.files is not None:
        aboard.files.note(core.belief(), core.reckoned)
    silent = _loop(core, SilentModem(), steps, aboard.worker, lambda: 0.0, tick_s)
    _sail(dataclasses.replace(aboard, loop=silent), iter(missed), on_wall=False)


def _modem_and_clock(
    vehicle: int,
    modem_url: str,
    clock_url: str,
    voyage: Voyage,
    start: str,
    store: Path | None,
    context: ModemContext,
    *,
    must_answer: bool,
) -> tuple[Modem, WallClock | ServedClock]:
    """Return both; on a desk a modem must answer, at sea it may be restarting as we are."""
    if clock_url == WALL:
        modem = open_modem(modem_url, context)
        start_utc_s, duration_s = start_time_s(start), voyage.settings.scenario.duration_s
        if start == NEXT and store is not None:
            start_utc_s = lasting_start_s(store, vehicle, start_utc_s, duration_s)
        wall = WallClock(start_utc_s, duration_s)
        if must_answer and isinstance(modem, DialectDriver):
            await_identified(modem, wall.now_s, time.sleep)
        began = datetime.datetime.fromtimestamp(start_utc_s, datetime.UTC)
        print(f"the mission starts at {began:%Y-%m-%d %H:%M:%S} UTC", file=sys.stderr)
        return modem, wall
    if modem_url.startswith("serial:"):
        stamped = StampedModem(open_modem(modem_url, context))
        return stamped, ServedClock(clock_url, vehicle, voyage.fingerprint, stamped)
    line = CountedLine(context.tap)
    modem = open_modem(modem_url, dataclasses.replace(context, tap=line.tap))
    return modem, ServedClock(clock_url, vehicle, voyage.fingerprint, line)


@contextlib.contextmanager
def _committed(core: VehicleCore) -> Iterator[None]:
    """Commit to a core's store, if it has one, and close it behind what reads from its shelf."""
    journal = core.recorder.journal if isinstance(core, Journaled) else None
    if journal is not None:
        journal.commit()
    try:
        yield
    finally:
        if journal is not None:
            journal.close()


def _write(aboard: Aboard, voyage: Voyage) -> None:
    if aboard.files is None:
        print(_status_line(voyage.settings.scenario.duration_s, aboard.status()))
        return
    aboard.files.write_soundings(aboard.truth_map)
    core = bare(aboard.loop.core)
    if isinstance(core, LeaderCore):
        seconds = math.floor(voyage.settings.scenario.duration_s) + 1
        time_s = np.arange(0.0, seconds)
        aboard.files.write_record(leader_record(core, time_s, voyage.site.window))
    aboard.files.write_counters(aboard.status())


def _status_line(now_s: float, counters: dict[str, int]) -> str:
    shown = ", ".join(f"{name} {count}" for name, count in sorted(counters.items()) if count)
    return f"{now_s:.0f} s: {shown}"


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--modem", required=True, metavar="URL", help="such as serial:///dev/ttyUSB0?baud=19200"
    )
    parser.add_argument(
        "--clock",
        default=WALL,
        metavar="wall|unix://PATH",
        help="wall: this computer's UTC (default); or the name that `fathomlink channel` prints",
    )
    parser.add_argument(
        "--start",
        default=NEXT,
        metavar="UTC",
        help="with the wall clock; default: next minute, or that of the --store",
    )
    parser.add_argument("--out", type=folder_of, metavar="DIR", help="where the vehicle's files go")
    parser.add_argument(
        "--store", type=Path, metavar="DIR", help="what a restart resumes from; default: none"
    )
    parser.add_argument(
        "--key", type=Path, metavar="FILE", help="seal all frames with this key; needs --store"
    )
    parser.add_argument(
        "--encrypt", action="store_true", help="with --key: hide what frames say too (AES-CCM)"
    )
    parser.add_argument(
        "--raw-log", type=Path, metavar="FILE", help="every byte of the modem's line; default: none"
    )
    add_voyage_arguments(parser)


def _configure_follower(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--vehicle", type=int, default=1, metavar="N", help="number (default: 1)")
    _configure(parser)


def _run_follower(arguments: argparse.Namespace) -> None:
    voyage = voyage_of(arguments)
    followers = voyage.settings.scenario.followers
    if not 1 <= arguments.vehicle <= followers:
        raise ConfigError(
            f"--vehicle is {arguments.vehicle}; this scenario's followers are 1 to {followers}"
        )
    _run(arguments.vehicle, arguments, voyage)


def _run_leader(arguments: argparse.Namespace) -> None:
    _run(LEADER, arguments, voyage_of(arguments))


def _run(vehicle: int, arguments: argparse.Namespace, voyage: Voyage) -> None:
    a = arguments
    if a.encrypt and a.key is None:
        raise ConfigError("--encrypt needs --key FILE, and the same at every vehicle")
    give_back_large_blocks()
    with contextlib.nullcontext() if a.raw_log is None else new_log(a.raw_log) as file:
        run_vehicle(
            vehicle,
            a.modem,
            a.clock,
            voyage,
            a.out,
            a.start,
            a.store,
            a.key,
            encrypts=a.encrypt,
            tap=None if file is None else RawLog(file),
        )


FOLLOWER = Command(
    name="follower",
    help="run a follower on a modem",
    configure=_configure_follower,
    run=_run_follower,
)
LEADER_COMMAND = Command(
    name="leader", help="run the leader on a modem", configure=_configure, run=_run_leader
)
