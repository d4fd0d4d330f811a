"""A vehicle's process that comes back from its store, and takes up the mission where it was cut."""

import itertools
from collections import deque
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

from firmware.dead_reckoning import DeadReckoning, ReckonedState
from firmware.follower.core import FollowerCore
from firmware.follower.journaled import JournaledFollower
from firmware.journal import Journal, JournalSettings, Owner
from firmware.journaled import Journaled
from firmware.leader.core import LeaderCore
from firmware.leader.journaled import JournaledLeader
from firmware.ports import SensorStep
from firmware.vehicle_core import VehicleCore
from host_tools.mission_settings import MissionSettings
from host_tools.processes.voyage import Voyage
from protocol.errors import ConfigError
from protocol.modems.base import ModemEvent, ModemStatus
from protocol.schedule import Slots

PINGS_KEPT = 256
"""What the sensors hold for a computer that restarts: a minute of pings ..."""
STEPS_KEPT = 100_000
"""... and seven hours of navigation."""


class SilentModem:
    """Stands for the modem while a vehicle catches up: nothing is heard, nothing leaves."""

    largest_frame_bytes = 256
    lead_s = 0.0
    frames_per_packet = 1

    def send(self, frame: bytes, now_s: float, start_s: float | None = None) -> None:
        """Let the frame be."""

    def poll(self, now_s: float) -> None:
        """Move nothing."""

    def next_event(self) -> ModemEvent | None:
        """Hear nothing."""
        return None

    def status(self) -> ModemStatus:
        """Return that all is well: the core is asked as it was before."""
        return ModemStatus(is_up=True)

    def close(self) -> None:
        """Nothing is open."""


def prepare_store(folder: Path) -> None:
    """Make the folder of a store.

    Raises
    ------
    ConfigError
        When it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--store {folder}: {error.strerror}; give a folder of yours") from error


def open_core(
    vehicle: int, store: Path, start: ReckonedState, voyage: Voyage, first_s: float
) -> JournaledLeader | JournaledFollower:
    """Return a vehicle's core as its store left it, or a new one with a store.

    Raises
    ------
    ConfigError
        For a store that another process has, or that is another vehicle's.
    """
    version = metadata.version("fathomlink")
    owner = Owner(vehicle=vehicle, fingerprint=f"{voyage.fingerprint} {version}")
    journal = Journal(store, owner, JournalSettings(), first_s)
    return resumed_core(journal, vehicle, start, voyage.settings, first_s)


def resumed_core(
    journal: Journal,
    vehicle: int,
    start: ReckonedState,
    settings: MissionSettings,
    first_s: float,
) -> JournaledLeader | JournaledFollower:
    """Return a vehicle's core as its journal left it; one ahead of the clock is set aside."""
    core = _core(journal, vehicle, start, settings)
    reached_s = core.recorder.last_tick_s
    if reached_s > first_s + 1e-6:
        journal.give_up(f"it had come to {reached_s:g} s, and now it is {first_s:g} s")
        core = _core(journal, vehicle, start, settings)
    return core


def plain_core(
    vehicle: int, epoch: int, start: ReckonedState, voyage: Voyage
) -> LeaderCore | FollowerCore:
    """Return a new core without a store."""
    settings, slots = voyage.settings, Slots(voyage.settings.slots)
    if vehicle == 0:
        return LeaderCore(epoch, start, settings=settings.leader, slots=slots)
    return FollowerCore(vehicle, epoch, start, settings=settings.follower, slots=slots)


def _core(
    journal: Journal, vehicle: int, start: ReckonedState, settings: MissionSettings
) -> JournaledLeader | JournaledFollower:
    slots = Slots(settings.slots)
    if vehicle == 0:
        return JournaledLeader(journal, start, settings=settings.leader, slots=slots)
    return JournaledFollower(journal, vehicle, start, settings=settings.follower, slots=slots)


def navigated(
    start: ReckonedState, steps: Iterator[SensorStep], first_s: float
) -> tuple[ReckonedState, list[SensorStep], Iterator[SensorStep]]:
    """Return dead reckoning just before the first tick, the steps so far, and those from then on.

    The inertial navigation is a unit of its own: it goes on while the computer restarts. Of the
    steps so far, all but the newest come without their pings.
    """
    reckoning = DeadReckoning(start)
    navigation: deque[SensorStep] = deque(maxlen=STEPS_KEPT)
    newest: deque[SensorStep] = deque(maxlen=PINGS_KEPT)
    for step in steps:
        if step[0].time_s >= first_s - 1e-6:
            steps = itertools.chain([step], steps)
            break
        reckoning.receive_odometry(step[0])
        if len(newest) == PINGS_KEPT:
            navigation.append((newest[0][0], None))
        newest.append(step)
    return reckoning.state, [*navigation, *newest], steps


def missed_instants(core: Journaled[VehicleCore], first_s: float, tick_s: float) -> list[float]:
    """Return the instants before the first tick that the store does not hold to their end."""
    from_s = core.recorder.unfinished_from_s(tick_s)
    if core.recorder.last_tick_s == -float("inf"):
        return []
    return [from_s + k * tick_s for k in range(round((first_s - from_s) / tick_s))]


def steps_since(
    core: Journaled[VehicleCore], passed: list[SensorStep], *, pings: bool
) -> Iterator[SensorStep]:
    """Yield the steps so far that the core has not had."""
    known_s = core.recorder.last_odometry_s
    for odometry, ping in passed:
        if odometry.time_s >= known_s:
            yield odometry, ping if pings else None
