"""A driver's last word on a frame: the second at which it will really start."""

from collections.abc import Callable

from protocol.codec import restamp
from protocol.errors import ProtocolError
from protocol.timestamps import to_tx_second

Stamp = Callable[[bytes, float], bytes | None]
"""(frame, start_s) to the frame that goes on the air, None for one that must not; a sealing sender
passes its own."""


def stamp_frame(frame: bytes, start_s: float) -> bytes:
    """Return the frame with the start's second in its header; anything else stays as it is."""
    try:
        return restamp(frame, to_tx_second(start_s))
    except ProtocolError:
        return frame
