"""What a follower transmits: fragments, repeats of lost ones, or its trajectory alone."""

from collections import Counter
from collections.abc import Sequence

from firmware.compression.packing import states_by_second
from firmware.dead_reckoning import ReckonedState
from firmware.submap_builder import track_of
from protocol.packets import Fragment, Header, Packet, Profile, TrajectoryPacket
from protocol.repeats import FragmentQueue, RepeatSettings
from protocol.timestamps import to_quarters, to_tx_second

_STATES = {Profile.TRAJECTORY: 20, Profile.TRAJECTORY_SMALL: 4}


class Outbox:
    """One packet a slot: fresh fragments first, repeats where there is air, else trajectory."""

    def __init__(
        self, vehicle: int, boot_epoch: int, settings: RepeatSettings, *, small_frames: bool
    ) -> None:
        self.counters: Counter[str] = Counter()
        self._vehicle, self.boot_epoch = vehicle, boot_epoch
        self._profile = Profile.TRAJECTORY_SMALL if small_frames else Profile.TRAJECTORY
        self._queue = FragmentQueue(settings)
        self._trajectory_packets = 0

    def add(self, packets: Sequence[Fragment]) -> None:
        """Queue a sub-map, unless half of an earlier one still waits: it would only grow old."""
        if 2 * self._queue.fresh >= len(packets):
            self.counters["submaps_without_air"] += 1
            return
        self._queue.add(packets)
        self.counters["submaps_sent"] += 1

    def request(self, submap: int, bitmap: int, asked_s: float) -> None:
        """Take the leader's request for fragments that it lacks."""
        self._queue.request(submap, bitmap, asked_s)

    def next_packet(
        self, slot_s: float, slots_left: int, idle_states: Sequence[ReckonedState]
    ) -> Packet | None:
        """Return what to transmit in this slot; idle_states go out when nothing else waits.

        slots_left counts this slot and those before the next sub-map is due.
        """
        fragment = self._queue.next_fragment(slot_s, slots_left)
        if fragment is not None:
            return fragment
        return self._trajectory(idle_states, slot_s) if idle_states else None

    def status(self) -> dict[str, int]:
        """Return what was queued, repeated and dropped."""
        return {
            **self.counters,
            **{f"fragments_{k}": v for k, v in self._queue.counters.items()},
            "fragments_waiting": self._queue.fresh,
            "fragments_wanted": self._queue.wanted,
        }

    def _trajectory(self, states: Sequence[ReckonedState], slot_s: float) -> TrajectoryPacket:
        """Return the newest of the states, at the places of their seconds."""
        count = _STATES[self._profile]
        newest_s = states[-1].time_s
        track = track_of([state for state in states if state.time_s > newest_s - count + 0.5])
        self._trajectory_packets = (self._trajectory_packets + 1) % (1 << 16)
        header = Header(
            profile=self._profile,
            vehicle=self._vehicle,
            boot_epoch=self.boot_epoch,
            submap=self._trajectory_packets,
            fragment=0,
            fragment_count=1,
            tx_second=to_tx_second(slot_s),
            time_quarters=to_quarters(float(track.time_s[0])),
        )
        return TrajectoryPacket(header=header, states=states_by_second(track, count))
