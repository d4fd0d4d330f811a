"""Frames on a raw serial line: COBS with a zero byte on both sides.

The leading delimiter ends whatever noise or half frame went before, so a reader is in step again
within one frame. Modem dialects frame themselves and do not come through here.
"""

from collections import deque
from dataclasses import dataclass

from cobs import cobs

DELIMITER = b"\x00"
GUARD_BYTES = 512
"""Longest run without a delimiter that can be a frame: twice the largest, so noise ends soon."""
QUEUED_FRAMES = 64
"""Cap of frames that nobody has fetched: two minutes of a full link at the paper's rate."""


def wrap(frame: bytes) -> bytes:
    """Return the frame as it goes on the line: 0x00, COBS, 0x00; 259 bytes for 256."""
    return DELIMITER + bytes(cobs.encode(frame)) + DELIMITER


@dataclass(frozen=True, slots=True, kw_only=True)
class LineFrame:
    """A frame from the line, and when its first byte was read."""

    frame: bytes
    first_byte_s: float


class LineReader:
    """Any bytes in, frames out; whatever is not a frame is counted and dropped, never raised.

    Counters: `frames`, `bad_frames` (not COBS), `overlong` (no delimiter within the guard) and
    `overflowed` (dropped because nobody fetched them).
    """

    def __init__(self) -> None:
        self.frames = 0
        self.bad_frames = 0
        self.overlong = 0
        self.overflowed = 0
        self._partial = bytearray()
        self._first_byte_s = 0.0
        self._skipping = False
        self._ready: deque[LineFrame] = deque()

    def receive_data(self, data: bytes, now_s: float = 0.0) -> None:
        """Take bytes in any chunking; now_s stamps the frames that begin in them."""
        *ended, rest = data.split(DELIMITER)
        for piece in ended:
            self._extend(piece, now_s)
            self._end()
        self._extend(rest, now_s)

    def next_frame(self) -> LineFrame | None:
        """Return the oldest frame not yet fetched, or None."""
        return self._ready.popleft() if self._ready else None

    def reset(self) -> None:
        """Forget a half frame, after the line was interrupted."""
        self._partial.clear()
        self._skipping = False

    def _extend(self, piece: bytes, now_s: float) -> None:
        if not piece or self._skipping:
            return
        if not self._partial:
            self._first_byte_s = now_s
        if len(self._partial) + len(piece) > GUARD_BYTES:
            self.overlong += 1
            self._skipping = True
            self._partial.clear()
        else:
            self._partial += piece

    def _end(self) -> None:
        if self._partial:
            self._finish(bytes(self._partial))
        self.reset()

    def _finish(self, encoded: bytes) -> None:
        try:
            frame = bytes(cobs.decode(encoded))
        except cobs.DecodeError:
            self.bad_frames += 1
            return
        self.frames += 1
        if len(self._ready) == QUEUED_FRAMES:
            self._ready.popleft()
            self.overflowed += 1
        self._ready.append(LineFrame(frame=frame, first_byte_s=self._first_byte_s))
