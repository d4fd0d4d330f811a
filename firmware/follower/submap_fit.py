"""A sub-map under compression, a step at a time."""

from collections.abc import Iterator
from typing import Any

from firmware.compression import Compressed, compress_steps
from firmware.compression.settings import CompressionSettings
from firmware.submaps import Submap
from protocol.errors import EstimationError


class SubmapFit:
    """The compression of one sub-map.

    A checkpoint holds how many steps are done; once it is read they are done again.
    """

    def __init__(
        self, submap: Submap, settings: CompressionSettings, profile: str, done: int = 0
    ) -> None:
        self.submap = submap
        self._asked, self._done = (settings, profile), done
        self._steps: Iterator[Compressed] | None = None
        self._best: Compressed | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what a checkpoint holds."""
        return SubmapFit, (self.submap, *self._asked, self._done)

    @property
    def best(self) -> Compressed | None:
        """The result of the steps done so far, None before the first."""
        self._caught_up()
        return self._best

    def step(self) -> bool:
        """Do one step; return False where there is none left, or none that can be done."""
        try:
            better = next(self._caught_up(), None)
        except EstimationError:
            better = None
        if better is None:
            return False
        self._best, self._done = better, self._done + 1
        return True

    def _caught_up(self) -> Iterator[Compressed]:
        """Return the steps that are left."""
        if self._steps is None:
            self._steps = compress_steps(self.submap.bins, *self._asked)
            for _ in range(self._done):
                self._best = next(self._steps)
        return self._steps
