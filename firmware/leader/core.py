"""The leader: odometry, pings and frames in; trajectories, map and answers out. No I/O.

The way of a sub-map: track -> nodes -> sheet -> matches (jobs, run by whoever holds the core) ->
closures -> gate -> consistency -> ledger -> update -> answer.
"""

import dataclasses
import math
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from firmware.belief import Belief
from firmware.dead_reckoning import DeadReckoning, ReckonedState
from firmware.leader.answers import Answers
from firmware.leader.atlas import LEADER, Atlas, Sheet, SheetId, name_of, sheet_of
from firmware.leader.closure_log import ClosureLog, Verdict, verdict_of
from firmware.leader.closures import Closure, closure_of, gated
from firmware.leader.composition import detail_from_s
from firmware.leader.coverage import redundant
from firmware.leader.fixes import Fixes
from firmware.leader.fleet import Fleet
from firmware.leader.judgement import Judgement
from firmware.leader.ledger import Anchor
from firmware.leader.manoeuvre import Proposal, propose
from firmware.leader.match_jobs import MatchJob, jobs_for
from firmware.leader.matching import MatchOutcome
from firmware.leader.observability import Observability, observe
from firmware.leader.offsets import corrections
from firmware.leader.open_pairs import OpenPairs
from firmware.leader.outlook import situation_of
from firmware.leader.own_grid import grid_of
from firmware.leader.pairing import Calibrations
from firmware.leader.pose_graph import PoseGraph
from firmware.leader.ranging import Ranging
from firmware.leader.reconstruction import (
    Reconstruction,
    reconstruct_packets,
    states_of_fragment,
)
from firmware.leader.settings import LeaderSettings, patient_reassembly
from firmware.leader.shelf import Shelf
from firmware.leader.trajectory import Trajectory
from firmware.soundings import Odometry, Ping
from firmware.submap_builder import SubmapBuilder
from firmware.submaps import Submap, Track, joined
from protocol.codec import decode, encode
from protocol.errors import EstimationError, RemoteProtocolError
from protocol.packets import (
    Header,
    SealedFrame,
    SubmapFragment,
    SubmapPacket,
    TrajectoryPacket,
)
from protocol.reassembly import (
    FragmentArrived,
    Reassembler,
    SubmapTransfer,
)
from protocol.schedule import Slots
from protocol.timestamps import from_quarters

_OFF_TRACK_M = 5.0  # a sub-map's own states are those of the track, to the wire's quantisation
_RANGE_WINDOW_S = 20.0  # five frames: enough to tell true ranges from stretched ones together
Rebuild = Callable[[SubmapTransfer], Reconstruction]
"""How a sub-map is made of what arrived of it; raises EstimationError when it cannot be."""
_SUPERFRAME_S = 60.0  # a slot that lies farther ahead was computed before the clock was set back


@dataclass(frozen=True, slots=True, kw_only=True)
class SheetJobs:
    """The matches of one new sub-map, and second looks; run all, hand the outcomes to `finish`."""

    sheet: Sheet
    jobs: tuple[MatchJob, ...]

    def run(self) -> list[MatchOutcome]:
        """Run all matches, in order."""
        return [job.run() for job in self.jobs]


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
        self._rebuild = rebuild
        self.counters: Counter[str] = Counter()
        self._closures: list[Closure] = []  # on which something may yet be decided
        self._settled = ClosureLog()
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
        self._reassembler = Reassembler(patient_reassembly(settings, slots))
        self._ranging = Ranging(settings.ranges)
        self.fleet = Fleet(self.graph, self._ranging, settings.fleet)
        self._fixes = Fixes(settings.fixes)
        self._answers = Answers(
            boot_epoch, self.fleet, self.graph, extended=settings.answers == "extended"
        )
        self._calibrations = Calibrations(settings.matching)
        self._judgement = Judgement(settings.judgement, settings.matching, self._calibrations)
        self._open = OpenPairs(settings.closures)
        self._sheets_judged = 0
        self._jobs_out = False
        self.composed_s = start.time_s
        self.observability: Observability | None = None  # of that time
        self._sheets_to_match: deque[Sheet] = deque(maxlen=16)
        self._ranges_used_s: dict[int, float] = {}
        self._next_slot_s = slots.next_slot_s(LEADER, start.time_s)
        start_m = np.array([start.north_m, start.east_m])
        self.graph.add_vehicle(LEADER, start.time_s, start_m, start_m)

    # what comes in

    def receive_odometry(self, odometry: Odometry) -> None:
        """Advance dead reckoning; a finished sub-map becomes a sheet of the atlas."""
        state = self._reckoning.receive_odometry(odometry)
        self._builder.receive_state(state)
        if odometry.fix is not None:
            self._fixes.hold(odometry.time_s, odometry.fix)
        track = self.fleet.own
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
        except RemoteProtocolError as error:
            self.counters["frames_rejected"] += 1
            self.counters[f"rejected_{error.cause}"] += 1
            return
        header = packet.header
        if not isinstance(packet, SubmapPacket | SubmapFragment | TrajectoryPacket):
            self.counters["frames_not_for_us"] += 1
            self.counters["frames_with_our_number"] += header.vehicle == LEADER
            self.counters["frames_sealed"] += isinstance(packet, SealedFrame)
            return
        if not 1 <= header.vehicle <= self._slots.settings.followers:
            self.counters["frames_of_unknown_vehicles"] += 1
            return
        self.counters["frames_received"] += 1
        if toa_s is not None:
            self._ranging.hold(self.fleet.chain(header), header, toa_s)
        if isinstance(packet, TrajectoryPacket):
            first_s = from_quarters(header.time_quarters, now_s)
            self._receive_states(header, first_s, packet.states, now_s)
        else:
            self._reassembler.receive(packet, now_s)

    # what is done

    def tick(self, now_s: float) -> None:
        """Take what the reassembly has closed."""
        self._reassembler.advance(now_s)
        while (event := self._reassembler.next_event()) is not None:
            if isinstance(event, FragmentArrived):
                self._receive_fragment(event.fragment, now_s)
            else:
                self._add_transfer(event)
        self._fixes.use(self.fleet, self.graph, now_s)
        interval_s = self._settings.composition.interval_s
        if now_s - self.composed_s >= interval_s and not self._jobs_out:
            self.composed_s = now_s
            self._compose(now_s)

    def next_jobs(self) -> SheetJobs | None:
        """Return the matches of the oldest sheet that still waits for them, or None."""
        if not self._sheets_to_match:
            return None
        self.graph.update()
        self._jobs_out = True
        sheet, s = self._sheets_to_match.popleft(), self._settings
        try:
            jobs = jobs_for(sheet, self.atlas, self.graph, s.closures, self._calibrations)
        except EstimationError:
            self.counters["submaps_unplaceable"] += 1
            jobs = []
        looks = self._open.second_looks(sheet, self.atlas, self.graph, self._calibrations)
        return SheetJobs(sheet=sheet, jobs=(*jobs, *looks))

    def finish(self, done: SheetJobs, outcomes: list[MatchOutcome], now_s: float) -> None:
        """Judge what the matches of one sheet found, and bring the estimate up to it."""
        found = []
        for job, outcome in zip(done.jobs, outcomes, strict=True):
            if outcome.reason is not None:
                self.counters[f"match_{outcome.reason.name.lower()}"] += 1
            try:
                self._open.keep_or_settle(job, outcome, self.graph, self._judgement)
                closure = closure_of(job, outcome, self.graph, now_s)
            except EstimationError:
                self.counters["closures_unplaceable"] += 1
                continue
            if closure is not None:
                found.append(closure)
        self._closures += found
        try:
            passed = gated(found, self.graph, self._settings.closures)
        except EstimationError:
            self.counters["closures_unplaceable"] += len(found)
            passed = []
        self._judgement.consider(passed, self.atlas, self.graph)
        self.graph.update()
        self._jobs_out = False
        self._sheets_judged += 1
        if self._sheets_judged % self._settings.sheets_between_audits == 0:
            self._judgement.audit(self._closures, self.graph)
            self.graph.update()

    # what goes out

    def poll(self, now_s: float) -> bytes | None:
        """Return the answer to transmit now, or None; followers take turns."""
        if self._next_slot_s - _SUPERFRAME_S < now_s < self._next_slot_s - 1e-6:
            return None
        slot_s = self._slots.next_slot_s(LEADER, now_s)
        self._next_slot_s = self._slots.next_slot_s(LEADER, now_s + 1e-3)
        if slot_s > now_s + 1e-6:
            self.counters["slots_missed"] += 1
            return None
        answer = self._answers.next_answer(self.belief(), self._reassembler, now_s)
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
        yield from self._settled
        yield from map(verdict_of, self._closures)

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
            **self._answers.counters,
            **self._ranging.counters,
            **self._fixes.counters,
            **self._judgement.counters,
            **self._open.counters,
            **{
                f"reassembly_{k}": v
                for k, v in dataclasses.asdict(self._reassembler.counters).items()
            },
            "bad_odometry": self._reckoning.bad_samples,
            "bad_beams": self._builder.bad_beams,
            "bad_pings": self._builder.bad_pings,
            "graph_rebuilds": self.graph.rebuilds,
            "open_submaps": len(self._open),
            **self._outlook(),
        }

    def observe(self, now_s: float) -> Observability | None:
        """Return what the geometry leaves open of the vehicles' newest states; None if unknown."""
        vehicles = self.vehicles()
        chains = [self.fleet.newest_chain(vehicle) for vehicle in vehicles]
        names = [name_of(vehicle) for vehicle in vehicles]
        try:
            joint, reckoned = (
                self.graph.newest_covariance(chains, reckoned=alone) for alone in (False, True)
            )
            positions_m = [self.graph.trajectory(chain).position_m[-1] for chain in chains]
            return observe(now_s, names, np.array(positions_m), joint, reckoned)
        except (EstimationError, np.linalg.LinAlgError):
            return None

    def propose(self) -> Proposal | None:
        """Return the manoeuvre that would help most, if one would."""
        s = self._settings
        noise_m2 = s.matching.cell_sigma_m**2
        try:
            situation = situation_of(self.fleet, self.graph, self.atlas, s.manoeuvre, noise_m2)
            return propose(situation, s.manoeuvre)
        except (EstimationError, np.linalg.LinAlgError):
            return None

    # inside

    def _outlook(self) -> dict[str, int]:
        """Return the last observation in numbers for a status line."""
        seen = self.observability
        if seen is None:
            return {}
        return {
            "joint_sigma_cm": round(100.0 * seen.worst_m),
            "undetermined_quantities": sum(q.is_undetermined for q in seen.quantities),
            "undetermined_directions": seen.blind,
        }

    def _compose(self, now_s: float) -> None:
        """Make the past coarse, so that a day costs no more an hour than its first hours."""
        settings = self._settings.composition
        self.graph.compose(now_s, settings)
        detail_s = detail_from_s(now_s, settings)
        self._judgement.forget(detail_s, self.graph)
        waiting, self._closures = self._closures, []
        for closure in waiting:
            newest_s = max(closure.origin_anchor.time_s, closure.target_anchor.time_s)
            if closure.number in self.graph and newest_s >= detail_s:
                self._closures.append(closure)
            else:
                self._settled.add(closure)
        self.fleet.settle(detail_s)
        old = [sheet for sheet in self.atlas if sheet.time_s < detail_s]
        moves_m = corrections(old, self.graph)
        for sheet_id in redundant(old, moves_m, self._settings.coverage):
            self.atlas.shelve(sheet_id)
        self.observability = self.observe(now_s)

    def _add_own(self, stretch: Submap) -> None:
        """Join the newest stretches to a sub-map, so that one ends every hop."""
        self.graph.extend(LEADER, self.fleet.own.track())
        self._stretches.append(stretch)
        submap = joined(list(self._stretches))
        if submap.bins.depth_m.size < self._settings.submaps.minimum_cells:
            self.counters["submaps_too_thin"] += 1
            return
        sheet_id = SheetId(vehicle=LEADER, boot_epoch=self.boot_epoch, submap=submap.index)
        grid = grid_of(submap.bins, self._settings.reconstruction.cell_m)
        self._add_sheet(sheet_of(sheet_id, submap.track, grid, reconstructed=False))

    def _add_transfer(self, transfer: SubmapTransfer) -> None:
        """Rebuild a sub-map from the fragments that arrived."""
        header = next(iter(transfer.fragments.values())).header
        boot = self.fleet.boot_of(header)
        sheet_id = SheetId(vehicle=header.vehicle, boot_epoch=boot, submap=header.submap)
        self._use_ranges(sheet_id.chain)
        try:
            rebuilt = (self._rebuild or self._reconstruct)(transfer)
        except EstimationError:
            self.counters["submaps_not_rebuilt"] += 1
            return
        if rebuilt.track.time_s.size == 0:
            self.counters["submaps_without_track"] += 1
        elif not self._is_on_track(sheet_id.chain, rebuilt.track):
            self.counters["submaps_off_track"] += 1
        else:
            lossy = not rebuilt.is_original
            self._add_sheet(sheet_of(sheet_id, rebuilt.track, rebuilt.grid, reconstructed=lossy))

    def _reconstruct(self, transfer: SubmapTransfer) -> Reconstruction:
        return reconstruct_packets(
            transfer.fragments, self._settings.reconstruction, transfer.first_arrival_s
        )

    def _is_on_track(self, chain: int, track: Track) -> bool:
        """Return whether a sub-map was measured where its chain was, so that it can be placed."""
        try:
            known = self.fleet.track(chain)
            for time_s in (track.time_s[0], track.time_s[-1]):
                self.graph.anchor(chain, float(time_s), known)
        except (EstimationError, KeyError):
            return False
        reckoned_m = np.column_stack([track.north_m, track.east_m])
        apart_m = np.hypot(*(known.position_at(track.time_s) - reckoned_m).T)
        return bool(apart_m.max() <= _OFF_TRACK_M)

    def _add_sheet(self, sheet: Sheet | None) -> None:
        if sheet is None:
            self.counters["submaps_empty"] += 1
            return
        self.atlas.add(sheet)
        self._sheets_to_match.append(sheet)

    def _receive_fragment(self, fragment: SubmapPacket | SubmapFragment, now_s: float) -> None:
        """Take the states that a fragment carries; they are of use before its sub-map is."""
        header = fragment.header
        first_s = from_quarters(header.time_quarters, now_s)
        if isinstance(fragment, SubmapPacket):
            self._receive_states(header, first_s, fragment.trajectory, now_s)
            return
        try:
            states = states_of_fragment(fragment)
        except EstimationError:
            self.counters["fragments_without_track"] += 1
            return
        self._receive_states(header, first_s, states, now_s)

    def _receive_states(
        self, header: Header, first_s: float, states: np.ndarray, now_s: float
    ) -> None:
        last_s = self.fleet.receive_states(header, first_s, states, now_s)
        if last_s is None:
            return
        chain = self.fleet.chain(header)
        self._answers.note(header, chain, last_s)
        if last_s >= self._ranges_used_s.get(chain, -np.inf) + _RANGE_WINDOW_S:
            self._ranges_used_s[chain] = last_s
            self._use_ranges(chain)

    def _use_ranges(self, chain: int) -> None:
        """Let a follower's chain grow by its known track, and use the ranges that this frees."""
        self.fleet.extend(chain)
        self.fleet.use_ranges(chain)
