"""What every modem driver looks like to the loop that uses it.

To add a dialect, write one module in this folder with a function

    def open_mine(url: ModemUrl, context: ModemContext) -> Modem: ...

and add one line to DIALECTS in `protocol.modems.registry`. Read the URL's options by
`url.options({...})`, which names the unknown ones; open the port there and then, and raise
ModemUnavailable with what to do when it is not there. After that nothing raises: a driver is a
thin shell that moves bytes between the port and a core without I/O, calls `context.tap` with every
byte it reads or writes, queues at most QUEUED_FRAMES frames each way, drops the oldest beyond that
and counts it. It passes the conformance suite in `hil/`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol
from urllib.parse import parse_qsl, urlsplit

from protocol.errors import ConfigError
from protocol.modems.stamping import Stamp, stamp_frame

if TYPE_CHECKING:
    from protocol.modems.loopback import LoopbackMedium

QUEUED_FRAMES = 32
"""Cap of frames waiting for the air: two minutes of a full link, three sub-maps and answers."""
QUEUED_EVENTS = 256
"""Cap of events that nobody has fetched."""

Tap = Callable[[str, bytes, float], None]
"""Called with "in" or "out", the raw bytes and now_s, for logs that can be replayed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reception:
    """A frame from the water.

    toa_s is the arrival of its first bit on the shared clock, None when the modem cannot vouch for
    it: then it gives no range. heard_s is when the frame came over the line, good for slots only.
    source is the sender's modem address where the dialect tells it.
    """

    frame: bytes
    toa_s: float | None
    heard_s: float
    source: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkNotice:
    """One line for the log about the link: port gone or back, modem restarted, command refused."""

    text: str
    at_s: float


ModemEvent = Reception | LinkNotice


@dataclass(frozen=True, slots=True, kw_only=True)
class ModemStatus:
    """Counters since the driver was opened, for the status line.

    dropped_out counts frames that left the send queue unsent, dropped_in events that nobody
    fetched, discarded what came over the line and was no frame. quality is from 0 to 1, None when
    the dialect has no figure for it. `errors` holds counters of the dialect by name.
    """

    is_up: bool
    queued: int = 0
    sent: int = 0
    received: int = 0
    dropped_out: int = 0
    dropped_in: int = 0
    discarded: int = 0
    reopened: int = 0
    quality: float | None = None
    errors: Mapping[str, int] = field(default_factory=dict)


class Modem(Protocol):
    """A non-blocking modem driver."""

    @property
    def largest_frame_bytes(self) -> int:
        """The longest frame that the modem carries whole."""

    @property
    def lead_s(self) -> float:
        """How long before its second of transmission a frame must be handed over; 0: then."""

    @property
    def frames_per_packet(self) -> int:
        """How many frames that are handed over together start together."""

    def send(self, frame: bytes, now_s: float, start_s: float | None = None) -> None:
        """Queue a frame for the second start_s; without one it starts as soon as can be."""

    def poll(self, now_s: float) -> None:
        """Move bytes and time; never blocks, never raises."""

    def next_event(self) -> ModemEvent | None:
        """Return the oldest event not yet fetched, or None."""

    def status(self) -> ModemStatus:
        """Return the counters."""

    def close(self) -> None:
        """Give the port back."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModemContext:
    """What a driver may need beyond its URL."""

    tap: Tap | None = None
    stamp: Stamp = stamp_frame
    medium: "LoopbackMedium | None" = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ModemUrl:
    """A parsed modem URL: scheme://path?key=value&..."""

    text: str
    scheme: str
    path: str
    query: Mapping[str, str]

    @classmethod
    def parse(cls, text: str) -> "ModemUrl":
        """Return the parts of a URL such as serial:///dev/ttyUSB0?baud=19200."""
        wrong = ConfigError(
            f"modem {text!r} is no URL; write e.g. serial:///dev/ttyUSB0?baud=19200"
        )
        try:
            parts = urlsplit(text)
        except ValueError as error:
            raise wrong from error
        if "://" not in text:
            raise wrong
        query = dict(parse_qsl(parts.query, keep_blank_values=True))
        return cls(text=text, scheme=parts.scheme, path=parts.netloc + parts.path, query=query)

    def options(self, defaults: Mapping[str, int]) -> dict[str, int]:
        """Return the whole-number options, defaults filled in.

        Raises
        ------
        ConfigError
            For an unknown key or a value that is no whole number.
        """
        unknown = sorted(set(self.query) - set(defaults))
        if unknown:
            known = ", ".join(defaults) or "none"
            raise ConfigError(f"{self.text}: unknown option {unknown[0]!r}; known are {known}")
        values = dict(defaults)
        for key, text in self.query.items():
            try:
                values[key] = int(text)
            except ValueError:
                message = f"{self.text}: {key} is {text!r}; give a whole number"
                raise ConfigError(message) from None
        return values
