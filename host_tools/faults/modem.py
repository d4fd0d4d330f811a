"""A modem that restarts, is busy, and has noise on its line; and the vehicle's clock beside it."""

from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from host_tools.faults.catalogue import Fault, Plan
from protocol.framing import LineReader, wrap
from protocol.modems.base import QUEUED_EVENTS, QUEUED_FRAMES, LinkNotice, ModemEvent, ModemStatus
from protocol.modems.base import Reception as Heard
from protocol.modems.loopback import LoopbackModem

LocalTime = Callable[[float], float]
"""A vehicle's clock at a true time."""


class FaultyModem:
    """A loopback modem behind a framed line, as a vehicle's loop has it.

    The vehicle's loop lives in its own time; the modem and the water in the true one, which
    `true_s` holds: whoever steps the vehicle sets it.
    """

    lead_s = 0.0
    frames_per_packet = 1

    def __init__(
        self,
        vehicle: int,
        modem: LoopbackModem,
        plan: Plan,
        rng: np.random.Generator,
        local: LocalTime,
    ) -> None:
        self.true_s = 0.0
        self.sent: list[bytes] = []
        self._vehicle, self._modem, self._plan, self._rng = vehicle, modem, plan, rng
        self._local = local
        self._kinds = plan.kinds(vehicle)
        self._reader = LineReader()
        self._events: deque[ModemEvent] = deque(maxlen=QUEUED_EVENTS)
        self._kept_back: deque[bytes] = deque(maxlen=QUEUED_FRAMES)
        self._was_up = True

    @property
    def largest_frame_bytes(self) -> int:
        """The longest frame that the modem carries whole."""
        return self._modem.largest_frame_bytes

    def send(self, frame: bytes, now_s: float, start_s: float | None = None) -> None:  # noqa: ARG002
        """Transmit, or keep the frame back while busy."""
        if not self._is_up():
            return
        if self._is(Fault.MODEM_BUSY):
            self._plan.fired[Fault.MODEM_BUSY] += 1
            self._kept_back.append(frame)
            return
        self.sent.append(frame)
        self._modem.send(frame, self.true_s)

    def poll(self, now_s: float) -> None:
        """Move what was heard over the line."""
        self._modem.poll(self.true_s)
        is_up = self._is_up()
        if self._was_up and not is_up:
            self._plan.fired[Fault.MODEM_RESET] += 1
            self._modem.close()
            self._kept_back.clear()
            self._reader.reset()
        elif is_up and not self._was_up:
            self._events.append(LinkNotice(text="the modem restarted", at_s=now_s))
        self._was_up = is_up
        while self._kept_back and not self._is(Fault.MODEM_BUSY):
            self.send(self._kept_back.popleft(), now_s)
        while (event := self._modem.next_event()) is not None:
            if is_up and isinstance(event, Heard):
                self._cross(event)

    def next_event(self) -> ModemEvent | None:
        """Return the oldest event not yet fetched, or None."""
        return self._events.popleft() if self._events else None

    def status(self) -> ModemStatus:
        """Return the counters."""
        return replace(self._modem.status(), is_up=self._is_up(), discarded=self._reader.bad_frames)

    def close(self) -> None:
        """Drop what is queued."""
        self._modem.close()

    def lose_all(self) -> None:
        """Lose what was said to a computer that was down."""
        self.poll(self._local(self.true_s))
        self._events.clear()

    def _is_up(self) -> bool:
        return not self._is(Fault.MODEM_RESET)

    def _is(self, fault: Fault) -> bool:
        kinds, now_s = self._kinds, self.true_s
        return fault in kinds and self._plan.active(fault, self._vehicle, now_s) is not None

    def _cross(self, heard: Heard) -> None:
        """Let a frame cross the line between modem and computer, with whatever noise is on it."""
        data = wrap(heard.frame)
        if self._is(Fault.LINE_NOISE):
            self._plan.fired[Fault.LINE_NOISE] += 1
            data = self._noise() + data
            if self._rng.random() < 0.3:
                data = data[: int(self._rng.integers(1, len(data)))]
            data += self._noise()
        self._reader.receive_data(data, heard.heard_s)
        while (frame := self._reader.next_frame()) is not None:
            self._events.append(self._timed(frame.frame, heard))

    def _noise(self) -> bytes:
        return self._rng.bytes(int(self._rng.integers(0, 700)))

    def _timed(self, frame: bytes, heard: Heard) -> Heard:
        """Return a frame off the line in the vehicle's time; noise gets no time of arrival."""
        known = frame == heard.frame and heard.toa_s is not None
        toa_s = self._local(heard.toa_s) if known and heard.toa_s is not None else None
        return Heard(frame=frame, toa_s=toa_s, heard_s=self._local(heard.heard_s))
