"""One mission trial: journaled cores in their loops, faults, then quiet, and all is well again."""

import logging
import math
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from firmware.follower.loop import FollowerLoop
from firmware.journal import JournalSettings, Owner
from firmware.journaled import Journaled
from firmware.leader.journaled import JournaledLeader
from firmware.leader.loop import LeaderLoop
from firmware.leader.worker import InlineWorker
from firmware.ports import SensorStep
from firmware.vehicle_core import VehicleCore
from firmware.vehicle_loop import VehicleLoop
from host_tools.faults.catalogue import Fault, plan_of
from host_tools.faults.computer import LocalClock, Program
from host_tools.faults.disk import Fate, FatedJournal
from host_tools.faults.held import held_bytes
from host_tools.faults.rig import RECOVERY_S, Outcome, Rig
from host_tools.faults.survey import Survey
from host_tools.kills import KilledError
from host_tools.processes.resume import navigated, resumed_core, steps_since
from protocol.acoustics import WaterSettings
from protocol.modems.sealed import SealedModem

TICK_S = 0.25
FIRST_S, SPAN_S = 60.0, 90.0
"""Faults begin within this: the first sub-map is on its way, the second being measured."""
MOST_BYTES = 6_000_000
"""What a follower holds at most: ten minutes of track, a sub-map measured, one fitted, a queue."""
LOOK_S = 30.0
ASTRAY_M = 40.0
"""Two sigmas of what a leader knows before its first closures."""
SURE_SIGMAS = 5.0
_TAKEN = (
    "frames_received",
    "frames_rejected",
    "frames_not_for_us",
    "frames_of_unknown_vehicles",
    "answers_to_others",
    "answers_used",
    "answers_without_news",
    "answers_gated",
    "answers_stale",
    "answers_restarted_us",
    "answers_unplaceable",
)


_CLOCKS = (Fault.CLOCK_AHEAD, Fault.CLOCK_BEHIND)
_SPOILERS = (Fault.STORE_CORRUPT, Fault.STORE_READ_ONLY)
"""Faults after which a store may be set aside, or done without."""


def taken(core: Journaled[VehicleCore]) -> int:
    """Return how many frames a core has taken in all its lives."""
    status = core.status()
    return sum(status.get(name, 0) for name in _TAKEN)


class Sailor:
    """A vehicle's loop for one life, and what it may say afterwards to have taken."""

    def __init__(self, core: Journaled[VehicleCore], loop: VehicleLoop) -> None:
        self.core, self.loop = core, loop
        self.acknowledged = taken(core)

    def step(self, now_s: float) -> None:
        """Let a period pass; what came in it is acknowledged if it was put on disk."""
        failed = self._failures()
        self.loop.step(now_s)
        if self._failures() == failed:
            self.acknowledged = taken(self.core)

    def _failures(self) -> int:
        """Return how often the store refused; one that is lost refuses all the time."""
        counters = self.core.recorder.journal.counters
        return (
            counters["store_commits_failed"]
            if not counters["store_lost"]
            else -1 - taken(self.core)
        )

    def abandon(self) -> None:
        """Be dead."""
        journal = self.core.recorder.journal
        assert isinstance(journal, FatedJournal)
        journal.abandon()


class MissionTrial:
    """Both vehicles under the plan of a seed, with their stores in a folder."""

    def __init__(self, seed: int, survey: Survey, folder: Path) -> None:
        self.plan = plan_of(seed, FIRST_S, SPAN_S)
        self.violations: list[str] = []
        self.most_bytes = 0
        self._survey, self._folder = survey, folder
        self._sailors: dict[int, Sailor] = {}
        self.rig = Rig(
            seed,
            self.plan,
            WaterSettings(),
            lambda vehicle, time_s: survey.vehicles[vehicle].true_position(time_s),
            self._start,
        )

    def run(self) -> Outcome:
        """Return what the trial came to."""
        outcome = self.rig.outcome(self._sail, list, self.violations)
        for computer in self.rig.computers:
            if computer.program is not None:
                computer.program.abandon()
        return outcome

    def _sail(self) -> float | None:
        """Return how long after the last fault a new sub-map was placed and an answer used."""
        last_s, base = self.plan.last_s, [0, 0]
        for step in range(int((last_s + RECOVERY_S) / TICK_S)):
            now_s = step * TICK_S
            self.rig.step(now_s)
            if now_s % LOOK_S == 0.0:
                self._look()
            if now_s <= last_s:
                base = [self._progress(0), self._progress(1)]
            elif all(self._progress(vehicle) > base[vehicle] for vehicle in (0, 1)):
                self._look()
                self._hold_beliefs_to_truth()
                return now_s - last_s
        return None

    def _hold_beliefs_to_truth(self) -> None:
        """Check that nobody was led astray: a belief may be wrong, but not wrong and sure.

        A clock that was wrong moves the truth itself.
        """
        if (self.plan.kinds(0) | self.plan.kinds(1)) & set(_CLOCKS):
            return
        for vehicle, sailor in self._sailors.items():
            truth = self._survey.vehicles[vehicle].true_position(self.rig.now_s)[:2]
            reckoned = sailor.core.reckoned
            drifted_m = math.dist((reckoned.north_m, reckoned.east_m), truth)
            belief = sailor.core.belief()
            wrong_m = math.dist(belief.position_m, truth)
            sigma_m = math.sqrt(float(np.trace(belief.covariance_m2)) / 2.0)
            if wrong_m > max(drifted_m + ASTRAY_M, SURE_SIGMAS * sigma_m):
                self.violations.append(
                    f"vehicle {vehicle} is {wrong_m:.0f} m off, dead reckoning {drifted_m:.0f} m"
                )

    def _progress(self, vehicle: int) -> int:
        """Return what a vehicle has made of the other's frames: placed sub-maps, used answers.

        An answer that is no surer than dead reckoning still gives a range.
        """
        program = self.rig.computers[vehicle].program
        if not isinstance(program, Sailor):
            return 0
        if isinstance(program.core, JournaledLeader):
            return sum(sheet.id.vehicle == 1 for sheet in program.core.core.atlas)
        status = program.core.status()
        told = ("answers_used", "answers_without_news", "ranges_used")
        return sum(status[name] for name in told)

    def _look(self) -> None:
        for vehicle, computer in enumerate(self.rig.computers):
            program = computer.program
            if not isinstance(program, Sailor):
                continue
            for name, count in {**program.loop.status(), **program.core.status()}.items():
                if count and (name.endswith("_failed") and name != "store_commits_failed"):
                    self.violations.append(f"vehicle {vehicle}: {name} {count}")
            if vehicle == 1:
                held = held_bytes(program.core)
                self.most_bytes = max(self.most_bytes, held)
                if held > MOST_BYTES:
                    self.violations.append(f"vehicle {vehicle} holds {held} bytes")

    def _start(self, vehicle: int, modem: SealedModem, fate: Fate, now_s: float) -> Program:
        settings = self._survey.settings
        clock = LocalClock(vehicle, self.plan)
        steps = self._survey.steps(vehicle, clock, self.rig.now_s)
        start, passed, steps = navigated(self._survey.start(vehicle), steps, now_s)
        owner = Owner(vehicle=vehicle, fingerprint="faults")
        kept = JournalSettings(checkpoint_s=30.0)
        journal = FatedJournal(self._folder, owner, kept, fate, began_s=now_s)
        try:
            core = resumed_core(journal, vehicle, start, settings, now_s)
            self._hold_to_account(vehicle, core, fate)
            for odometry, _ in steps_since(core, passed, pings=False):
                core.receive_odometry(odometry)
        except KilledError:  # before there is a program to be abandoned
            journal.abandon()
            raise
        self._sailors[vehicle] = Sailor(core, _loop(core, modem, steps))
        return self._sailors[vehicle]

    def _hold_to_account(self, vehicle: int, core: Journaled[VehicleCore], fate: Fate) -> None:
        """Check that a restart has everything that an earlier life acknowledged."""
        owed = self._sailors[vehicle].acknowledged if vehicle in self._sailors else 0
        counters = core.recorder.journal.counters
        if counters["store_set_aside"] or counters["store_lost"]:
            excused = set(_CLOCKS) & self.plan.kinds(vehicle)
            if self.plan.active(Fault.DISK_FULL, vehicle, self.rig.now_s) is not None:
                excused.add(Fault.DISK_FULL)
            if not excused and fate.struck not in _SPOILERS:
                self.violations.append(f"vehicle {vehicle} lost its store after {fate.struck}")
        elif taken(core) < owed and fate.struck is not Fault.STORE_CORRUPT:  # a damaged log is cut
            lost = owed - taken(core)
            self.violations.append(f"vehicle {vehicle} lost {lost} frames that it acknowledged")


def _loop(
    core: Journaled[VehicleCore], modem: SealedModem, steps: Iterator[SensorStep]
) -> VehicleLoop:
    if isinstance(core, JournaledLeader):
        return LeaderLoop(core, modem, steps, InlineWorker(), lambda: 0.0, TICK_S)
    return FollowerLoop(core, modem, steps, lambda: 0.0, TICK_S)


def mission_trial(seed: int, survey: Survey) -> Outcome:
    """Return the outcome of one seed."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as name:
        disabled = logging.root.manager.disable
        logging.disable(logging.CRITICAL)  # thousands of lost ports and stores are no news
        try:
            return MissionTrial(seed, survey, Path(name)).run()
        finally:
            logging.disable(disabled)
