"""What the channel and a vehicle's process say to each other beside the modem line: time.

One JSON object a line over a Unix domain socket. Floats survive JSON exactly, so a time of arrival
is the same number on both sides. Frames travel over the modem line; here they are named by their
CRC-32C only, so that noise on the line is told from what the water carried. Nothing here speaks of
where a vehicle truly is.
"""

import dataclasses
import json
import socket
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from protocol.errors import RemoteProtocolError

LONGEST_LINE_BYTES = 1 << 16
"""Cap of a message; the largest, an advance with 256 arrivals, has 25 kB."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Arrival:
    """A frame that is waiting on the modem line: its CRC, first bit's arrival, end of arrival."""

    crc: int
    toa_s: float | None
    heard_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Hello:
    """A vehicle's process is here; mission is the fingerprint of what it was started with."""

    vehicle: int
    mission: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Advance:
    """It is now_s: hear these arrivals, run one period, then say Done.

    in_real_time says whether the clock keeps pace with the wall's and waits for nobody.
    """

    now_s: float
    arrivals: tuple[Arrival, ...] = ()
    in_real_time: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Done:
    """The period is over: CRCs of the frames written to the line, and of arrivals not found.

    On the line of a modem that has a dialect it is the bytes written since the start that count.
    """

    now_s: float
    frames: tuple[int, ...] = ()
    missed: tuple[int, ...] = ()
    line_bytes: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class End:
    """The mission is over; a vehicle answers with its own End when its files are written."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Refused:
    """The channel has no use for this process, and says why."""

    reason: str


Message = Hello | Advance | Done | End | Refused
KINDS: Mapping[str, type[Message]] = {
    kind.__name__.lower(): kind for kind in (Hello, Advance, Done, End, Refused)
}


def to_line(message: Message) -> bytes:
    """Return a message as it goes over the socket."""
    body = {"is": type(message).__name__.lower(), **dataclasses.asdict(message)}
    return json.dumps(body, separators=(",", ":")).encode() + b"\n"


def from_line(line: bytes) -> Message:
    """Return the message of a line.

    Raises
    ------
    RemoteProtocolError
        For anything that is none.
    """
    try:
        body: dict[str, Any] = json.loads(line)
        kind = KINDS[body.pop("is")]
        if kind is Advance:
            body["arrivals"] = tuple(Arrival(**arrival) for arrival in body["arrivals"])
        if kind is Done:
            body["frames"], body["missed"] = tuple(body["frames"]), tuple(body["missed"])
        message = kind(**body)
        parts = [message, *(message.arrivals if isinstance(message, Advance) else ())]
        if not all(_fits(getattr(p, f.name), f.type) for p in parts for f in dataclasses.fields(p)):
            raise TypeError("a value of another type than its field")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise RemoteProtocolError(f"control line: {line[:60]!r} is no message") from error
    return message


def _fits(value: object, kind: Any) -> bool:  # noqa: ANN401
    """Return whether a value is of a field's type; a whole number is a float as well."""
    if isinstance(value, tuple):
        return all(_fits(part, typing.get_args(kind)[0]) for part in value)
    kinds = typing.get_args(kind) or (kind,)
    return type(value) in kinds or (type(value) is int and float in kinds)


class ControlLine:
    """One end of the socket: messages whole, in order."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection
        self._partial = bytearray()
        self.is_open = True

    def fileno(self) -> int:
        """Return the descriptor to wait on."""
        return self._socket.fileno()

    def send(self, message: Message) -> None:
        """Say a message; a line that has gone is only marked so."""
        try:
            self._socket.sendall(to_line(message))
        except OSError:
            self.is_open = False

    def receive(self) -> list[Message]:
        """Return the messages that have come, waiting for some bytes; empty and closed at the end.

        Raises
        ------
        RemoteProtocolError
            For bytes that are no message.
        """
        try:
            data = self._socket.recv(LONGEST_LINE_BYTES)
        except OSError:
            data = b""
        if not data:
            self.is_open = False
            return []
        self._partial += data
        *lines, rest = bytes(self._partial).split(b"\n")
        if len(rest) > LONGEST_LINE_BYTES:
            raise RemoteProtocolError("control line: a message without an end")
        self._partial = bytearray(rest)
        return [from_line(line) for line in lines]

    def close(self) -> None:
        """Give the socket back."""
        self.is_open = False
        self._socket.close()
