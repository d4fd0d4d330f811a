"""What a modem dialect reports, whatever the dialect: frozen values on one queue."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameHeard:
    """A frame from the water, as its bytes arrived.

    toa_s is the arrival of the first bit on the shared clock, only when the modem vouches for it;
    heard_s is when the last of it came over the line, which is good for nothing finer than slots.
    """

    frame: bytes
    source: int | None
    toa_s: float | None
    heard_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameSent:
    """A frame has left: exactly the bytes that went on the air, and the second they started."""

    frame: bytes
    start_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameAcknowledged:
    """The peer's modem confirmed a frame: exactly the bytes that went on the air."""

    frame: bytes
    peer: int


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameDropped:
    """A frame that the driver gave up, and why."""

    frame: bytes
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeMeasured:
    """One-way travel time to a peer, from a two-way exchange that the modem made."""

    peer: int
    owtt_s: float
    at_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class PeerSilent:
    """A peer did not answer a ping, an acknowledged frame or a status query."""

    peer: int
    at_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class MiniHeard:
    """A mini-packet: 13 bits from a peer."""

    source: int
    value: int


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkQuality:
    """How well the last packet was heard; a figure that the modem does not tell is None.

    good_frames of frames passed the modem's own check; corrected_bytes is what a modem with a
    Reed-Solomon code repaired; quality_share is 1 for the best the modem can report.
    """

    source: int | None
    frames: int
    good_frames: int
    quality_share: float | None = None
    snr_in_db: float | None = None
    snr_out_db: float | None = None
    doppler_mps: float | None = None
    corrected_bytes: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SupplyVoltage:
    """The supply of a modem, own or a peer's."""

    address: int
    volts: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ModemRestarted:
    """The modem was power-cycled, reset or swapped: what was in flight is queued again."""

    at_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ModemComplaint:
    """The modem refused or failed something; the text is one line for the log."""

    text: str
    at_s: float


DialectEvent = (
    FrameHeard
    | FrameSent
    | FrameAcknowledged
    | FrameDropped
    | RangeMeasured
    | PeerSilent
    | MiniHeard
    | LinkQuality
    | SupplyVoltage
    | ModemRestarted
    | ModemComplaint
)
