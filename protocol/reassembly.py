"""Fragments to sub-maps, when some are lost, repeated, late, mixed or from before a restart.

A fixed number of slots, each one sub-map of one vehicle in one boot epoch. A transfer is handed on
when it is complete or has enough fragments to give all that the others would, when a newer one of
its vehicle has been on the air for a while, when it has grown too old, or when its slot is needed:
always with what has arrived, never twice.
"""

from collections import OrderedDict, deque
from collections.abc import Mapping
from dataclasses import dataclass, field

from protocol.lattice import frames_for_all
from protocol.packets import Fragment, SubmapFragment
from protocol.settings import Settings, setting
from protocol.timestamps import QUARTERS_MODULO

Key = tuple[int, int, int]
"""Vehicle, boot epoch, sub-map."""

SUBMAPS_MODULO = 1 << 16


@dataclass(frozen=True, slots=True, kw_only=True)
class ReassemblySettings(Settings):
    """How much is held, and for how long."""

    slots: int = setting(
        10, "transfers", "five vehicles, a current and an overtaken sub-map each", minimum=1
    )
    overtaken_s: float = setting(
        10.0,
        "s",
        "after a newer sub-map began: frames of one vehicle keep their order, or nearly",
        minimum=0.0,
    )
    repeated_s: float = setting(
        60.0, "s", "the same where the sender has air for repeats: five rounds of them", minimum=0.0
    )
    fragments_with_repeats: int = setting(
        0, "fragments", "transfers of so many or fewer are repeated; 0: none is", minimum=0
    )
    oldest_s: float = setting(
        240.0,
        "s",
        "since the first fragment: ten slots of a follower that shares with four",
        minimum=1.0,
    )
    remembered: int = setting(
        64, "transfers", "closed ones, to tell a late fragment from a new sub-map", minimum=1
    )
    span_s: float = setting(
        600.0,
        "s",
        "the times of one sub-map's slices lie within it; beyond, the counter has begun anew",
        minimum=60.0,
    )
    queued_events: int = setting(
        64, "events", "that nobody has fetched: four sub-maps of fragments and more", minimum=16
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class FragmentArrived:
    """A fragment not seen before: its slice of trajectory is of use at once."""

    fragment: Fragment
    arrival_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SubmapTransfer:
    """A sub-map as far as it came.

    reason: complete, enough (the others would tell nothing new), overtaken, too-old, evicted or
    flushed.
    """

    vehicle: int
    boot_epoch: int
    submap: int
    fragment_count: int
    fragments: Mapping[int, Fragment]
    first_arrival_s: float
    last_arrival_s: float
    reason: str

    @property
    def is_complete(self) -> bool:
        """Whether all fragments arrived."""
        return len(self.fragments) == self.fragment_count


ReassemblyEvent = FragmentArrived | SubmapTransfer


@dataclass(slots=True, kw_only=True)
class ReassemblyCounters:
    """What became of fragments and transfers, for the status line; `open` is how many are.

    Transfers that had enough count as complete; a fragment of a closed transfer is spare where
    that lacked nothing, else late.
    """

    accepted: int = 0
    duplicates: int = 0
    late: int = 0
    spare: int = 0
    conflicting: int = 0
    restarted: int = 0
    complete: int = 0
    partial: int = 0
    evicted: int = 0
    events_dropped: int = 0
    open: int = 0


@dataclass(frozen=True, slots=True)
class _Closed:
    """A transfer that was handed on: the time of one of its slices, and whether it lacked any."""

    time_quarters: int
    lacked: bool


@dataclass(slots=True)
class _Slot:
    """A transfer under way."""

    first: Fragment
    first_arrival_s: float
    last_arrival_s: float
    fragments: dict[int, Fragment] = field(default_factory=dict)
    overtaken_at_s: float | None = None

    @property
    def enough(self) -> int | None:
        """How many fragments tell as much as all; none where each tells something of its own."""
        first = self.first
        return frames_for_all(first.body) if isinstance(first, SubmapFragment) else None


class Reassembler:
    """Fragments in by `receive`, time in by `advance`, transfers out by `next_event`."""

    def __init__(self, settings: ReassemblySettings) -> None:
        self.counters = ReassemblyCounters()
        self._settings = settings
        self._slots: OrderedDict[Key, _Slot] = OrderedDict()
        self._closed: OrderedDict[Key, _Closed] = OrderedDict()
        self._events: deque[ReassemblyEvent] = deque()

    def receive(self, packet: Fragment, arrival_s: float) -> None:
        """Take a fragment; what it completes or overtakes comes out of `next_event`."""
        self.advance(arrival_s)
        header = packet.header
        key = (header.vehicle, header.boot_epoch, header.submap)
        closed = self._closed.get(key)
        if closed is not None:
            if self._is_same_time(closed.time_quarters, header.time_quarters):
                self.counters.late += closed.lacked
                self.counters.spare += not closed.lacked
                return
            del self._closed[key]
            self.counters.restarted += 1
        slot = self._slots.get(key)
        if slot is not None and not self._is_same_time(
            slot.first.header.time_quarters, header.time_quarters
        ):
            self.counters.restarted += 1
            self._close(key, "overtaken")
            del self._closed[key]
            slot = None
        if slot is None:
            slot = self._open(key, packet, arrival_s)
        self._place(key, slot, packet, arrival_s)

    def advance(self, now_s: float) -> None:
        """Close the transfers whose deadline has passed, or was set back as far as that."""
        for key, slot in list(self._slots.items()):
            overtaken = slot.overtaken_at_s
            if overtaken is not None and abs(now_s - overtaken) >= self._patience_s(slot):
                self._close(key, "overtaken")
            elif abs(now_s - slot.first_arrival_s) >= self._settings.oldest_s:
                self._close(key, "too-old")

    def flush(self) -> None:
        """Close everything, at the end of a mission."""
        for key in list(self._slots):
            self._close(key, "flushed")

    def next_event(self) -> ReassemblyEvent | None:
        """Return the oldest event not yet fetched, or None."""
        return self._events.popleft() if self._events else None

    def missing(self, vehicle: int, boot_epoch: int) -> tuple[int, int] | None:
        """Return the oldest sub-map of a boot that lacks fragments, and the bitmap of those.

        Bit i stands for fragment i. Fragments after the last one heard are not asked for while the
        transfer is the vehicle's newest: they may still be on their way.
        """
        for key, slot in self._slots.items():
            if key[:2] != (vehicle, boot_epoch):
                continue
            count = slot.first.header.fragment_count
            end = count if slot.overtaken_at_s is not None else max(slot.fragments)
            bitmap = sum(1 << i for i in range(end) if i not in slot.fragments)
            if bitmap:
                return key[2], bitmap
        return None

    def _open(self, key: Key, packet: Fragment, arrival_s: float) -> _Slot:
        if len(self._slots) == self._settings.slots:
            self.counters.evicted += 1
            self._close(next(iter(self._slots)), "evicted")
        slot = _Slot(packet, arrival_s, arrival_s)
        for other_key, other in self._slots.items():
            if other_key[0] == key[0] and other.overtaken_at_s is None:
                if _is_newer(key, other_key):
                    other.overtaken_at_s = arrival_s
                else:
                    slot.overtaken_at_s = arrival_s
        self._slots[key] = slot
        self.counters.open = len(self._slots)
        return slot

    def _place(self, key: Key, slot: _Slot, packet: Fragment, arrival_s: float) -> None:
        header, first = packet.header, slot.first.header
        if (header.profile, header.fragment_count) != (first.profile, first.fragment_count):
            self.counters.conflicting += 1
            return
        if header.fragment in slot.fragments:
            self.counters.duplicates += 1
            return
        self.counters.accepted += 1
        slot.fragments[header.fragment] = packet
        slot.last_arrival_s = arrival_s
        self._push(FragmentArrived(fragment=packet, arrival_s=arrival_s))
        if len(slot.fragments) == first.fragment_count:
            self._close(key, "complete")
        elif len(slot.fragments) == slot.enough:
            self._close(key, "enough")

    def _close(self, key: Key, reason: str) -> None:
        slot = self._slots.pop(key)
        self.counters.open = len(self._slots)
        lacked = reason not in {"complete", "enough"}
        self.counters.partial += lacked
        self.counters.complete += not lacked
        while len(self._closed) >= self._settings.remembered:
            self._closed.popitem(last=False)
        self._closed[key] = _Closed(slot.first.header.time_quarters, lacked)
        vehicle, boot_epoch, submap = key
        self._push(
            SubmapTransfer(
                vehicle=vehicle,
                boot_epoch=boot_epoch,
                submap=submap,
                fragment_count=slot.first.header.fragment_count,
                fragments=dict(sorted(slot.fragments.items())),
                first_arrival_s=slot.first_arrival_s,
                last_arrival_s=slot.last_arrival_s,
                reason=reason,
            )
        )

    def _patience_s(self, slot: _Slot) -> float:
        s = self._settings
        repeats = slot.first.header.fragment_count <= s.fragments_with_repeats
        return s.repeated_s if repeats else s.overtaken_s

    def _push(self, event: ReassemblyEvent) -> None:
        if len(self._events) == self._settings.queued_events:
            self._events.popleft()
            self.counters.events_dropped += 1
        self._events.append(event)

    def _is_same_time(self, one_quarters: int, other_quarters: int) -> bool:
        apart = (one_quarters - other_quarters) % QUARTERS_MODULO
        return min(apart, QUARTERS_MODULO - apart) <= 4.0 * self._settings.span_s


def _is_newer(key: Key, than: Key) -> bool:
    """Return whether a transfer that begins now follows another of the same vehicle.

    The counter wraps; a different boot epoch that begins now is the newer one.
    """
    if key[1] != than[1]:
        return True
    return 0 < (key[2] - than[2]) % SUBMAPS_MODULO < SUBMAPS_MODULO // 2
