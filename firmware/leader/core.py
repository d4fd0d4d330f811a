"""The leader: odometry, pings and frames in; trajectories, map and answers out. No I/O.

The way of a sub-map: track -> nodes -> sheet -> matches (jobs, run by whoever holds the core) ->
closures -> gate -> consistency -> ledger -> update -> answer.
"""

import dataclasses
import math
from collections import Counter, deque
from dataclasses import dataclass

import numpy as np

from firmware.belief import Belief
from firmware.dead_reckoning import DeadReckoning, ReckonedState
from firmware.leader.atlas import Atlas, Sheet, SheetId, sheet_of
from firmware.leader.closures import Closure, MatchJob, closure_of, gate, jobs_for
from firmware.leader.judgement import Judgement
from firmware.leader.matching import MatchOutcome
from firmware.leader.own_grid import grid_of
from firmware.leader.pose_graph import PoseGraph
from firmware.leader.ranging import Ranging
from firmware.leader.reconstruction import reconstruct_packets
from firmware.leader.settings import LeaderSettings
from firmware.leader.tracks import TrackBuffer
from firmware.leader.trajectory import Trajectory
from firmware.soundings import Odometry, Ping
from firmware.submap_builder import SubmapBuilder
from firmware.submaps import Submap, Track, joined
from protocol.codec import decode, encode
from protocol.errors import EstimationError, RemoteProtocolError
from protocol.packets import (
    Answer,
    Header,
    Profile,
    SubmapFragment,
    SubmapPacket,
    TrajectoryPacket,
    usable_states,
)
from protocol.reassembly import FragmentArrived, Reassembler, SubmapTransfer
from protocol.schedule import Slots
from protocol.timestamps import from_quarters, to_quarters, to_tx_second

LEADER = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class SheetJobs:
    """The matches of one new sub-map; run every job, then hand the outcomes to `finish`."""

    sheet: Sheet
    jobs: tuple[MatchJob, ...]

    def run(self) -> list[MatchOutcome]:
        """Run all matches, in order."""
        return [job.run() for job in self.jobs]


@dataclass(frozen=True, slots=True, kw_only=True)
class _LatestAnswer:
    """The last known state of a follower's newest sub-map."""

    sheet_id: SheetId
    time_s: float


class LeaderCore:
    """The leader, as a function of what it is given and when."""

    def __init__(
        self, boot_epoch: int, start: ReckonedState, *, settings: LeaderSettings, slots: Slots
    ) -> None:
        self.boot_epoch = boot_epoch
        self.counters: Counter[str] = Counter()
        self.closures: list[Closure] = []
        self.graph = PoseGraph(settings.graph)
        self.atlas = Atlas(settings.atlas_submaps)
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
        self._reassembler = Reassembler(settings.reassembly)
        self._ranging = Ranging(settings.ranges)
        self._judgement = Judgement(settings.judgement, settings.matching)
        self._sheets_judged = 0
        self._tracks: dict[int, TrackBuffer] = {LEADER: TrackBuffer()}
        self._sheets_to_match: deque[Sheet] = deque(maxlen=16)
        self._answers: dict[int, _LatestAnswer] = {}
        self._answers_sent = 0
        self._next_slot_s = slots.next_slot_s(LEADER, start.time_s)
        start_m = np.array([start.north_m, start.east_m])
        self.graph.add_vehicle(LEADER, start.time_s, start_m, start_m)

    # what comes in

    def receive_odometry(self, odometry: Odometry) -> None:
        """Advance dead reckoning; a finished sub-map becomes a sheet of the atlas."""
        state = self._reckoning.receive_odometry(odometry)
        self._builder.receive_state(state)
        track = self._tracks[LEADER]
        if not len(track) or state.time_s == math.floor(state.time_s):
            track.add(state.time_s, state.north_m, state.east_m, state.yaw_rad)
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
        except RemoteProtocolError:
            self.counters["frames_rejected"] += 1
            return
        if packet.header.vehicle == LEADER or isinstance(packet, Answer):
            self.counters["frames_not_for_us"] += 1
            return
        if isinstance(packet, SubmapPacket | SubmapFragment):
            self._reassembler.receive(packet, now_s)
        elif isinstance(packet, TrajectoryPacket):
            self._receive_states(packet.header, packet.states, now_s)
            self._extend(packet.header.vehicle)
        else:
            self.counters["frames_not_for_us"] += 1
            return
        self.counters["frames_received"] += 1
        if toa_s is not None:
            self._ranging.hold(packet.header, toa_s)

    # what is done

    def tick(self, now_s: float) -> None:
        """Take what the reassembly has closed."""
        self._reassembler.advance(now_s)
        while (event := self._reassembler.next_event()) is not None:
            if isinstance(event, FragmentArrived):
                if isinstance(event.fragment, SubmapPacket):
                    header = event.fragment.header
                    self._receive_states(header, event.fragment.trajectory, now_s)
            else:
                self._add_transfer(event)

    def next_jobs(self) -> SheetJobs | None:
        """Return the matches of the oldest sheet that still waits for them, or None."""
        if not self._sheets_to_match:
            return None
        self.graph.update()
        sheet = self._sheets_to_match.popleft()
        jobs = jobs_for(
            sheet, self.atlas, self.graph, self._settings.closures, self._settings.matching
        )
        return SheetJobs(sheet=sheet, jobs=tuple(jobs))

    def finish(self, done: SheetJobs, outcomes: list[MatchOutcome], now_s: float) -> None:
        """Judge what the matches of one sheet found, and bring the estimate up to it."""
        gated = []
        for job, outcome in zip(done.jobs, outcomes, strict=True):
            if outcome.reason is not None:
                self.counters[f"match_{outcome.reason.name.lower()}"] += 1
            try:
                closure = closure_of(job, outcome, self.graph, now_s)
                if closure is None:
                    continue
                self.closures.append(closure)
                if gate(closure, self.graph, self._settings.closures):
                    gated.append(closure)
            except EstimationError:
                self.counters["closures_unplaceable"] += 1
        self._judgement.consider(gated, self.atlas, self.graph)
        self.graph.update()
        self._sheets_judged += 1
        if self._sheets_judged % self._settings.sheets_between_audits == 0:
            self._judgement.audit(self.closures, self.graph)
            self.graph.update()

    # what goes out

    def poll(self, now_s: float) -> bytes | None:
        """Return the answer to transmit now, or None; followers take turns."""
        if now_s < self._next_slot_s - 1e-6:
            return None
        self._next_slot_s = self._slots.next_slot_s(LEADER, now_s + 1e-3)
        if not self._answers:
            return None
        vehicles = sorted(self._answers)
        vehicle = vehicles[self._answers_sent % len(vehicles)]
        answer = self._answer(vehicle, self._answers[vehicle], now_s)
        if answer is None:
            return None
        self._answers_sent = (self._answers_sent + 1) % (1 << 16)
        self.counters["answers_sent"] += 1
        return encode(answer)

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
        return self.graph.vehicles()

    def track(self, vehicle: int) -> Track:
        """Return the raw dead-reckoned track of a vehicle, as far as it is known here."""
        return self._tracks[vehicle].track()

    def trajectory(self, vehicle: int) -> Trajectory:
        """Return the smoothed estimate of a vehicle's trajectory."""
        return self.graph.trajectory(vehicle)

    def status(self) -> dict[str, int]:
        """Return every counter: what came, what was used, what was dropped and why."""
        return {
            **self.counters,
            **self._ranging.counters,
            **self._judgement.counters,
            **{f"reassembly_{k}": v for k, v in _counters_of(self._reassembler).items()},
            "bad_odometry": self._reckoning.bad_samples,
            "bad_beams": self._builder.bad_beams,
            "bad_pings": self._builder.bad_pings,
            "graph_rebuilds": self.graph.rebuilds,
        }

    # inside

    def _add_own(self, stretch: Submap) -> None:
        """Join the newest stretches to a sub-map, so that one ends every hop."""
        self.graph.extend(LEADER, self.track(LEADER))
        self._stretches.append(stretch)
        submap = joined(list(self._stretches))
        if submap.bins.depth_m.size < self._settings.submaps.minimum_cells:
            self.counters["submaps_too_thin"] += 1
            return
        sheet_id = SheetId(vehicle=LEADER, boot_epoch=self.boot_epoch, submap=submap.index)
        grid = grid_of(submap.bins, self._settings.cell_m)
        self._add_sheet(sheet_of(sheet_id, submap.track, grid, reconstructed=False))

    def _add_transfer(self, transfer: SubmapTransfer) -> None:
        """Rebuild a sub-map from the fragments that arrived; its last state is to be answered."""
        vehicle = transfer.vehicle
        self._extend(vehicle)
        sheet_id = SheetId(vehicle=vehicle, boot_epoch=transfer.boot_epoch, submap=transfer.submap)
        try:
            rebuilt = reconstruct_packets(
                transfer.fragments, self._settings.reconstruction, transfer.first_arrival_s
            )
        except EstimationError:
            self.counters["submaps_not_rebuilt"] += 1
            return
        if rebuilt.track.time_s.size == 0:
            self.counters["submaps_without_track"] += 1
            return
        last_s = float(rebuilt.track.time_s[-1])
        self._answers[vehicle] = _LatestAnswer(sheet_id=sheet_id, time_s=last_s)
        self._add_sheet(sheet_of(sheet_id, rebuilt.track, rebuilt.grid, reconstructed=True))

    def _add_sheet(self, sheet: Sheet | None) -> None:
        if sheet is None:
            self.counters["submaps_empty"] += 1
            return
        self.atlas.add(sheet)
        self._sheets_to_match.append(sheet)

    def _receive_states(self, header: Header, states: np.ndarray, now_s: float) -> None:
        first_s = from_quarters(header.time_quarters, now_s)
        buffer = self._tracks.setdefault(header.vehicle, TrackBuffer())
        for k in np.flatnonzero(usable_states(states)):
            if first_s + k <= now_s:
                buffer.add(first_s + float(k), *(float(value) for value in states[k]))
            else:
                self.counters["states_from_the_future"] += 1

    def _extend(self, vehicle: int) -> None:
        """Let a follower's chain grow by its known track, and use the ranges that this frees."""
        buffer = self._tracks.get(vehicle)
        if buffer is None or not len(buffer):
            return
        track = buffer.track()
        if vehicle not in self.graph.vehicles():
            start_m = np.array([track.north_m[0], track.east_m[0]])
            self.graph.add_vehicle(vehicle, float(track.time_s[0]), start_m, start_m)
        self.graph.extend(vehicle, track)
        self.graph.extend(LEADER, self.track(LEADER))
        self._ranging.use(vehicle, track, LEADER, self.track(LEADER), self.graph)

    def _answer(self, vehicle: int, latest: _LatestAnswer, now_s: float) -> Answer | None:
        try:
            anchor = self.graph.anchor(vehicle, latest.time_s, self.track(vehicle))
        except EstimationError:
            self.counters["answers_unplaceable"] += 1
            return None
        position_m = self.graph.position(anchor)
        header = Header(
            profile=Profile.ANSWER,
            vehicle=LEADER,
            boot_epoch=self.boot_epoch,
            submap=self._answers_sent,
            fragment=vehicle,
            fragment_count=latest.sheet_id.boot_epoch,
            tx_second=to_tx_second(round(now_s)),
            time_quarters=to_quarters(latest.time_s),
        )
        return Answer(
            header=header,
            submap=latest.sheet_id.submap,
            north_m=float(np.float32(position_m[0])),
            east_m=float(np.float32(position_m[1])),
        )


def _counters_of(reassembler: Reassembler) -> dict[str, int]:
    counters = reassembler.counters
    return {name: getattr(counters, name) for name in counters.__dataclass_fields__}
