"""A mission of two vehicles' own programs over the modems of a bench; the sea around is simulated.

Modems on a bench do not move, so that their ranges would contradict the survey: arrivals are not
told to the cores here, T05 measures them.
"""

from dataclasses import replace

from firmware.follower.core import FollowerCore
from firmware.follower.loop import FollowerLoop
from firmware.leader.core import LeaderCore
from firmware.leader.loop import LeaderLoop
from firmware.leader.worker import InlineWorker
from firmware.vehicle_loop import VehicleLoop
from hil.benches import Bench
from host_tools.commands import parse_changes
from host_tools.mission import deployed, simulated_vehicles
from host_tools.mission_settings import MissionSettings, changed
from host_tools.processes.emulated_modems import MODEMS
from host_tools.processes.resume import navigated
from host_tools.simulator.placement import place_survey
from host_tools.simulator.terrain import open_terrain
from protocol.modems.base import Modem, ModemEvent, ModemStatus, Reception
from protocol.packets import FRAME_BYTES
from protocol.schedule import Slots

PERIOD_S = 0.25
SURVEY = (
    "leg_m=300",
    "beams=64",
    "follower.profile=lattice",
    "leader.closures.pairs_per_submap=1",
    "leader.closures.screened_per_submap=4",
)


class PolledModem:
    """A bench's modem, polled by the bench, without times of arrival."""

    def __init__(self, modem: Modem) -> None:
        self._modem = modem
        self.largest_frame_bytes, self.lead_s = modem.largest_frame_bytes, modem.lead_s
        self.frames_per_packet = modem.frames_per_packet

    def send(self, frame: bytes, now_s: float, start_s: float | None = None) -> None:
        """Hand a frame over."""
        self._modem.send(frame, now_s, start_s)

    def poll(self, now_s: float) -> None:
        """Leave that to the bench."""

    def next_event(self) -> ModemEvent | None:
        """Return the oldest event."""
        event = self._modem.next_event()
        return replace(event, toa_s=None) if isinstance(event, Reception) else event

    def status(self) -> ModemStatus:
        """Return the counters."""
        return self._modem.status()

    def close(self) -> None:
        """Leave that to the bench."""


class BenchMission:
    """A follower on the first modem of a bench, a leader on the second, from the bench's now on."""

    def __init__(self, bench: Bench) -> None:
        self._bench, self._next_s = bench, float(int(bench.now_s) + 1)
        follower, leader = (PolledModem(modem) for modem in bench.modems)
        small = min(follower.largest_frame_bytes, leader.largest_frame_bytes) < FRAME_BYTES
        kind = "nanomodem" if small else "micromodem" if follower.lead_s else "raw"
        changes = parse_changes([*MODEMS[kind], *SURVEY])
        settings = changed(MissionSettings(), changes)
        site = place_survey(open_terrain(None, 1), settings.scenario, 4)
        vehicles = simulated_vehicles(settings, site, 4)
        at = [navigated(deployed(v), v.steps(), self._next_s) for v in vehicles]
        slots = Slots(settings.slots)
        self.leader = LeaderCore(0, at[0][0], settings=settings.leader, slots=slots)
        self.follower = FollowerCore(1, 0, at[1][0], settings=settings.follower, slots=slots)
        self._loops: list[VehicleLoop] = [
            LeaderLoop(self.leader, leader, at[0][2], InlineWorker(), lambda: 0.0, PERIOD_S),
            FollowerLoop(self.follower, follower, at[1][2], lambda: 0.0, PERIOD_S),
        ]

    def step(self) -> None:
        """Let a step of the bench pass, and the loops' period when it is over."""
        self._bench.step()
        while self._bench.now_s >= self._next_s:
            for loop in self._loops:
                loop.step(self._next_s)
            self._next_s += PERIOD_S

    def is_done(self) -> bool:
        """Return whether two of the follower's sub-maps were placed, and an answer came back."""
        placed = sum(sheet.id.vehicle == 1 for sheet in self.leader.atlas)
        status = self._loops[1].status()
        strange = ("frames_rejected", "frames_not_for_us", "answers_to_others")
        return placed >= 2 and status["modem_received"] > sum(status.get(n, 0) for n in strange)

    def status(self) -> list[dict[str, int]]:
        """Return the counters of leader and follower."""
        return [loop.status() for loop in self._loops]
