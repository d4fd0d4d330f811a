"""What strangers say: frames that look right, and must not be believed."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from host_tools.faults.catalogue import Fault
from protocol.codec import decode, encode
from protocol.crc import with_crc
from protocol.errors import RemoteProtocolError
from protocol.packets import ExtendedAnswer, Header, Packet, Profile, SealedFrame, SubmapPacket
from protocol.seal import Keys, Sealer
from protocol.timestamps import to_quarters, to_tx_second

_CRC_BYTES = 4
_VERSION_BITS = 0xE0


class _Count:
    """Counters of another fleet: as high as can be."""

    def __init__(self) -> None:
        self._next = 1 << 31

    def next(self) -> int:
        """Return the next number."""
        self._next += 1
        return self._next


class Strangers:
    """Another fleet with numbers like ours, and a recorder with a loudspeaker."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._sealer = Sealer(Keys(b"the key of quite another fleet.."), _Count())

    def frame(
        self, fault: Fault, vehicle: int, now_s: float, to: Sequence[bytes], by: Sequence[bytes]
    ) -> bytes | None:
        """Return a frame to sound at a vehicle, None while nothing was recorded.

        to and by are recorded frames to the vehicle and by it.
        """
        match fault:
            case Fault.STRANGER:
                return self._foreign(1 - vehicle, vehicle, now_s)
            case Fault.SAME_NUMBER:
                return self._foreign(vehicle, 1 - vehicle, now_s)
            case Fault.REFLECTED:
                return self._one_of(by)
            case Fault.REPLAYED:
                return self._one_of(to)
            case Fault.OTHER_VERSION:
                return self._other_version(to)
            case _:
                return self._forged(to)

    def _one_of(self, frames: Sequence[bytes]) -> bytes | None:
        return frames[int(self._rng.integers(len(frames)))] if frames else None

    def _other_version(self, frames: Sequence[bytes]) -> bytes | None:
        frame = self._one_of(frames)
        if not frame:
            return None
        other = (frame[0] + 0x20 * int(self._rng.choice([-1, 1]))) & _VERSION_BITS
        return with_crc(bytes([other | frame[0] & ~_VERSION_BITS & 0xFF]) + frame[1:-_CRC_BYTES])

    def _forged(self, frames: Sequence[bytes]) -> bytes | None:
        """Return a recorded frame with other content and a new counter, its CRC made right."""
        frame = self._one_of(frames)
        try:
            packet = None if frame is None else decode(frame)
        except RemoteProtocolError:
            return None
        if not isinstance(packet, SealedFrame):
            return None
        body = bytearray(packet.body)
        body[int(self._rng.integers(len(body)))] ^= int(self._rng.integers(1, 256))
        header = replace(packet.header, submap=int(self._rng.integers(1 << 16)))
        counter = packet.counter + int(self._rng.integers(1000))
        return encode(replace(packet, header=header, body=bytes(body), counter=counter))

    def _foreign(self, sender: int, receiver: int, now_s: float) -> bytes:
        """Return a frame of another fleet, in the clear or under its own key."""
        packet = _answer(receiver, now_s) if sender == 0 else _fragment(sender, now_s, self._rng)
        if self._rng.random() < 0.5:
            return encode(packet)
        if isinstance(packet, SubmapPacket):
            packet = replace(packet, points_ned_m=packet.points_ned_m[:14])
        return self._sealer.seal(packet)


def _header(profile: Profile, vehicle: int, now_s: float, fragment: int, count: int) -> Header:
    return Header(
        profile=profile,
        vehicle=vehicle,
        boot_epoch=0,
        submap=int(now_s) % (1 << 16),
        fragment=fragment,
        fragment_count=count,
        tx_second=to_tx_second(now_s),
        time_quarters=to_quarters(now_s),
    )


def _answer(receiver: int, now_s: float) -> Packet:
    return ExtendedAnswer(
        header=_header(Profile.ANSWER_EXTENDED, 0, now_s, receiver, 0),
        submap=0,
        north_m=9000.0,
        east_m=-9000.0,
        variance_m2=1e-6,
        leader_north_m=0.0,
        leader_east_m=0.0,
        leader_variance_m2=1e-6,
        repeat_submap=0,
        missing_fragments=0xFFFF,
    )


def _fragment(vehicle: int, now_s: float, rng: np.random.Generator) -> SubmapPacket:
    return SubmapPacket(
        header=_header(Profile.SUBMAP_PAPER, vehicle, now_s, 0, 10),
        trajectory=rng.standard_normal((4, 3)).astype(np.float32),
        points_ned_m=rng.standard_normal((15, 3)).astype(np.float32),
        hyperparameters=np.ones(4, dtype=np.float32),
    )
