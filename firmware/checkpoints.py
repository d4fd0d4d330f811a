"""A core written down whole, for stores: pickled, and read back with our own classes only."""

import io
import pickle
from collections.abc import Mapping
from typing import Any

from firmware.store_file import StoreUnusableError

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


class NotNowError(Exception):
    """The core is in the middle of work that cannot be written down."""


def written(state: Mapping[str, object], marks: tuple[object, ...]) -> bytes:
    """Return a core's attributes and its recorder's marks as bytes.

    Raises
    ------
    NotNowError
        While the core holds an iterator, such as a fit at work.
    """
    try:
        return pickle.dumps((dict(state), marks), protocol=5)
    except TypeError as error:
        raise NotNowError(str(error)) from error


def read(body: bytes) -> tuple[dict[str, Any], tuple[Any, ...]]:
    """Return the attributes and marks of bytes.

    Raises
    ------
    StoreUnusableError
        For bytes that are no checkpoint of this program.
    """
    try:
        state, marks = _Reader(io.BytesIO(body)).load()
        return dict(state), tuple(marks)
    except Exception as error:  # a damaged pickle may raise anything
        raise StoreUnusableError(f"its checkpoint cannot be read: {error}") from error


class _Reader(pickle.Unpickler):
    """Reads our own classes and numpy's arrays; nothing else can be named in a checkpoint."""

    def find_class(self, module: str, name: str) -> Any:  # noqa: ANN401
        if (module, name) in _OTHERS:
            return super().find_class(module, name)
        if module.startswith(_ROOMS) and "." not in name:
            found = super().find_class(module, name)
            if isinstance(found, type) and found.__module__ == module:
                return found
        raise pickle.UnpicklingError(f"{module}.{name} has no place in a checkpoint")
