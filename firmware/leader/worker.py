"""Who runs a sub-map's matches: the loop itself, or one thread beside it."""

import queue
import threading
from dataclasses import dataclass
from typing import Protocol

from firmware.leader.match_jobs import Findings, SheetJobs


@dataclass(frozen=True, slots=True, kw_only=True)
class Finished:
    """A batch of matches and what came of them."""

    batch: SheetJobs
    findings: Findings


class Worker(Protocol):
    """Takes one batch at a time."""

    @property
    def is_free(self) -> bool:
        """Whether a batch may be given."""

    def give(self, batch: SheetJobs) -> None:
        """Start a batch; only while the worker is free."""

    def take(self) -> Finished | None:
        """Return the batch that has been finished, once, or None."""

    def close(self) -> None:
        """Let the batch at work end, and take no more."""


class InlineWorker:
    """Runs a batch at once: in virtual time work takes none, so that a mission is deterministic."""

    def __init__(self) -> None:
        self._finished: Finished | None = None

    @property
    def is_free(self) -> bool:
        """Whether the last batch was taken."""
        return self._finished is None

    def give(self, batch: SheetJobs) -> None:
        """Run a batch."""
        self._finished = Finished(batch=batch, findings=batch.run())

    def take(self) -> Finished | None:
        """Return the finished batch, once."""
        finished, self._finished = self._finished, None
        return finished

    def close(self) -> None:
        """Nothing is at work."""


class ThreadWorker:
    """One thread beside the loop, one batch at a time: what it costs in memory is one batch."""

    def __init__(self) -> None:
        self._in: queue.Queue[SheetJobs | None] = queue.Queue(maxsize=1)
        self._out: queue.Queue[Finished] = queue.Queue(maxsize=1)
        self._busy = False
        self._thread = threading.Thread(target=self._work, name="matches", daemon=True)
        self._thread.start()

    @property
    def is_free(self) -> bool:
        """Whether no batch is at work or waits to be taken."""
        return not self._busy

    def give(self, batch: SheetJobs) -> None:
        """Hand a batch to the thread."""
        self._busy = True
        self._in.put_nowait(batch)

    def take(self) -> Finished | None:
        """Return the finished batch, once, or None while it is at work."""
        try:
            finished = self._out.get_nowait()
        except queue.Empty:
            return None
        self._busy = False
        return finished

    def close(self) -> None:
        """Stop the thread after the batch at work."""
        self._in.put(None)
        self._thread.join()

    def _work(self) -> None:
        while (batch := self._in.get()) is not None:
            self._out.put(Finished(batch=batch, findings=batch.run()))
