"""Sealed frames: anyone can transmit into the sea, so a tag says who did, and a counter when.

A sealed frame carries 8 bytes of a keyed tag over receiver, header, body and a counter that never
repeats. The receiver verifies first, then looks at a window of 64 counters per sender. Every
direction has a key of its own, so that a reflected frame verifies nowhere. What this does not stop:
jamming, a frame recorded, kept from arriving and played once later (its range is then wrong), and,
without the AES suite, listening.
"""

import hashlib
import hmac
from dataclasses import dataclass, replace
from typing import Protocol

from protocol.codec import decode_body, encode, encode_body, encode_header
from protocol.errors import LocalProtocolError, RemoteProtocolError
from protocol.packets import Header, Packet, Profile, SealedFrame
from protocol.vehicles import LEADER

TAG_BYTES = 8
"""One forgery in 30 days at a frame a second has a chance of 1e-13."""
KEY_BYTES = 32
WINDOW = 64
"""Counters behind the newest that are still told apart, far more than the water can reorder."""
LARGEST_COUNTER = 2**32 - 1
_ANSWERS = (Profile.ANSWER, Profile.ANSWER_EXTENDED)


class Suite(Protocol):
    """How a body is protected."""

    def protect(self, key: bytes, bound: bytes, body: bytes, counter: int) -> tuple[bytes, bytes]:
        """Return the body as sent, and the tag; `bound` is verified but not sent again."""

    def verify(
        self, key: bytes, bound: bytes, body: bytes, counter: int, tag: bytes
    ) -> bytes | None:
        """Return the body as it was before `protect`, None when the tag is wrong."""


class Blake2sSuite:
    """Authenticates with keyed BLAKE2s from the standard library; bodies stay readable."""

    def protect(self, key: bytes, bound: bytes, body: bytes, counter: int) -> tuple[bytes, bytes]:
        """Return the body unchanged, and its tag."""
        data = bound + body + counter.to_bytes(4, "big")
        return body, hashlib.blake2s(data, key=key, digest_size=TAG_BYTES).digest()

    def verify(
        self, key: bytes, bound: bytes, body: bytes, counter: int, tag: bytes
    ) -> bytes | None:
        """Return the body when the tag is right, compared in constant time."""
        _, expected = self.protect(key, bound, body, counter)
        return body if hmac.compare_digest(expected, tag) else None


@dataclass(frozen=True, slots=True)
class Keys:
    """The master secret, and a key derived from it for every direction."""

    master: bytes

    def __post_init__(self) -> None:
        if len(self.master) != KEY_BYTES:
            raise LocalProtocolError(f"a key has {KEY_BYTES} bytes, not {len(self.master)}")

    def direction(self, sender: int, receiver: int) -> bytes:
        """Return the key of frames from one vehicle to another."""
        data = b"fathomlink direction" + bytes([sender, receiver])
        return hashlib.blake2s(data, key=self.master, digest_size=KEY_BYTES).digest()


class FrameCounter(Protocol):
    """Gives every frame a number that no other frame had, whatever crashes; see seal_state."""

    def next(self) -> int:
        """Return the next number."""


class Marks(Protocol):
    """Keeps the highest counter accepted from each sender across restarts of the receiver."""

    failed_writes: int

    def load(self) -> dict[int, int]:
        """Return the marks by sender."""

    def save(self, marks: dict[int, int]) -> None:
        """Keep the marks."""


def receiver_of(header: Header) -> int:
    """Return whom a frame is for: answers name their follower, all else goes to the leader."""
    return header.fragment if header.profile.plain in _ANSWERS else LEADER


class Sealer:
    """Packets of one vehicle in, sealed frames out."""

    def __init__(self, keys: Keys, counter: FrameCounter, suite: Suite | None = None) -> None:
        self._keys, self._counter = keys, counter
        self._suite = suite or Blake2sSuite()

    def seal(self, packet: Packet) -> bytes:
        """Return the sealed frame of a packet in its plain profile.

        It has to leave the seal's place: 14 points in a paper packet, 19 (small: 3) states in a
        trajectory, a body of 232 (small: 38) bytes in an opaque fragment.
        """
        if isinstance(packet, SealedFrame):
            raise LocalProtocolError("this frame is sealed already")
        header = replace(packet.header, profile=packet.header.profile.sealed)
        body = encode_body(replace(packet, header=header))
        receiver = receiver_of(header)
        key = self._keys.direction(header.vehicle, receiver)
        counter = self._counter.next()
        body, tag = self._suite.protect(key, _bound(header, receiver), body, counter)
        return encode(SealedFrame(header=header, body=body, counter=counter, tag=tag))


class Opener:
    """Decoded packets in, verified packets out; for one vehicle, with a window per sender."""

    def __init__(
        self, own: int, keys: Keys, marks: Marks | None = None, suite: Suite | None = None
    ) -> None:
        self._own, self._keys, self._marks = own, keys, marks
        self._suite = suite or Blake2sSuite()
        loaded = marks.load() if marks is not None else {}
        self._windows = {sender: ReplayWindow(mark) for sender, mark in loaded.items()}

    @property
    def marks_unwritten(self) -> int:
        """How often the marks could not be kept, so that a restart would take frames again."""
        return 0 if self._marks is None else self._marks.failed_writes

    def open(self, packet: Packet) -> Packet:
        """Return the packet inside a sealed frame, in its plain profile.

        Raises
        ------
        RemoteProtocolError
            For everything else; its `cause` is plain (not sealed), reflected (our own), elsewhere
            (for another vehicle), tag (forged, altered or of another key), replay, stale (behind
            the window) or layout.
        """
        header = packet.header
        sender = header.vehicle
        if not isinstance(packet, SealedFrame):
            message = f"{header.profile.name} from vehicle {sender} is not sealed"
            raise RemoteProtocolError(message, cause="plain")
        if sender == self._own:
            message = f"a frame that says it is from us, vehicle {sender}: reflected, or two"
            raise RemoteProtocolError(f"{message} vehicles with one number", cause="reflected")
        receiver = receiver_of(header)
        if receiver != self._own:
            raise RemoteProtocolError(f"a frame for vehicle {receiver}", cause="elsewhere")
        key = self._keys.direction(sender, receiver)
        body = self._suite.verify(
            key, _bound(header, receiver), packet.body, packet.counter, packet.tag
        )
        if body is None:
            message = f"{header.profile.name} from vehicle {sender}: wrong tag; forged, or not our"
            raise RemoteProtocolError(f"{message} key", cause="tag")
        window = self._windows.setdefault(sender, ReplayWindow())
        window.accept(packet.counter)
        if self._marks is not None:
            self._marks.save({number: w.highest for number, w in self._windows.items()})
        opened = decode_body(header, body)
        return replace(opened, header=replace(header, profile=header.profile.plain))


class ReplayWindow:
    """Which of the newest 64 counters of one sender were seen.

    After a restart of the receiver everything up to the mark counts as seen.
    """

    def __init__(self, mark: int = -1) -> None:
        self.highest = mark
        self._seen = (1 << WINDOW) - 1  # bit i stands for highest - i

    def accept(self, counter: int) -> None:
        """Take a counter whose tag was verified.

        Raises
        ------
        RemoteProtocolError
            When it was seen before (replay), or is too old to know (stale).
        """
        behind = self.highest - counter
        if behind >= WINDOW:
            message = f"counter {counter} is {behind} behind the newest"
            raise RemoteProtocolError(message, cause="stale")
        if behind >= 0:
            if self._seen >> behind & 1:
                raise RemoteProtocolError(f"counter {counter} again", cause="replay")
            self._seen |= 1 << behind
            return
        self._seen = (self._seen << min(-behind, WINDOW) | 1) & ((1 << WINDOW) - 1)
        self.highest = counter


def _bound(header: Header, receiver: int) -> bytes:
    """Return what the tag covers beside body and counter: version and sender are in the header."""
    return bytes([receiver]) + encode_header(header)
