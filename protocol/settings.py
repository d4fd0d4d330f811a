"""Frozen settings whose fields carry unit, reason and bounds, built from plain mappings.

Every room declares its own settings beside the code that reads them; `host_tools.mission_settings`
only gathers them into one tree. A value out of bounds and an unknown key are
`ConfigError`s that name the key, the bound and the unit.
"""

import dataclasses
import difflib
import math
import types
import typing
from collections.abc import Iterator, Mapping
from typing import Any, TypeVar

from protocol.errors import ConfigError

T = TypeVar("T", bound="Settings")


def setting(
    default: Any,  # noqa: ANN401
    unit: str,
    why: str,
    *,
    minimum: float | None = None,
    maximum: float | None = None,
    choices: tuple[str, ...] = (),
) -> Any:  # noqa: ANN401
    """Return a dataclass field with its unit, the reason for its value, and its bounds."""
    metadata = {
        "unit": unit,
        "why": why,
        "minimum": minimum,
        "maximum": maximum,
        "choices": choices,
    }
    if isinstance(default, type):
        return dataclasses.field(default_factory=default, metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Base of all settings trees; checks that every field is finite and in its declared bounds."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            _check(field, getattr(self, field.name))


def _check(field: "dataclasses.Field[Any]", value: object) -> None:
    minimum, maximum = field.metadata.get("minimum"), field.metadata.get("maximum")
    unit = field.metadata.get("unit", "")
    choices = field.metadata.get("choices", ())
    if choices and value not in choices:
        raise ConfigError(f"{field.name} is {value!r}; choose one of {', '.join(choices)}")
    if isinstance(value, bool) or not isinstance(value, int | float):
        return
    if isinstance(value, float) and not math.isfinite(value):
        of_it = f" in {unit}" if unit else ""
        raise ConfigError(f"{field.name} is {value}; give a finite number{of_it}")
    shown = f"{field.name} is {value} {'as a share' if unit == 'share' else unit}".rstrip()
    if minimum is not None and value < minimum:
        raise ConfigError(f"{shown}; it must be at least {minimum}")
    if maximum is not None and value > maximum:
        raise ConfigError(f"{shown}; it must be at most {maximum}")


def flatten(settings: Settings, prefix: str = "") -> Iterator[tuple[str, object, str, str]]:
    """Yield (dotted key, value, unit, why) for every leaf of a settings tree, in field order."""
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        key = prefix + field.name
        if isinstance(value, Settings):
            yield from flatten(value, key + ".")
        else:
            yield key, value, field.metadata.get("unit", ""), field.metadata.get("why", "")


def replace(settings: T, changes: Mapping[str, object], prefer: str = "") -> T:
    """Return settings with changes given as dotted keys; text is read as the field's type.

    A key may leave out the path when its last name occurs once in the tree, or in the subtree
    that is preferred.

    Raises
    ------
    ConfigError
        For an unknown or ambiguous key, an unreadable value, or one out of bounds.
    """
    known = [key for key, *_ in flatten(settings)]
    return _replaced(settings, {_resolve(name, known, prefer): changes[name] for name in changes})


def _resolve(name: str, known: list[str], prefer: str) -> tuple[str, ...]:
    if name in known:
        return tuple(name.split("."))
    matches = [key for key in known if key.endswith("." + name)]
    preferred = [key for key in matches if key.startswith(prefer + ".")]
    matches = preferred if len(preferred) == 1 else matches
    if len(matches) == 1:
        return tuple(matches[0].split("."))
    if matches:
        raise ConfigError(f"setting {name!r} is ambiguous; write one of {', '.join(matches)}")
    leaves = {key.rpartition(".")[2]: key for key in known}
    near = difflib.get_close_matches(name.rpartition(".")[2], leaves, n=1)
    meant = f"did you mean {leaves[near[0]]}? " if near else ""
    raise ConfigError(f"unknown setting {name!r}; {meant}`fathomlink config show` lists them all")


def _replaced(settings: T, changes: Mapping[tuple[str, ...], object]) -> T:
    """Return settings with all changes by path at once, since some are right only together."""
    kinds = typing.get_type_hints(type(settings))
    fresh: dict[str, object] = {}
    for name in {path[0]: None for path in changes}:
        below = {path[1:]: value for path, value in changes.items() if path[0] == name}
        if () in below:
            fresh[name] = _read(name, below[()], kinds[name])
        else:
            fresh[name] = _replaced(getattr(settings, name), below)
    return dataclasses.replace(settings, **fresh)


def _read(name: str, value: object, kind: Any) -> object:  # noqa: ANN401
    """Return the value as `kind`: bool, int, float or str, or None, or a tuple of one of them."""
    if typing.get_origin(kind) in {typing.Union, types.UnionType}:
        if value is None or (isinstance(value, str) and value.lower() in {"", "none"}):
            return None
        kind = next(k for k in typing.get_args(kind) if k is not type(None))
    if typing.get_origin(kind) is tuple:
        parts = value.split(",") if isinstance(value, str) else value
        element = typing.get_args(kind)[0]
        if not isinstance(parts, list | tuple):
            raise ConfigError(f"{name} is {value!r}; give a list separated by commas")
        return tuple(_read(name, part, element) for part in parts)
    if kind is bool:
        text = str(value).lower()
        if text in {"true", "yes", "on", "1", "false", "no", "off", "0"}:
            return text in {"true", "yes", "on", "1"}
        raise ConfigError(f"{name} is {value!r}; write true or false")
    try:
        if isinstance(value, bool) and kind in {int, float}:
            raise ValueError
        if kind is int and not isinstance(value, str) and value != int(value):  # type: ignore[call-overload]
            raise ValueError
        return kind(value)
    except (TypeError, ValueError, OverflowError) as error:
        wanted = {int: "a whole number", float: "a number"}.get(kind, "text")
        raise ConfigError(f"{name} is {value!r}; give {wanted}") from error
