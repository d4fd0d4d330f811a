"""Work in small steps, so that a ping never waits: generators whose value is their result."""

from collections.abc import Generator, Iterator
from typing import Generic, TypeVar

from protocol.errors import EstimationError

S = TypeVar("S")
T = TypeVar("T")


class Steps(Generic[S, T]):
    """The steps of a generator, one by one; once all are taken, `value` is the generator's."""

    value: T

    def __init__(self, steps: Generator[S, None, T]) -> None:
        self._steps = steps

    def __iter__(self) -> Iterator[S]:
        self.value = yield from self._steps


def run(steps: Generator[None, None, T]) -> T:
    """Return the value of a generator of steps, taken all at once."""
    taken = Steps(steps)
    for _ in taken:
        pass
    return taken.value


class Watched(Generic[S]):
    """The steps of a fit, which may end by a factorisation that failed; `ended` then says how."""

    def __init__(self, steps: Generator[S, None, str]) -> None:
        self.ended = "not fitted"
        self._steps = steps

    def __iter__(self) -> Iterator[S]:
        try:
            self.ended = yield from self._steps
        except EstimationError as error:  # not to be factorised at any nugget
            self.ended = str(error)
