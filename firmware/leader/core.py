"""The leader: odometry, pings and frames in; trajectories, map and answers out. No I/O.

The way of a sub-map: track -> nodes -> sheet -> matches (jobs, run by whoever holds the core) ->
closures -> gate -> consistency -> ledger -> update -> answer.
"""

import dataclasses
import math
from collections import Counter, deque
from collections.abc import Iterator

import numpy as np

from firmware.belief import Belief
from firmware.dead_reckoning import DeadReckoning, ReckonedState
from firmware.leader.answers import Answers
from firmware.leader.arrivals import Arrivals, Rebuild
from firmware.leader.atlas import Atlas, Sheet, SheetId, sheet_of
from firmware.leader.closure_log import Verdict
from firmware.leader.composition import detail_from_s
from firmware.leader.coverage import redundant
from firmware.leader.fixes import Fixes
from firmware.leader.fleet import Fleet
from firmware.leader.ledger import Anchor
from firmware.leader.loop_closing import LoopClosing
from firmware.leader.match_jobs import Findings, SheetJobs
from firmware.leader.offsets import corrections
from firmware.leader.outlook import Outlook
from firmware.leader.own_grid import grid_of
from firmware.leader.pose_graph import PoseGraph
from firmware.leader.range_windows import RangeWindows
from firmware.leader.settings import LeaderSettings, reassembly_of
from firmware.leader.shelf import Shelf
from firmware.leader.trajectory import Trajectory
from firmware.soundings import Odometry, Ping
from firmware.submap_builder import SubmapBuilder
from firmware.submaps import Submap, Track, joined
from protocol.codec import decode, encode
from protocol.errors import EstimationError, RemoteProtocolError
from protocol.packets import Fragment, SealedFrame, TrajectoryPacket
from protocol.reassembly import Reassembler
from protocol.schedule import Slots, Turns
from protocol.timestamps import is_arrival
from protocol.vehicles import LEADER


class LeaderCore:
    """The leader, as a function of what it is given and when."""

    def __init__(
        self,
        boot_epoch: int,
        start: ReckonedState,
        *,
        settings: LeaderSettings,
        slots: Slots,
        rebuild: Rebuild | None = None,
        shelf: Shelf | None = None,
    ) -> None:
        self.boot_epoch = boot_epoch
        self.counters: Counter[str] = Counter()
        self.graph = PoseGraph(settings.graph)
        self.atlas = Atlas(settings.atlas_submaps, shelf)
        self._settings, self._slots = settings, slots
        self._reckoning = DeadReckoning(start)
        self._builder = SubmapBuilder(
            LEADER,
            boot_epoch,
            settings=dataclasses.replace(settings.submaps, duration_s=settings.hop_s),
            sonar=settings.sonar,
            binning=settings.binning,
        )
        hops = max(1, round(settings.submaps.duration_s / settings.hop_s))
        self._stretches: deque[Submap] = deque(maxlen=hops)
        self._tracked_s = -math.inf  # the newest state of the own track
        self._reassembler = Reassembler(reassembly_of(settings, slots))
        self._ranging = RangeWindows(settings.ranges)
        self.fleet = Fleet(self.graph, self._ranging, settings.fleet)
        self._fixes = Fixes(settings.fixes, slots.settings.followers)
        self._answers = Answers(
            boot_epoch, self.fleet, self.graph, extended=settings.answers == "extended"
        )
        self._arrivals = Arrivals(
            self._reassembler,
            self.fleet,
            self.graph,
            self._answers,
            settings.reconstruction,
            rebuild,
        )
        self._closing = LoopClosing(self.graph, self.atlas, settings)
        self.outlook = Outlook(
            self.fleet, self.graph, self.atlas, settings.manoeuvre, settings.matching
        )
        self.composed_s = self._tried_s = start.time_s  # to compose may fail
        self._turns = Turns(slots, LEADER, start.time_s)
        start_m = np.array([start.north_m, start.east_m])
        self.graph.add_chain(LEADER, start.time_s, start_m, start_m)
        self.fleet.own.add(start.time_s, start.north_m, start.east_m, start.yaw_rad)

    # what comes in

    def receive_odometry(self, odometry: Odometry) -> None:
        """Advance dead reckoning; a finished sub-map becomes a sheet of the atlas."""
        state = self._reckoning.receive_odometry(odometry)
        if self._reckoning.lost_s > 0.0:
            self.graph.lose(LEADER, state.time_s - self._reckoning.lost_s, state.time_s)
        if self._reckoning.is_lost:
            self._tear(state)
        else:
            self._builder.receive_state(state)
        if odometry.fix is not None:
            self._fixes.hold(odometry.time_s, odometry.fix)
        if state.time_s < self._tracked_s:
            self.fleet.own.forget_from(state.time_s)
            self.graph.set_back(LEADER, self._tracked_s, state.time_s)
            self._tracked_s = -math.inf
        if state.time_s - self._tracked_s >= 1.0 - 1e-6:
            self._tracked_s = state.time_s
            self.fleet.own.add(state.time_s, state.north_m, state.east_m, state.yaw_rad)
        submap = self._builder.take()
        if submap is not None:
            self._add_own(submap)

    def receive_ping(self, ping: Ping) -> None:
        """Add the soundings of a ping to the sub-map being measured."""
        self._builder.receive_ping(ping, self._reckoning.state)

    def receive_frame(self, frame: bytes, toa_s: float | None, now_s: float) -> None:
        """Take a frame and, where the modem vouches for it, the arrival of its first bit."""
        try:
            packet = decode(frame)
        except RemoteProtocolError as error:
            self.counters["frames_rejected"] += 1
            self.counters[f"rejected_{error.cause}"] += 1
            return
        header = packet.header
        if not isinstance(packet, Fragment | TrajectoryPacket):
            self.counters["frames_not_for_us"] += 1
            self.counters["frames_with_our_number"] += header.vehicle == LEADER
            self.counters["frames_sealed"] += isinstance(packet, SealedFrame)
            return
        if not 1 <= header.vehicle <= self._slots.settings.followers:
            self.counters["frames_of_unknown_vehicles"] += 1
            return
        if not self.fleet.admit(header, now_s):
            return
        self.counters["frames_received"] += 1
        if toa_s is not None and not is_arrival(toa_s, now_s):
            self.counters["arrivals_impossible"] += 1
        elif toa_s is not None:
            depth_m = self._reckoning.state.depth_m
            self._ranging.hold(self.fleet.chain(header), header, toa_s, depth_m)
        self._arrivals.receive(packet, now_s)

    # what is done

    def tick(self, now_s: float) -> None:
        """Take what the reassembly has closed."""
        for sheet in self._arrivals.sheets(now_s):
            self._add_sheet(sheet)
        self._fixes.use(self.fleet, self.graph, now_s)
        if self._is_to_compose and not self._closing.is_matching:
            self._compose(self._newest_s)

    @property
    def has_jobs(self) -> bool:
        """Whether a sheet waits for its matches, and composition does not wait for those out."""
        return self._closing.has_jobs and not self._is_to_compose

    def next_jobs(self) -> SheetJobs | None:
        """Return the matches of the oldest sheet that still waits for them, or None."""
        return self._closing.next_jobs() if self.has_jobs else None

    def finish(self, done: SheetJobs, findings: Findings, now_s: float) -> None:
        """Judge what the matches of one sheet found, and bring the estimate up to it."""
        self._closing.finish(done, findings, now_s)

    # what goes out

    def poll(self, now_s: float) -> bytes | None:
        """Return the answer to transmit now, or None; followers take turns."""
        if self._turns.due_s(now_s) is None:
            return None
        answer = self._answers.next_answer(self.belief, self._reassembler, now_s)
        return None if answer is None else encode(answer)

    def belief(self) -> Belief:
        """Return where the leader believes itself to be now."""
        state = self._reckoning.state
        reckoned_m = np.array([state.north_m, state.east_m])
        return Belief(
            time_s=state.time_s,
            position_m=self.graph.trajectory(LEADER).correct(state.time_s, reckoned_m),
            covariance_m2=self.graph.predicted_covariance(LEADER, state.time_s),
        )

    @property
    def reckoned(self) -> ReckonedState:
        """The newest state of raw dead reckoning."""
        return self._reckoning.state

    def vehicles(self) -> list[int]:
        """Return the vehicles whose trajectories are known, the leader first."""
        return self.fleet.vehicles()

    def verdicts(self) -> Iterator[Verdict]:
        """Yield every closure that was detected, and how far it has come."""
        return self._closing.verdicts()

    def track(self, vehicle: int) -> Track:
        """Return the raw dead-reckoned track of a vehicle, as far as it is known here."""
        return self.fleet.whole_track(vehicle)

    def trajectory(self, vehicle: int) -> Trajectory:
        """Return the smoothed estimate of a vehicle's trajectory, over all of its boots."""
        return self.fleet.whole_trajectory(vehicle)

    def anchor(self, vehicle: int, time_s: float) -> Anchor:
        """Return where in the graph a vehicle's position at the time hangs.

        Raises
        ------
        EstimationError
            If nothing is known of that time.
        """
        chain = self.fleet.chain_at(vehicle, time_s)
        return self.graph.anchor(chain, time_s, self.fleet.track(chain))

    def status(self) -> dict[str, int]:
        """Return every counter: what came, what was used, what was dropped and why."""
        return {
            **self.counters,
            **self.fleet.counters,
            **self._arrivals.counters,
            **self._answers.counters,
            **self._ranging.counters,
            **self._fixes.counters,
            **self._closing.status(),
            **{
                f"reassembly_{k}": v
                for k, v in dataclasses.asdict(self._reassembler.counters).items()
            },
            "slots_missed": self._turns.missed,
            "bad_odometry": self._reckoning.bad_samples,
            "odometry_set_back": self._reckoning.set_back,
            "bad_beams": self._builder.bad_beams,
            "bad_pings": self._builder.bad_pings,
            "submaps_overwritten": self._builder.submaps_overwritten,
            "submaps_dropped": self.atlas.dropped,
            "states_overflowed": self.fleet.overflowed,
            "graph_rebuilds": self.graph.rebuilds,
            **self.outlook.status(),
        }

    # inside

    @property
    def _is_to_compose(self) -> bool:
        """Whether the past is to be composed as soon as no matches are out."""
        return self._newest_s - self._tried_s >= self._settings.composition.interval_s

    @property
    def _newest_s(self) -> float:
        s = self._settings.composition
        return self.graph.newest_s(leap_s=s.detail_s, lasting_s=s.interval_s)

    def _compose(self, newest_s: float) -> None:
        """Make the past coarse, so that a day costs no more an hour than its first hours.

        It is the past of the newest node: a clock that leaps makes nothing old. Where the graph
        tells no covariance it stays as it is until the next time.
        """
        settings, self._tried_s = self._settings.composition, newest_s
        try:
            self.graph.compose(newest_s, settings)
        except EstimationError:
            self.counters["compositions_failed"] += 1
            return
        self.composed_s = newest_s
        detail_s = detail_from_s(newest_s, settings)
        self._closing.forget(detail_s)
        self.fleet.settle(detail_s)
        old = [sheet for sheet in self.atlas if sheet.time_s < detail_s]
        moves_m = corrections(old, self.graph)
        for sheet_id in redundant(old, moves_m, self._settings.coverage):
            self.atlas.shelve(sheet_id)
        self.outlook.note(newest_s)

    def _tear(self, state: ReckonedState) -> None:
        """Let what was measured before navigation was lost stand by itself."""
        self._builder.tear(state)
        torn = self._builder.take()
        if torn is not None:
            self._add_own(torn)
        self._stretches.clear()

    def _add_own(self, stretch: Submap) -> None:
        """Join the newest stretches to a sub-map, so that one ends every hop."""
        self.graph.extend(LEADER, self.fleet.own.track())
        if self._stretches and _is_torn(self._stretches[-1], stretch, self._settings.hop_s):
            self._stretches.clear()
        self._stretches.append(stretch)
        submap = joined(list(self._stretches))
        if submap.bins.depth_m.size < self._settings.submaps.minimum_cells:
            self.counters["submaps_too_thin"] += 1
            return
        sheet_id = SheetId(vehicle=LEADER, boot_epoch=self.boot_epoch, submap=submap.index)
        grid = grid_of(submap.bins, self._settings.reconstruction.cell_m)
        self._add_sheet(sheet_of(sheet_id, submap.track, grid))

    def _add_sheet(self, sheet: Sheet | None) -> None:
        if sheet is None:
            self.counters["submaps_empty"] += 1
            return
        self.atlas.add(sheet)
        self._closing.add(sheet)


def _is_torn(before: Submap, after: Submap, hop_s: float) -> bool:
    """Return whether navigation was away between two stretches, or their clock was set back."""
    return not 0.0 < after.track.time_s[0] - before.track.time_s[-1] <= hop_s
