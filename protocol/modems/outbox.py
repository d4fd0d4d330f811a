"""Frames that wait for the water: a bounded queue, and those on their way but not yet confirmed."""

from collections import deque
from dataclasses import dataclass, replace
from itertools import islice

from protocol.modems.events import FrameDropped

MOST_ATTEMPTS = 8
"""A frame that a living modem failed to send this often is itself the fault."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Outgoing:
    """A frame, the earliest time it may start, and how often it was begun in vain."""

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

    def put(self, frame: bytes, now_s: float) -> None:
        """Queue a frame behind the others."""
        self.counters["queued"] += 1
        if len(self._waiting) + len(self.lent) >= self._capacity and self._waiting:
            self._drop(self._waiting.popleft(), f"queue of {self._capacity} frames full")
        self._waiting.append(Outgoing(frame=frame, ready_s=now_s))

    def first(self) -> Outgoing | None:
        """Return the frame that goes next, without lending it."""
        return self._waiting[0] if self._waiting else None

    def sizes(self, count: int) -> list[int]:
        """Return the sizes of the first `count` waiting frames."""
        return [len(item.frame) for item in islice(self._waiting, count)]

    def __len__(self) -> int:
        return len(self._waiting) + len(self.lent)

    def lend(self, count: int, longest_bytes: int) -> tuple[Outgoing, ...]:
        """Lend up to `count` leading frames of at most that size; they count as on their way."""
        batch: list[Outgoing] = []
        while self._waiting and len(batch) < count:
            if len(self._waiting[0].frame) > longest_bytes:
                break
            batch.append(self._waiting.popleft())
        self.lent = tuple(batch)
        return self.lent

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

    def _drop(self, item: Outgoing, reason: str) -> None:
        self.counters["dropped"] += 1
        self.dropped.append(FrameDropped(frame=item.frame, reason=reason))
