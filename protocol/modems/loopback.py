"""Modems in one process over a model of the water, in simulated time."""

from collections import deque
from collections.abc import Callable

from protocol.acoustics import Delivery, Water
from protocol.errors import ConfigError
from protocol.modems.base import (
    QUEUED_EVENTS,
    QUEUED_FRAMES,
    Modem,
    ModemContext,
    ModemEvent,
    ModemStatus,
    ModemUrl,
    Reception,
)

LARGEST_FRAME_BYTES = 512


class LoopbackMedium:
    """The water that loopback modems share; hands deliveries to the modem of their receiver."""

    def __init__(self, water: Water, record: Callable[[Delivery], None] | None = None) -> None:
        self.water = water
        self._record = record
        self._modems: dict[int, LoopbackModem] = {}

    def modem(self, node: int) -> "LoopbackModem":
        """Return the modem of a node, the same one each time."""
        if node not in self.water.nodes:
            raise ConfigError(f"node {node} is not in the water; nodes are {self.water.nodes}")
        return self._modems.setdefault(node, LoopbackModem(self, node))

    def advance(self, now_s: float) -> None:
        """Deliver everything that has been heard by now, in order."""
        for delivery in self.water.deliveries_until(now_s):
            self.hand_over(delivery)

    def hand_over(self, delivery: Delivery) -> None:
        """Give one delivery to the modem of its receiver."""
        if self._record is not None:
            self._record(delivery)
        modem = self._modems.get(delivery.destination)
        if modem is not None and delivery.was_received:
            modem.hear(delivery)


class LoopbackModem:
    """One node's modem: starts a frame when asked, or when its last one has ended."""

    lead_s = 0.0
    frames_per_packet = 1

    def __init__(self, medium: LoopbackMedium, node: int) -> None:
        self._medium = medium
        self._node = node
        self._queue: deque[bytes] = deque()
        self._events: deque[ModemEvent] = deque()
        self._sent = self._received = self._dropped_out = self._dropped_in = 0

    @property
    def largest_frame_bytes(self) -> int:
        """The longest frame that the modem carries whole."""
        return LARGEST_FRAME_BYTES

    def send(self, frame: bytes, now_s: float, start_s: float | None = None) -> None:  # noqa: ARG002
        """Transmit now, or after the frame that is on the air."""
        if len(self._queue) == QUEUED_FRAMES:
            self._queue.popleft()
            self._dropped_out += 1
        self._queue.append(frame)
        self._transmit(now_s)

    def poll(self, now_s: float) -> None:
        """Let the medium deliver what has been heard by now, and start the next frame."""
        self._medium.advance(now_s)
        self._transmit(now_s)

    def next_event(self) -> ModemEvent | None:
        """Return the oldest event not yet fetched, or None."""
        return self._events.popleft() if self._events else None

    def status(self) -> ModemStatus:
        """Return the counters."""
        return ModemStatus(
            is_up=True,
            queued=len(self._queue),
            sent=self._sent,
            received=self._received,
            dropped_out=self._dropped_out,
            dropped_in=self._dropped_in,
        )

    def close(self) -> None:
        """Drop what is queued."""
        self._queue.clear()

    def hear(self, delivery: Delivery) -> None:
        """Take a frame from the medium."""
        if len(self._events) == QUEUED_EVENTS:
            self._events.popleft()
            self._dropped_in += 1
        self._received += 1
        self._events.append(
            Reception(frame=delivery.frame, toa_s=delivery.t_rx_s, heard_s=delivery.t_delivered_s)
        )

    def _transmit(self, now_s: float) -> None:
        if self._queue and now_s >= self._medium.water.transmitting_until_s(self._node):
            self._medium.water.transmit(self._node, now_s, self._queue.popleft())
            self._sent += 1


def open_loopback(url: ModemUrl, context: ModemContext) -> Modem:
    """Return the modem of loopback://?node=1 in the context's medium."""
    options = url.options({"node": 0})
    if context.medium is None:
        raise ConfigError(f"{url.text} works inside one process only; two processes need serial://")
    return context.medium.modem(options["node"])
