"""Water that mistreats frames, and strangers that sound in it."""

import heapq
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from host_tools.faults.catalogue import AIR, Fault, Plan
from host_tools.faults.strangers import Strangers
from protocol.acoustics import Delivery, Water
from protocol.modems.loopback import LoopbackMedium

RECORDED = 64
"""Frames that whoever listens keeps, to play them again."""
INTRUSIONS_HZ = 0.3
"""How often a stranger sounds."""
DELAYS_S = {
    Fault.DUPLICATED: (0.0, 8.0),
    Fault.REORDERED: (4.5, 12.0),
    Fault.LATE: (30.0, 120.0),
}
UNVOUCHED = "unvouched"
"""The fate of a frame that was received, its arrival untimed."""
_STRANGE = (
    Fault.FORGED,
    Fault.REPLAYED,
    Fault.REFLECTED,
    Fault.STRANGER,
    Fault.SAME_NUMBER,
    Fault.OTHER_VERSION,
)


class FaultyMedium(LoopbackMedium):
    """The loopback's water, with the faults of a plan between the water and the modems."""

    def __init__(
        self,
        water: Water,
        plan: Plan,
        rng: np.random.Generator,
        record: Callable[[Delivery], None] | None = None,
    ) -> None:
        super().__init__(water, record)
        self._plan, self._rng = plan, rng
        self._kinds = {node: plan.kinds(node) & set(AIR) for node in water.nodes}
        self._held: list[tuple[float, int, Delivery]] = []
        self._order = 0
        self._recorded: deque[Delivery] = deque(maxlen=RECORDED)
        self._strangers = Strangers(rng)
        self._intruded_s = 0.0

    def advance(self, now_s: float) -> None:
        """Deliver what has been heard by now, and what was held back until now."""
        for delivery in self.water.deliveries_until(now_s):
            self._pass(delivery)
        while self._held and self._held[0][0] <= now_s:
            self.hand_over(heapq.heappop(self._held)[2])
        self._intrude(now_s)

    def hand_over(self, delivery: Delivery) -> None:
        """Give one delivery to the modem of its receiver."""
        if delivery.fate == UNVOUCHED:
            self.modem(delivery.destination).hear(delivery)
        else:
            super().hand_over(delivery)

    def _pass(self, delivery: Delivery) -> None:
        if delivery.was_received:
            self._recorded.append(delivery)
        kinds = self._kinds[delivery.destination] if delivery.was_received else ()
        for fault in AIR:  # in the catalogue's order
            if fault not in kinds or fault in _STRANGE:
                continue
            strike = self._plan.active(fault, delivery.destination, delivery.t_delivered_s)
            if strike is None:
                continue
            changed = self._mistreat(fault, delivery, strike.share)
            if changed is None:
                return
            delivery = changed
        self.hand_over(delivery)

    def _mistreat(self, fault: Fault, delivery: Delivery, share: float) -> Delivery | None:
        """Return what is left of a delivery now; None for nothing."""
        chance = {Fault.BURST_LOSS: 0.5 + 0.4 * share, Fault.OUTAGE: 1.0}.get(fault, 0.6)
        if self._rng.random() >= chance:
            return delivery
        self._plan.fired[fault] += 1
        if fault in {Fault.BURST_LOSS, Fault.OUTAGE}:
            return None
        if fault in DELAYS_S:
            self._hold(delivery, self._rng.uniform(*DELAYS_S[fault]))
            return delivery if fault is Fault.DUPLICATED else None
        if fault is Fault.ARRIVAL_UNVOUCHED:
            return replace(delivery, t_rx_s=None, fate=UNVOUCHED)
        if fault is Fault.ARRIVAL_WILD and delivery.t_rx_s is not None:
            wild_s = delivery.t_rx_s + 200.0 * self._rng.standard_normal()
            return replace(delivery, t_rx_s=wild_s)
        return replace(delivery, frame=self._damaged(fault, delivery.frame))

    def _damaged(self, fault: Fault, frame: bytes) -> bytes:
        cut = int(self._rng.integers(0, len(frame) + 1))
        if fault is Fault.TRUNCATED:
            return frame[:cut]
        if fault is Fault.SPLICED:
            other = self._recorded[int(self._rng.integers(len(self._recorded)))].frame
            return frame[:cut] + other[cut:]
        damaged = bytearray(frame)
        count = int(self._rng.integers(1, 40)) if frame else 0
        for bit in self._rng.integers(0, 8 * max(len(frame), 1), size=count):
            damaged[bit >> 3] ^= 1 << (bit & 7)
        return bytes(damaged)

    def _hold(self, delivery: Delivery, for_s: float) -> None:
        self._order += 1
        until_s = delivery.t_delivered_s + float(for_s)
        held = replace(delivery, t_delivered_s=until_s)
        heapq.heappush(self._held, (until_s, self._order, held))

    def _intrude(self, now_s: float) -> None:
        """Let whoever listens sound at a vehicle."""
        if now_s < self._intruded_s + 1.0:
            return
        self._intruded_s = now_s
        for vehicle, kinds in self._kinds.items():
            for fault in _STRANGE:
                if fault not in kinds or self._plan.active(fault, vehicle, now_s) is None:
                    continue
                if self._rng.random() < INTRUSIONS_HZ:
                    self._sound(fault, vehicle, now_s)

    def _sound(self, fault: Fault, vehicle: int, now_s: float) -> None:
        to = [d.frame for d in self._recorded if d.destination == vehicle]
        by = [d.frame for d in self._recorded if d.source == vehicle]
        frame = self._strangers.frame(fault, vehicle, now_s, to, by)
        if frame is None:
            return
        self._plan.fired[fault] += 1
        self.hand_over(
            Delivery(
                source=1 - vehicle,
                destination=vehicle,
                t_tx_s=now_s,
                t_rx_s=now_s,
                t_delivered_s=now_s,
                frame=frame,
                fate="stranger",
            )
        )
