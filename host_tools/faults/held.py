"""How much memory something holds, by walking all that it reaches."""

import sys
from collections.abc import Iterator
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType

import numpy as np

_CODE = (type, FunctionType, MethodType, BuiltinFunctionType, ModuleType)


def held_bytes(*roots: object) -> int:
    """Return the bytes of everything reachable from the roots, each object once."""
    seen: set[int] = set()
    waiting, total = list(roots), 0
    while waiting:
        thing = waiting.pop()
        if id(thing) in seen or isinstance(thing, _CODE):
            continue
        seen.add(id(thing))
        total += sys.getsizeof(thing)
        waiting.extend(_within(thing))
    return total


def _within(thing: object) -> Iterator[object]:
    if isinstance(thing, np.ndarray):
        if thing.base is not None:
            yield thing.base
        return
    if isinstance(thing, dict):
        yield from thing.keys()
        yield from thing.values()
    elif isinstance(thing, str | bytes | bytearray | int | float):
        return
    elif hasattr(thing, "__iter__") and hasattr(thing, "__len__"):
        yield from thing
    yield from getattr(thing, "__dict__", {}).values()
    for kind in type(thing).__mro__:
        for name in getattr(kind, "__slots__", ()):
            if hasattr(thing, name):
                yield getattr(thing, name)
