"""Sealed mode: a modem whose frames are sealed on their way out and verified on their way in.

What a seal takes from a frame (the fifteenth point, one state of twenty, twelve bytes of a coded
body) is left out before it, and stands unused, NaN or zero, in the frame that the receiving core
is given.
"""

from collections import Counter
from dataclasses import replace

import numpy as np

from protocol.codec import decode, encode
from protocol.errors import ProtocolError, RemoteProtocolError
from protocol.modems.base import Modem, ModemEvent, ModemStatus, Reception
from protocol.modems.stamping import stamp_frame
from protocol.packets import (
    POINTS_PER_FRAGMENT,
    POINTS_PER_SEALED_FRAGMENT,
    SEAL_BYTES,
    Array32,
    Packet,
    SubmapFragment,
    SubmapPacket,
    TrajectoryPacket,
)
from protocol.seal import Opener, Sealer
from protocol.timestamps import QUARTERS_MODULO

_QUARTERS_PER_STATE = 4
_UNUSED = bytes(SEAL_BYTES)


class SealedLink:
    """One vehicle's seal; `counters` says what was not sent and, by cause, what was rejected."""

    def __init__(self, sealer: Sealer, opener: Opener) -> None:
        self.counters: Counter[str] = Counter()
        self._sealer, self._opener = sealer, opener

    def seal(self, frame: bytes) -> bytes | None:
        """Return a core's frame sealed; None when no counter is to be had, or it has no room."""
        try:
            return self._sealer.seal(_with_room(decode(frame)))
        except ProtocolError:
            self.counters["not_sealed"] += 1
            return None

    def stamp(self, frame: bytes, start_s: float) -> bytes | None:
        """Return a core's frame as it is sealed by a driver that knows the second of its start."""
        return self.seal(stamp_frame(frame, start_s))

    def open(self, frame: bytes) -> bytes | None:
        """Return the plain frame in a sealed one, None for all else."""
        try:
            opened = self._opener.open(decode(frame))
        except RemoteProtocolError as error:
            self.counters[f"rejected_{error.cause}"] += 1
            return None
        self.counters["opened"] += 1
        return encode(_whole(opened))

    def status(self) -> dict[str, int]:
        """Return the counters, and how often the marks of what was opened could not be kept."""
        return {**self.counters, "marks_unwritten": self._opener.marks_unwritten}


class SealedModem:
    """A modem behind a seal; a driver with a lead stamps, and therefore seals, by itself."""

    def __init__(self, modem: Modem, link: SealedLink) -> None:
        self.link, self._modem = link, modem

    @property
    def largest_frame_bytes(self) -> int:
        """The longest frame that the modem carries whole."""
        return self._modem.largest_frame_bytes

    @property
    def lead_s(self) -> float:
        """How long before its second a frame must be handed over."""
        return self._modem.lead_s

    @property
    def frames_per_packet(self) -> int:
        """How many frames start together."""
        return self._modem.frames_per_packet

    def send(self, frame: bytes, now_s: float, start_s: float | None = None) -> None:
        """Seal and queue a frame; one that cannot be sealed stays here, counted."""
        if self.lead_s > 0.0:
            self._modem.send(frame, now_s, start_s)
            return
        sealed = self.link.seal(frame)
        if sealed is not None:
            self._modem.send(sealed, now_s, start_s)

    def poll(self, now_s: float) -> None:
        """Move bytes and time."""
        self._modem.poll(now_s)

    def next_event(self) -> ModemEvent | None:
        """Return the oldest event that is a notice or was verified, or None."""
        while (event := self._modem.next_event()) is not None:
            if not isinstance(event, Reception):
                return event
            opened = self.link.open(event.frame)
            if opened is not None:
                return replace(event, frame=opened)
        return None

    def status(self) -> ModemStatus:
        """Return the counters, the seal's among the dialect's."""
        status = self._modem.status()
        return replace(status, errors={**status.errors, **self.link.status()})

    def close(self) -> None:
        """Give the port back."""
        self._modem.close()


def _with_room(packet: Packet) -> Packet:
    """Return a packet that leaves the seal its place; the oldest state of a trajectory goes."""
    if isinstance(packet, SubmapPacket):
        return replace(packet, points_ned_m=packet.points_ned_m[:POINTS_PER_SEALED_FRAGMENT])
    if isinstance(packet, SubmapFragment) and packet.body.endswith(_UNUSED):
        return replace(packet, body=packet.body.removesuffix(_UNUSED))
    if isinstance(packet, TrajectoryPacket):
        later = (packet.header.time_quarters + _QUARTERS_PER_STATE) % QUARTERS_MODULO
        header = replace(packet.header, time_quarters=later)
        return replace(packet, header=header, states=packet.states[1:])
    return packet


def _whole(packet: Packet) -> Packet:
    """Return an opened packet in the size of a plain one, NaN where the seal was."""
    if isinstance(packet, SubmapPacket):
        return replace(packet, points_ned_m=_padded(packet.points_ned_m, POINTS_PER_FRAGMENT))
    if isinstance(packet, SubmapFragment):
        return replace(packet, body=packet.body + _UNUSED)
    if isinstance(packet, TrajectoryPacket):
        return replace(packet, states=_padded(packet.states, len(packet.states) + 1))
    return packet


def _padded(rows: Array32, count: int) -> Array32:
    missing = np.full((count - len(rows), rows.shape[1]), np.nan, dtype=np.float32)
    return np.concatenate([rows, missing])
