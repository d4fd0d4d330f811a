"""`fathomlink config show`: every setting with its value, unit and reason."""

import argparse

from host_tools.commands import Command, add_settings_arguments, settings_of
from protocol.settings import Settings, flatten


def settings_lines(settings: Settings) -> list[str]:
    """Return one line a setting: key = value unit  # reason."""
    rows = []
    for key, value, unit, why in flatten(settings):
        shown = str(value).lower() if value is None or isinstance(value, bool) else _text(value)
        rows.append((f"{key} = {shown} {unit}".rstrip(), why))
    width = min(64, max((len(left) for left, _ in rows), default=0))
    return [f"{left:<{width}}  # {why}".rstrip() for left, why in rows]


def _text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.10g}"
    if isinstance(value, tuple):
        return ",".join(_text(item) for item in value)
    return str(value)


def _configure(parser: argparse.ArgumentParser) -> None:
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="show")
    add_settings_arguments(verbs.add_parser("show", help="list every setting"))


def _run(arguments: argparse.Namespace) -> None:
    print("\n".join(settings_lines(settings_of(arguments))))


COMMAND = Command(
    name="config", help="list every setting that --set reaches", configure=_configure, run=_run
)
