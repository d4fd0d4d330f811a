"""What a store holds whole, such as a core: pickled, and read back with our own classes only."""

import io
import pickle
from typing import Any, TypeVar

from firmware.store_file import StoreUnusableError

T = TypeVar("T")
_ROOMS = ("firmware.", "protocol.")
_OTHERS = {
    ("collections", "deque"),
    ("collections", "Counter"),
    ("collections", "OrderedDict"),
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"),
}


def written(whole: object, marks: tuple[object, ...]) -> bytes:
    """Return a core, or what matches found, and marks as bytes; numbers read back exactly."""
    return pickle.dumps((whole, marks), protocol=5)


def read(body: bytes, kind: type[T]) -> tuple[T, tuple[Any, ...]]:
    """Return what was written, of its kind, and the marks.

    Raises
    ------
    StoreUnusableError
        For bytes that this program has not written.
    """
    try:
        whole, marks = _Reader(io.BytesIO(body)).load()
        marks = tuple(marks)
    except Exception as error:  # a damaged pickle may raise anything
        raise StoreUnusableError(f"a {kind.__name__} in it cannot be read: {error}") from error
    if not isinstance(whole, kind):
        raise StoreUnusableError(f"a {kind.__name__} in it is a {type(whole).__name__}")
    return whole, marks


class _Reader(pickle.Unpickler):
    """Reads our own classes and numpy's arrays; nothing else can be named in a store."""

    def find_class(self, module: str, name: str) -> Any:  # noqa: ANN401
        if (module, name) in _OTHERS:
            return super().find_class(module, name)
        if module.startswith(_ROOMS) and "." not in name:
            found = super().find_class(module, name)
            if isinstance(found, type) and found.__module__ == module:
                return found
        raise pickle.UnpicklingError(f"{module}.{name} has no place in a store")
