"""Frames that wait for the water: a bounded queue, and those on their way but not yet confirmed."""

from collections import deque
from dataclasses import dataclass, replace
from itertools import islice, takewhile

from protocol.modems.events import FrameDropped
from protocol.modems.stamping import Stamp

MOST_ATTEMPTS = 8
"""A frame that a living modem failed to send this often is itself the fault."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Outgoing:
    """A frame, the earliest second it may start on, and how often it was begun in vain."""

    frame: bytes
    ready_s: float
    attempts: int = 0


class Outbox:
    """Takes frames, lends a batch, and gets it confirmed or back; nothing lent is ever lost.

    When it is full the oldest waiting frame goes, since a sub-map's next repeat is worth more.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._waiting: deque[Outgoing] = deque()
        self.lent: tuple[Outgoing, ...] = ()
        self.dropped: deque[FrameDropped] = deque(maxlen=capacity)
        self.counters = {"queued": 0, "confirmed": 0, "requeued": 0, "dropped": 0}

    def put(self, frame: bytes, ready_s: float) -> None:
        """Queue a frame behind the others; it starts at ready_s at the earliest."""
        self.counters["queued"] += 1
        if len(self._waiting) + len(self.lent) >= self._capacity and self._waiting:
            self._drop(self._waiting.popleft(), f"queue of {self._capacity} frames full")
        self._waiting.append(Outgoing(frame=frame, ready_s=ready_s))

    def first(self) -> Outgoing | None:
        """Return the frame that goes next, without lending it."""
        return self._waiting[0] if self._waiting else None

    def sizes(self, count: int) -> list[int]:
        """Return the sizes of up to `count` waiting frames that may start with the first one."""
        return [len(item.frame) for item in self._together(count)]

    def __len__(self) -> int:
        return len(self._waiting) + len(self.lent)

    def lend(self, count: int, longest_bytes: int) -> tuple[Outgoing, ...]:
        """Lend up to `count` leading frames of at most that size; they count as on their way."""
        self.lent = tuple(
            takewhile(lambda item: len(item.frame) <= longest_bytes, self._together(count))
        )
        for _ in self.lent:
            self._waiting.popleft()
        return self.lent

    def stamped(self, stamp: Stamp, start_s: float) -> list[bytes]:
        """Return the lent frames as they go on the air; one that must not is dropped."""
        frames = [(item, stamp(item.frame, start_s)) for item in self.lent]
        self.lent = tuple(item for item, frame in frames if frame is not None)
        for item, frame in frames:
            if frame is None:
                self._drop(item, "it cannot be sealed")
        return [frame for _, frame in frames if frame is not None]

    def confirm(self) -> tuple[Outgoing, ...]:
        """Return the lent frames, which have left for good."""
        sent, self.lent = self.lent, ()
        self.counters["confirmed"] += len(sent)
        return sent

    def give_back(self, *, blame: bool) -> None:
        """Put the lent frames back in front; with `blame` they come nearer to being dropped."""
        back, self.lent = self.lent, ()
        self.counters["requeued"] += len(back)
        for item in reversed(back):
            tried = replace(item, attempts=item.attempts + blame)
            if tried.attempts >= MOST_ATTEMPTS:
                self._drop(tried, f"refused {tried.attempts} times by the modem")
            else:
                self._waiting.appendleft(tried)

    def recall(self, now_s: float) -> None:
        """Put the lent frames back in front; all that wait may start now."""
        self.give_back(blame=False)
        self._waiting = deque(replace(i, ready_s=min(i.ready_s, now_s)) for i in self._waiting)

    def _together(self, count: int) -> list[Outgoing]:
        """Return leading frames that one packet may take: none has to wait for a later second."""
        latest_s = self._waiting[0].ready_s + 0.5 if self._waiting else 0.0
        leading = islice(self._waiting, count)
        return list(takewhile(lambda item: item.ready_s <= latest_s, leading))

    def _drop(self, item: Outgoing, reason: str) -> None:
        self.counters["dropped"] += 1
        self.dropped.append(FrameDropped(frame=item.frame, reason=reason))
