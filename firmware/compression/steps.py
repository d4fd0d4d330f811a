"""Work in small steps, so that a ping never waits: generators whose value is their result."""

from collections.abc import Generator, Iterator
from typing import Generic, TypeVar

from protocol.errors import EstimationError

T = TypeVar("T")


def run(steps: Generator[None, None, T]) -> T:
    """Return the value of a generator of steps, taken all at once."""
    while True:
        try:
            next(steps)
        except StopIteration as stop:
            value: T = stop.value
            return value


def stepping(steps: Generator[None, None, T]) -> Iterator[T | None]:
    """Yield None after every small step of a generator, and its value at the end."""
    while True:
        try:
            next(steps)
        except StopIteration as stop:
            yield stop.value
            return
        yield None


class Watched(Generic[T]):
    """The steps of a fit, which may end by a factorisation that failed; `ended` then says how."""

    def __init__(self, steps: Generator[T, None, str]) -> None:
        self.ended = "not fitted"
        self._steps = steps

    def __iter__(self) -> Iterator[T]:
        try:
            self.ended = yield from self._steps
        except EstimationError as error:  # not to be factorised at any nugget
            self.ended = str(error)
