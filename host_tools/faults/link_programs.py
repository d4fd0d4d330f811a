"""The link alone, in two programs: codec, seal, reassembly, repeats and slots; no fit, no graph."""

from collections import Counter
from dataclasses import replace

import numpy as np

from firmware.follower.outbox import Outbox
from protocol.codec import decode, encode
from protocol.errors import RemoteProtocolError
from protocol.modems.base import Modem, Reception
from protocol.packets import ExtendedAnswer, Header, Profile, SubmapPacket
from protocol.reassembly import Reassembler, ReassemblySettings, SubmapTransfer
from protocol.repeats import RepeatSettings
from protocol.schedule import Slots
from protocol.timestamps import to_quarters, to_tx_second

SUBMAP_S, FRAGMENTS = 40.0, 8
"""Eight frames of the ten that there is air for, so that repeats have a place."""


class LinkFollower:
    """Sends a sub-map of random content every forty seconds, and repeats what it is asked for."""

    def __init__(
        self, modem: Modem, slots: Slots, epoch: int, rng: np.random.Generator, ledger: "Ledger"
    ) -> None:
        self.counters: Counter[str] = Counter()
        self.outbox = Outbox(1, epoch, RepeatSettings(), small_frames=False)
        self._modem, self._slots, self._epoch, self._rng = modem, slots, epoch, rng
        self._ledger = ledger
        self._submap = -1
        self._due_s: float | None = None

    def step(self, now_s: float) -> None:
        """Hear, make a sub-map when it is time, speak in the slot."""
        self._modem.poll(now_s)
        while (event := self._modem.next_event()) is not None:
            if isinstance(event, Reception):
                self._hear(event)
        window = np.floor(now_s / SUBMAP_S)
        if self._due_s is None or window != self._due_s:
            self._due_s = window
            self._make(now_s)
        if self._slots.next_slot_s(1, now_s) == now_s and self._modem.status().is_up:
            left = 1 + int((SUBMAP_S - 1 - now_s % SUBMAP_S) // 4)
            packet = self.outbox.next_packet(now_s, left, ())
            if packet is not None:
                self._modem.send(encode(packet), now_s)

    def abandon(self) -> None:
        """Hold nothing."""

    def _hear(self, heard: Reception) -> None:
        packet = _decoded(heard.frame, self.counters)
        if packet is None or not self._ledger.take(packet):
            return
        if isinstance(packet, ExtendedAnswer) and packet.to_vehicle == 1:
            self._ledger.answered_s = self._ledger.now_s
            if packet.to_boot_epoch == self._epoch:
                self.counters["answers"] += 1
                self.outbox.request(packet.repeat_submap, packet.missing_fragments, heard.heard_s)

    def _make(self, now_s: float) -> None:
        self._submap += 1
        fragments = [self._fragment(k, now_s) for k in range(FRAGMENTS)]
        for fragment in fragments:
            self._ledger.give(fragment)
        self.outbox.add(fragments)

    def _fragment(self, number: int, now_s: float) -> SubmapPacket:
        values = self._rng.standard_normal((20, 3)).astype(np.float32)
        return SubmapPacket(
            header=Header(
                profile=Profile.SUBMAP_PAPER,
                vehicle=1,
                boot_epoch=self._epoch,
                submap=self._submap,
                fragment=number,
                fragment_count=FRAGMENTS,
                tx_second=0,
                time_quarters=to_quarters(now_s),
            ),
            trajectory=values[:4],
            points_ned_m=values[4:19],
            hyperparameters=np.ones(4, dtype=np.float32),
        )


class LinkLeader:
    """Gathers fragments, and answers with what it lacks."""

    def __init__(self, modem: Modem, slots: Slots, epoch: int, ledger: "Ledger") -> None:
        self.counters: Counter[str] = Counter()
        self.reassembler = Reassembler(ReassemblySettings(fragments_with_repeats=9))
        self._modem, self._slots, self._epoch, self._ledger = modem, slots, epoch, ledger
        self._answers = 0
        self._follower_epoch: int | None = None

    def step(self, now_s: float) -> None:
        """Hear, gather, answer in the slot."""
        self._modem.poll(now_s)
        while (event := self._modem.next_event()) is not None:
            if isinstance(event, Reception):
                self._hear(event)
        self.reassembler.advance(now_s)
        self.collect()
        if self._slots.next_slot_s(0, now_s) == now_s and self._modem.status().is_up:
            answer = self._answer(now_s)
            if answer is not None:
                self._ledger.give(answer)
                self._modem.send(encode(answer), now_s)

    def collect(self) -> None:
        """Take what the reassembly has closed."""
        while (event := self.reassembler.next_event()) is not None:
            if isinstance(event, SubmapTransfer):
                self._ledger.close(event)

    def abandon(self) -> None:
        """Hold nothing; what was not handed on goes with this life."""
        self._ledger.forget()

    def _hear(self, heard: Reception) -> None:
        packet = _decoded(heard.frame, self.counters)
        if packet is None or not self._ledger.take(packet):
            return
        if isinstance(packet, SubmapPacket):
            before = self.reassembler.counters.accepted
            self.reassembler.receive(packet, heard.heard_s)
            self._ledger.placed += self.reassembler.counters.accepted - before
            self._follower_epoch = packet.header.boot_epoch

    def _answer(self, now_s: float) -> ExtendedAnswer | None:
        if self._follower_epoch is None:
            return None
        self._answers += 1
        submap, missing = self.reassembler.missing(1, self._follower_epoch) or (0, 0)
        return ExtendedAnswer(
            header=Header(
                profile=Profile.ANSWER_EXTENDED,
                vehicle=0,
                boot_epoch=self._epoch,
                submap=self._answers % (1 << 16),
                fragment=1,
                fragment_count=self._follower_epoch,
                tx_second=to_tx_second(now_s),
                time_quarters=to_quarters(now_s),
            ),
            submap=0,
            north_m=float(self._answers),
            east_m=0.0,
            variance_m2=1.0,
            leader_north_m=0.0,
            leader_east_m=0.0,
            leader_variance_m2=1.0,
            repeat_submap=submap,
            missing_fragments=missing,
        )


class Ledger:
    """What was said and what was believed: the truth that the invariants are held against."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.violations: list[str] = []
        self.placed = self.closed = 0
        self.completed_s = self.answered_s = -1.0
        self.complete = 0
        self._said: dict[object, bytes] = {}

    def give(self, packet: SubmapPacket | ExtendedAnswer) -> None:
        """Note what a vehicle made."""
        self._said[_name(packet)] = _content(packet)

    def take(self, packet: object) -> bool:
        """Return whether a packet that passed the seal was said so by the peer; it must be."""
        if not isinstance(packet, SubmapPacket | ExtendedAnswer):
            self.violations.append(f"{type(packet).__name__} was believed, and never sent")
            return False
        if self._said.get(_name(packet)) != _content(packet):
            self.violations.append(f"a packet was believed that nobody sent: {packet.header}")
            return False
        return True

    def close(self, transfer: SubmapTransfer) -> None:
        """Note a sub-map handed on."""
        self.closed += len(transfer.fragments)
        if transfer.is_complete:
            self.complete += 1
            self.completed_s = self.now_s

    def forget(self) -> None:
        """Let the leader die: what it had not handed on is lost with it, and asked for no more."""
        self.placed = self.closed


def _name(packet: SubmapPacket | ExtendedAnswer) -> object:
    header = packet.header
    return header.vehicle, header.boot_epoch, header.submap, header.fragment, header.time_quarters


def _content(packet: SubmapPacket | ExtendedAnswer) -> bytes:
    """Return what must arrive as it was sent: all but the second of transmission and the CRC."""
    if isinstance(packet, SubmapPacket):
        points = np.array(packet.points_ned_m)
        points[14:] = 0.0
        packet = replace(packet, points_ned_m=points)
    return encode(replace(packet, header=replace(packet.header, tx_second=0)))


def _decoded(frame: bytes, counters: Counter[str]) -> object | None:
    try:
        return decode(frame)
    except RemoteProtocolError as error:
        counters[error.cause] += 1
        return None
