"""The follower: odometry, pings and answers in; packets out. No port, no clock, no thread."""

import dataclasses
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from firmware.belief import Belief
from firmware.compression import Compressed, compress_steps, packets_from
from firmware.follower.settings import FollowerSettings
from firmware.dead_reckoning import DeadReckoning, ReckonedState
from firmware.follower.correction import DriftCorrection
from firmware.geometry import Array
from firmware.soundings import Odometry, Ping
from firmware.submap_builder import SubmapBuilder, track_of
from firmware.submaps import Submap
from protocol.codec import decode, encode
from protocol.errors import ConfigError, EstimationError, RemoteProtocolError
from protocol.packets import Answer, Header, Packet, Profile, TrajectoryPacket
from protocol.schedule import Slots
from protocol.timestamps import from_quarters, to_quarters, to_tx_second

_STATES_PER_TRAJECTORY_PACKET = 20
_QUEUED_PACKETS = 30  # three sub-maps: what cannot leave within two minutes is too old to matter


@dataclass(slots=True)
class _Fit:
    """A sub-map under compression: the steps still to do, and the best result so far."""

    submap: Submap
    steps: Iterator[Compressed]
    best: Compressed | None = None


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
        if vehicle == 0:
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
        self._fit: _Fit | None = None
        self._outbox: deque[Packet] = deque(maxlen=_QUEUED_PACKETS)
        self._next_slot_s = slots.next_slot_s(vehicle, start.time_s)
        self._trajectory_packets = 0
        self._last_submap_s = start.time_s

    def receive_odometry(self, odometry: Odometry) -> None:
        """Advance dead reckoning; a finished sub-map goes to the fit."""
        state = self._reckoning.receive_odometry(odometry)
        if not self._track or state.time_s - self._track[-1].time_s >= 1.0 - 1e-6:
            self._track.append(state)
        self._builder.receive_state(state)
        submap = self._builder.take()
        if submap is not None:
            self._begin_fit(submap)

    def receive_ping(self, ping: Ping) -> None:
        """Add the soundings of a ping to the sub-map being measured."""
        self._builder.receive_ping(ping, self._reckoning.state)

    def receive_frame(self, frame: bytes, now_s: float) -> None:
        """Take a frame from the water; whatever is no answer to this vehicle is counted."""
        try:
            packet = decode(frame)
        except RemoteProtocolError:
            self.counters["frames_rejected"] += 1
            return
        if isinstance(packet, Answer):
            self._receive_answer(packet, now_s)
        else:
            self.counters["frames_not_for_us"] += 1

    def tick(self, now_s: float) -> None:
        """Do one slice of the fit; queue its packets when it is done or its first slot is due."""
        del now_s
        if self._fit is None:
            return
        for _ in range(self._settings.steps_per_tick):
            step = next(self._fit.steps, None)
            if step is None:
                self._end_fit()
                return
            self._fit.best = step

    def poll(self, now_s: float) -> bytes | None:
        """Return the frame to transmit now, or None; one a slot, on a whole second."""
        if now_s < self._next_slot_s - 1e-6:
            return None
        slot_s = self._slots.next_slot_s(self.vehicle, now_s)
        on_time = abs(slot_s - now_s) < 1e-6
        self._next_slot_s = self._slots.next_slot_s(self.vehicle, now_s + 1e-3)
        if not on_time:
            self.counters["slots_missed"] += 1
            return None
        packet = self._outbox.popleft() if self._outbox else self._trajectory_packet()
        if packet is None:
            return None
        header = dataclasses.replace(packet.header, tx_second=to_tx_second(round(now_s)))
        self.counters["frames_sent"] += 1
        return encode(dataclasses.replace(packet, header=header))

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
            "bad_odometry": self._reckoning.bad_samples,
            "bad_beams": self._builder.bad_beams,
            "bad_pings": self._builder.bad_pings,
            "answers_used": self._correction.accepted,
            "answers_gated": self._correction.gated,
            "answers_stale": self._correction.stale,
            "answers_restarted_us": self._correction.restarted,
        }

    def _begin_fit(self, submap: Submap) -> None:
        if self._fit is not None:
            self.counters["fits_cut_short"] += 1
            self._end_fit()
        if submap.bins.depth_m.size < self._settings.submaps.minimum_cells:
            self.counters["submaps_too_thin"] += 1
            return
        self._last_submap_s = float(submap.track.time_s[-1])
        try:
            steps = compress_steps(submap.bins, self._settings.compression)
        except EstimationError:
            self.counters["submaps_unfit"] += 1
            return
        self._fit = _Fit(submap=submap, steps=steps)

    def _end_fit(self) -> None:
        fit, self._fit = self._fit, None
        if fit is None:
            return
        if fit.best is None:
            self.counters["submaps_unfit"] += 1
            return
        header = Header(
            profile=Profile.SUBMAP_PAPER,
            vehicle=self.vehicle,
            boot_epoch=self.boot_epoch,
            submap=fit.submap.index,
            fragment=0,
            fragment_count=10,
            tx_second=0,
            time_quarters=to_quarters(float(fit.submap.track.time_s[0])),
        )
        packets = packets_from(fit.best, fit.submap.track, header)
        self.counters["packets_overwritten"] += max(
            0, len(self._outbox) + len(packets) - _QUEUED_PACKETS
        )
        self._outbox.extend(packets)
        self.counters["submaps_sent"] += 1

    def _trajectory_packet(self) -> TrajectoryPacket | None:
        """Return the newest states alone, once there has been no sub-map for its whole duration."""
        now_s = self._reckoning.state.time_s
        idle_s = now_s - self._last_submap_s
        if self._fit is not None or idle_s < 2 * self._settings.submaps.duration_s:
            return None
        states = list(self._track)[-_STATES_PER_TRAJECTORY_PACKET:]
        track = track_of(states)
        rows = np.full((_STATES_PER_TRAJECTORY_PACKET, 3), np.nan, dtype=np.float32)
        offsets = np.round(track.time_s - track.time_s[0]).astype(int)
        kept = offsets < _STATES_PER_TRAJECTORY_PACKET
        rows[offsets[kept]] = np.column_stack([track.north_m, track.east_m, track.yaw_rad])[kept]
        self._trajectory_packets = (self._trajectory_packets + 1) % (1 << 16)
        header = Header(
            profile=Profile.TRAJECTORY,
            vehicle=self.vehicle,
            boot_epoch=self.boot_epoch,
            submap=self._trajectory_packets,
            fragment=0,
            fragment_count=1,
            tx_second=0,
            time_quarters=to_quarters(float(track.time_s[0])),
        )
        return TrajectoryPacket(header=header, states=rows)

    def _receive_answer(self, answer: Answer, now_s: float) -> None:
        if answer.to_vehicle != self.vehicle or answer.to_boot_epoch != self.boot_epoch:
            self.counters["frames_not_for_us"] += 1
            return
        time_s = from_quarters(answer.header.time_quarters, now_s)
        track = track_of(list(self._track))
        if not track.time_s.size or not track.time_s[0] <= time_s <= now_s:
            self.counters["answers_unplaceable"] += 1
            return
        answered_m = np.array([answer.north_m, answer.east_m])
        self._correction.receive_answer(time_s, track.position_at(time_s), answered_m)


def _position(state: ReckonedState) -> Array:
    return np.array([state.north_m, state.east_m])
