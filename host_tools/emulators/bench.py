"""A bench of emulated modems in one water: the medium hands packets on, time is passed in.

All emulators share a `protocol.acoustics.Water`: geometry, travel time, half-duplex, collisions,
loss per packet, damage and noisy arrival times are drawn there, from its seed. A packet keeps its
parts beside the bytes that the water may damage, so that a modem's own check knows which frame
was hit and how hard.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from protocol.acoustics import Delivery, Water

AIRBORNE_S = 60.0
"""How long a packet's parts are kept: longer than any airtime and travel time together."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AirPacket:
    """What one modem sounds: its dialect and kind, addresses, and frames checked one by one."""

    dialect: str
    kind: str
    source: int
    destination: int
    airtime_s: float
    frames: tuple[bytes, ...] = ()
    rate: int = 0
    acknowledge: bool = False

    @property
    def on_air(self) -> bytes:
        """The bytes that the water carries; a packet without payload still has one."""
        return b"".join(self.frames) or b"\x00"


@dataclass(frozen=True, slots=True, kw_only=True)
class Heard:
    """What a modem made of a packet: wrong bytes per frame, or a fate that spoilt all of it."""

    packet: AirPacket
    t_rx_s: float | None
    fate: str
    wrong_bytes: tuple[int, ...]

    @property
    def whole(self) -> bool:
        """Whether the packet's header and timing came through."""
        return self.t_rx_s is not None


class Unit(Protocol):
    """One emulated modem, without I/O."""

    def receive_data(self, data: bytes, now_s: float) -> None:
        """Take bytes from the host."""

    def poll(self, now_s: float) -> bytes:
        """Return the bytes that have reached the host by now."""

    def next_wakeup_s(self, now_s: float) -> float:
        """Return when the modem will next do something by itself."""

    def run(self, now_s: float) -> list[AirPacket]:
        """Do what is due; return the packets that start to sound now."""

    def detect(self, packet: AirPacket, now_s: float) -> None:
        """Note the beginning of a packet at the transducer."""

    def hear(self, heard: Heard, now_s: float) -> None:
        """Take the end of a packet, whatever became of it."""

    def power_cycle(self, now_s: float) -> None:
        """Lose everything that a real one loses."""


class Bench:
    """Runs the units of a water in the order of their events, up to the time that is asked for."""

    def __init__(
        self,
        water: Water,
        units: Mapping[int, Unit],
        record: Callable[[Delivery], None] | None = None,
    ) -> None:
        self.water, self.units = water, dict(units)
        self._record = record
        self.now_s = 0.0
        self.fates: dict[str, int] = {}
        self._airborne: dict[tuple[int, float], AirPacket] = {}
        self._detections: list[tuple[float, int, int, float]] = []

    def advance(self, now_s: float) -> None:
        """Do everything that happens up to and including now_s, in order."""
        while True:
            event_s = self.next_event_s()
            if event_s > now_s:
                break
            self.now_s = max(self.now_s, event_s)
            self._do_due()
        self.now_s = max(self.now_s, now_s)
        self._do_due()

    def end(self) -> None:
        """Record what is still under way; nobody hears it any more."""
        for delivery in self.water.deliveries_until(math.inf):
            self._note(delivery)

    def next_event_s(self) -> float:
        """Return when something will happen by itself, inf when nothing will."""
        times = [unit.next_wakeup_s(self.now_s) for unit in self.units.values()]
        delivery_s = self.water.next_delivery_s()
        times.append(math.inf if delivery_s is None else delivery_s)
        times.append(self._detections[0][0] if self._detections else math.inf)
        return min(times)

    def _do_due(self) -> None:
        """Let arrivals be heard before anything new is sounded at the same instant."""
        while self._detections and self._detections[0][0] <= self.now_s:
            _, node, source, t_tx_s = self._detections.pop(0)
            if self.now_s >= self.water.transmitting_until_s(node):
                self.units[node].detect(self._airborne[source, t_tx_s], self.now_s)
        for delivery in self.water.deliveries_until(self.now_s):
            self._deliver(delivery)
        for node, unit in self.units.items():
            for packet in unit.run(self.now_s):
                self._transmit(node, packet)

    def _transmit(self, node: int, packet: AirPacket) -> None:
        if self.now_s < self.water.transmitting_until_s(node):
            self.fates["transmitter busy"] = self.fates.get("transmitter busy", 0) + 1
            return
        self.water.transmit(node, self.now_s, packet.on_air, airtime_s=packet.airtime_s)
        old = [key for key in self._airborne if key[1] < self.now_s - AIRBORNE_S]
        for key in old:
            del self._airborne[key]
        self._airborne[node, self.now_s] = packet
        for other in self.units:
            if other != node:
                travel_s = self.water.travel_time_s(node, other, self.now_s)
                if travel_s * self.water.settings.sound_speed_mps <= self.water.settings.reach_m:
                    self._detections.append((self.now_s + travel_s, other, node, self.now_s))
        self._detections.sort()

    def _note(self, delivery: Delivery) -> None:
        self.fates[delivery.fate] = self.fates.get(delivery.fate, 0) + 1
        if self._record is not None:
            self._record(delivery)

    def _deliver(self, delivery: Delivery) -> None:
        self._note(delivery)
        packet = self._airborne.get((delivery.source, delivery.t_tx_s))
        unit = self.units.get(delivery.destination)
        if packet is None or unit is None or delivery.fate in {"out-of-reach", "half-duplex"}:
            return
        heard = Heard(
            packet=packet,
            t_rx_s=delivery.t_rx_s,
            fate=delivery.fate,
            wrong_bytes=_wrong_bytes(packet, delivery.frame),
        )
        unit.hear(heard, self.now_s)


def _wrong_bytes(packet: AirPacket, arrived: bytes) -> tuple[int, ...]:
    """Return how many bytes of each frame the water changed."""
    counts, start = [], 0
    for frame in packet.frames:
        part = arrived[start : start + len(frame)]
        counts.append(sum(a != b for a, b in zip(frame, part, strict=False)))
        start += len(frame)
    return tuple(counts)


class Line:
    """The serial line out of a modem: bytes reach the host as fast as the speed allows."""

    def __init__(self, baud: int) -> None:
        self._byte_s = 10.0 / baud
        self._queue: list[tuple[float, bytes]] = []
        self._free_s = 0.0

    def put(self, data: bytes, now_s: float) -> None:
        """Send bytes behind what is still being sent; the host has them when the last is over."""
        self._free_s = max(self._free_s, now_s) + len(data) * self._byte_s
        self._queue.append((self._free_s, data))

    def take(self, now_s: float) -> bytes:
        """Return what has arrived by now."""
        data = b""
        while self._queue and self._queue[0][0] <= now_s:
            data += self._queue.pop(0)[1]
        return data

    def next_s(self) -> float:
        """Return when the next bytes arrive."""
        return self._queue[0][0] if self._queue else math.inf

    def clear(self) -> None:
        """Lose what is being sent."""
        self._queue.clear()
        self._free_s = 0.0
