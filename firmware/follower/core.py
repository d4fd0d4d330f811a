"""The follower: odometry, pings and answers in; packets out. No port, no clock, no thread."""

import dataclasses
from collections import Counter, deque

import numpy as np

from firmware.belief import Belief
from firmware.compression import packets_from
from firmware.compression.packing import submap_header
from firmware.compression.results import PAPER_FRAGMENTS
from firmware.compression.settings import CompressionSettings
from firmware.dead_reckoning import DeadReckoning, ReckonedState
from firmware.follower.correction import DriftCorrection
from firmware.follower.outbox import Outbox
from firmware.follower.settings import FollowerSettings
from firmware.follower.submap_fit import SubmapFit
from firmware.geometry import Array
from firmware.soundings import Odometry, Ping
from firmware.submap_builder import SubmapBuilder, track_of
from firmware.submaps import Submap, Track
from protocol.codec import decode, encode
from protocol.errors import ConfigError, LocalProtocolError, RemoteProtocolError
from protocol.packets import SIZE_BYTES, Answer, ExtendedAnswer, SealedFrame
from protocol.schedule import Slots, Turns
from protocol.timestamps import from_quarters, is_arrival, to_quarters, transmission_s
from protocol.vehicles import BOOT_EPOCHS, LEADER

_IDLE_STATES = 20  # as many as a trajectory packet holds


class FollowerCore:
    """One follower, as a function of what it is given and when."""

    def __init__(
        self,
        vehicle: int,
        boot_epoch: int,
        start: ReckonedState,
        *,
        settings: FollowerSettings,
        slots: Slots,
    ) -> None:
        if vehicle == LEADER:
            raise ConfigError("vehicle 0 is the leader; a follower's number is 1 or higher")
        self.vehicle, self.boot_epoch = vehicle, boot_epoch
        self.counters: Counter[str] = Counter()
        self._settings, self._slots = settings, slots
        self._reckoning = DeadReckoning(start)
        self._correction = DriftCorrection(start.time_s, settings.correction)
        self._builder = SubmapBuilder(
            vehicle,
            boot_epoch,
            settings=settings.submaps,
            sonar=settings.sonar,
            binning=settings.binning,
        )
        self._track: deque[ReckonedState] = deque(maxlen=int(settings.track_s))
        self._is_lost = False
        self._fit: SubmapFit | None = None
        self._compression = _fitting(settings, slots)
        self._outbox = Outbox(
            vehicle, boot_epoch, settings.repeats, small_frames=self._compression.small_frames
        )
        self._turns = Turns(slots, vehicle, start.time_s)
        self._last_submap_s = start.time_s

    def receive_odometry(self, odometry: Odometry) -> None:
        """Advance dead reckoning; a finished sub-map goes to the fit."""
        before = self._reckoning.state
        state = self._reckoning.receive_odometry(odometry)
        if state is before:
            return
        if state.time_s < before.time_s:
            self._set_back(before.time_s, state.time_s)
        if self._reckoning.lost_s > 0.0:
            self._correction.lose(state.time_s - self._reckoning.lost_s, state.time_s)
        if self._reckoning.is_lost:
            self._tear(state)
            return
        if self._is_lost:
            self._begin_boot()
        if not self._track or state.time_s - self._track[-1].time_s >= 1.0 - 1e-6:
            self._track.append(state)
        self._builder.receive_state(state)
        submap = self._builder.take()
        if submap is not None:
            self._begin_fit(submap)

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
        if not isinstance(packet, Answer | ExtendedAnswer) or packet.header.vehicle != LEADER:
            self.counters["frames_not_for_us"] += 1
            self.counters["frames_with_our_number"] += packet.header.vehicle == self.vehicle
            self.counters["frames_sealed"] += isinstance(packet, SealedFrame)
            return
        if isinstance(packet, ExtendedAnswer) and toa_s is not None:
            self._receive_range(packet, toa_s, now_s)
        if packet.to_vehicle != self.vehicle or packet.to_boot_epoch != self.boot_epoch:
            self.counters["answers_to_others"] += 1
            return
        self._receive_answer(packet, now_s)

    def tick(self, now_s: float) -> None:
        """Do one slice of the fit, whatever the time; queue its packets when it is done."""
        del now_s
        if self._fit is None:
            return
        for _ in range(self._settings.steps_per_tick):
            if not self._fit.step():
                self._end_fit()
                return

    def poll(self, now_s: float) -> bytes | None:
        """Return a frame to transmit now, or None: one a call, as many a slot as it holds."""
        slot_s = self._turns.due_s(now_s)
        if slot_s is None:
            return None
        packet = self._outbox.next_packet(slot_s, self._slots_left(slot_s), self._idle_states())
        if packet is None:
            self._turns.skip(now_s)
            return None
        self.counters["frames_sent"] += 1
        return encode(packet)

    def belief(self) -> Belief:
        """Return where this vehicle believes itself to be, by dead reckoning and answers."""
        state = self._reckoning.state
        position_m, covariance_m2 = self._correction.corrected(state.time_s, _position(state))
        return Belief(time_s=state.time_s, position_m=position_m, covariance_m2=covariance_m2)

    @property
    def reckoned(self) -> ReckonedState:
        """The newest state of raw dead reckoning."""
        return self._reckoning.state

    def status(self) -> dict[str, int]:
        """Return every counter: what was sent, used, rejected and dropped."""
        return {
            **self.counters,
            **self._outbox.status(),
            "slots_missed": self._turns.missed,
            "bad_odometry": self._reckoning.bad_samples,
            "odometry_set_back": self._reckoning.set_back,
            "bad_beams": self._builder.bad_beams,
            "bad_pings": self._builder.bad_pings,
            "submaps_overwritten": self._builder.submaps_overwritten,
            "answers_used": self._correction.accepted,
            "answers_without_news": self._correction.empty,
            "answers_gated": self._correction.gated,
            "answers_stale": self._correction.stale,
            "answers_restarted_us": self._correction.restarted,
            "ranges_used": self._correction.ranges_accepted,
            "ranges_gated": self._correction.ranges_gated,
        }

    def _tear(self, state: ReckonedState) -> None:
        """Send what was measured before navigation was lost by itself."""
        self._is_lost = True
        self._builder.tear(state)
        torn = self._builder.take()
        if torn is not None:
            self._begin_fit(torn)

    def _set_back(self, from_s: float, to_s: float) -> None:
        """Forget the times that are yet to come: the clock was set back."""
        while self._track and self._track[-1].time_s > to_s:
            self._track.pop()
        self._last_submap_s = min(self._last_submap_s, to_s)
        self._correction.set_back(from_s, to_s)

    def _begin_boot(self) -> None:
        """Tell the leader that dead reckoning begins anew, as after a restart."""
        self._is_lost = False
        self.counters["navigation_lost"] += 1
        self.boot_epoch = (self.boot_epoch + 1) % BOOT_EPOCHS
        self._builder.boot_epoch = self._outbox.boot_epoch = self.boot_epoch
        self._track.clear()

    def _begin_fit(self, submap: Submap) -> None:
        if submap.bins.depth_m.size < self._settings.submaps.minimum_cells:
            self.counters["submaps_too_thin"] += 1
            return
        if self._fit is not None:
            self.counters["fits_cut_short"] += 1
            self._end_fit()
        self._last_submap_s = float(submap.track.time_s[-1])
        self._fit = SubmapFit(submap, self._compression, self._settings.profile)

    def _end_fit(self) -> None:
        fit, self._fit = self._fit, None
        if fit is None:
            return
        if fit.best is None or SIZE_BYTES[fit.best.profile] > self._settings.frame_bytes:
            self.counters["submaps_unfit"] += 1  # what there is before a fit has the paper's size
            return
        self.counters["failed_factorisations"] += fit.best.report.failed_factorisations
        self.counters["fits_stopped_early"] += not fit.best.report.settled
        header = submap_header(
            vehicle=self.vehicle,
            boot_epoch=fit.submap.boot_epoch,
            submap=fit.submap.index,
            time_quarters=to_quarters(float(fit.submap.track.time_s[0])),
        )
        try:
            packets = packets_from(fit.best, fit.submap.track, header)
        except LocalProtocolError:
            self.counters["submaps_unfit"] += 1
            return
        self._outbox.add(packets)

    def _slots_left(self, slot_s: float) -> int:
        """Return how many slots are left, with this one, before the next sub-map is due.

        A sub-map that is being fitted is due now. Where sub-maps fill the air there is no slot to
        spare, and none is counted.
        """
        duration_s = self._settings.submaps.duration_s
        frames = self._compression.frames if self._settings.profile != "paper" else PAPER_FRAGMENTS
        if frames >= self._slots.frames_per_submap(duration_s):
            return 1
        due_s = duration_s * (np.floor(slot_s / duration_s + 1e-9) + 1)
        period_s = self._slots.next_slot_s(self.vehicle, slot_s + 1e-3) - slot_s
        slots_left = int(np.ceil((due_s - slot_s) / period_s - 1e-9))
        return max(1, slots_left - (frames if self._fit is not None else 0))

    def _idle_states(self) -> list[ReckonedState]:
        """Return the newest states, once there has been no sub-map for its whole duration."""
        idle_s = self._reckoning.state.time_s - self._last_submap_s
        if self._fit is not None or idle_s < 2 * self._settings.submaps.duration_s:
            return []
        return list(self._track)[-_IDLE_STATES:]

    def _receive_range(self, answer: ExtendedAnswer, toa_s: float, now_s: float) -> None:
        """Use an answer as a range: it says where the leader was, its travel time how far away."""
        if not is_arrival(toa_s, now_s):
            self.counters["ranges_unplaceable"] += 1
            return
        sent_s = transmission_s(answer.header.tx_second, toa_s)
        s, depth_m = self._settings.correction, self._reckoning.state.depth_m
        leader_m = depth_m if s.leader_depth_m is None else s.leader_depth_m
        speed_mps = s.sound_profile.speed_mps(leader_m, depth_m, s.sound_speed_mps)
        self._correction.receive_range(
            toa_s,
            self._known_track().position_at(toa_s),
            np.array([answer.leader_north_m, answer.leader_east_m]),
            float(np.sqrt(answer.leader_variance_m2)) if answer.leader_variance_m2 > 0 else np.nan,
            (toa_s - sent_s) * speed_mps,
            abs(leader_m - depth_m),
        )

    def _receive_answer(self, answer: Answer | ExtendedAnswer, now_s: float) -> None:
        """Learn from the leader's estimate of a past state; queue what it asks for."""
        if isinstance(answer, ExtendedAnswer):
            self._outbox.request(answer.repeat_submap, answer.missing_fragments, now_s)
        time_s = from_quarters(answer.header.time_quarters, now_s)
        track = self._known_track()
        if not track.time_s[0] <= time_s <= now_s:
            self.counters["answers_unplaceable"] += 1
            return
        answered_m = np.array([answer.north_m, answer.east_m])
        reckoned_m = track.position_at(time_s)
        self._correction.receive_answer(time_s, reckoned_m, answered_m, answer.sigma_m)

    def _known_track(self) -> Track:
        return track_of([*self._track, self._reckoning.state])


def _fitting(settings: FollowerSettings, slots: Slots) -> CompressionSettings:
    """Return the compression's settings with as many frames as the air has for a sub-map.

    Of two or three frames one must do: both of two arrive three times in four.
    """
    room = max(1, min(slots.frames_per_submap(settings.submaps.duration_s), 15))
    frames = settings.frames_per_submap or min(settings.compression.frames, room)
    usable = min(settings.compression.usable_frames, max(1, frames // 2))
    return dataclasses.replace(settings.compression, frames=frames, usable_frames=usable)


def _position(state: ReckonedState) -> Array:
    return np.array([state.north_m, state.east_m])
