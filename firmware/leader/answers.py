"""What the leader tells its followers: whose turn it is, which state is answered, in which form."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from firmware.belief import Belief
from firmware.leader.fleet import Fleet
from firmware.leader.pose_graph import PoseGraph
from protocol.errors import EstimationError
from protocol.packets import Answer, ExtendedAnswer, Header, Profile, answer_count
from protocol.reassembly import Reassembler
from protocol.timestamps import to_quarters, to_tx_second
from protocol.vehicles import LEADER

_SILENT_S = 900.0  # no follower keeps a frame for as long: that it hears answers is a hope


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownState:
    """The newest state that is known of a follower, and the packet it came in."""

    chain: int
    boot_epoch: int
    submap: int
    time_s: float


class Answers:
    """One answer a slot; followers take turns, and one that cannot be answered loses its turn.

    Those that have fallen silent come after all others.
    """

    def __init__(self, boot_epoch: int, fleet: Fleet, graph: PoseGraph, *, extended: bool) -> None:
        self.counters: Counter[str] = Counter()
        self._boot_epoch, self._extended = boot_epoch, extended
        self._fleet, self._graph = fleet, graph
        self._known: dict[int, KnownState] = {}
        self._last_vehicle = LEADER
        self._sent = 0

    def note(self, header: Header, chain: int, time_s: float) -> None:
        """Take notice of a state; only a newer one, or one of a newer boot, is answered."""
        known = self._known.get(header.vehicle)
        if known is None or chain > known.chain or time_s > known.time_s:
            self._known[header.vehicle] = KnownState(
                chain=chain, boot_epoch=header.boot_epoch, submap=header.submap, time_s=time_s
            )

    def next_answer(
        self, belief: Callable[[], Belief], reassembler: Reassembler, now_s: float
    ) -> Answer | ExtendedAnswer | None:
        """Return the answer of this slot, or None if nobody can be told anything.

        `belief` tells where the leader is; only an extended answer asks.
        """
        silent = {v for v, known in self._known.items() if now_s - known.time_s > _SILENT_S}
        for vehicle in sorted(self._known, key=lambda v: (v in silent, v <= self._last_vehicle, v)):
            known = self._known[vehicle]
            try:
                answer = self._answer(vehicle, known, belief, reassembler, now_s)
            except EstimationError:
                self.counters["answers_unplaceable"] += 1
                continue
            self._last_vehicle = vehicle
            self._sent = (self._sent + 1) % (1 << 16)
            self.counters["answers_sent"] += 1
            return answer
        return None

    def _answer(
        self,
        vehicle: int,
        known: KnownState,
        belief: Callable[[], Belief],
        reassembler: Reassembler,
        now_s: float,
    ) -> Answer | ExtendedAnswer:
        self._fleet.extend(known.chain)
        anchor = self._graph.anchor(known.chain, known.time_s, self._fleet.track(known.chain))
        position_m = self._graph.position(anchor)
        variance_m2 = float(np.trace(self._graph.covariance([anchor])) / 2)
        count = answer_count(float(np.sqrt(max(variance_m2, 0.0))), self._sent)
        header = Header(
            profile=Profile.ANSWER_EXTENDED if self._extended else Profile.ANSWER,
            vehicle=LEADER,
            boot_epoch=self._boot_epoch,
            submap=self._sent if self._extended else count,
            fragment=vehicle,
            fragment_count=known.boot_epoch,
            tx_second=to_tx_second(round(now_s)),
            time_quarters=to_quarters(known.time_s),
        )
        if not self._extended:
            return Answer(
                header=header,
                submap=known.submap,
                north_m=_float32(position_m[0]),
                east_m=_float32(position_m[1]),
            )
        own = belief()
        repeat_submap, missing = reassembler.missing(vehicle, known.boot_epoch) or (0, 0)
        self.counters["repeats_asked"] += missing.bit_count()
        return ExtendedAnswer(
            header=header,
            submap=known.submap,
            north_m=_float32(position_m[0]),
            east_m=_float32(position_m[1]),
            variance_m2=_float32(variance_m2),
            leader_north_m=_float32(own.position_m[0]),
            leader_east_m=_float32(own.position_m[1]),
            leader_variance_m2=_float32(np.trace(own.covariance_m2) / 2),
            repeat_submap=repeat_submap,
            missing_fragments=missing,
        )


def _float32(value: float) -> float:
    return float(np.float32(value))
