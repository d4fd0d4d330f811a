"""`fathomlink link status DIR`: what became of frames, by cause, and what waits where."""

import argparse
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from host_tools.commands import Command
from host_tools.processes.records import FOLDER
from protocol.errors import ConfigError
from protocol.seal_state import DISK

GROUPS: dict[str, tuple[str, ...]] = {
    "modem": ("modem_",),
    "seal": ("modem_opened", "modem_not_sealed", "modem_marks_unwritten"),
    "rejected": ("modem_rejected_", "rejected_"),
    "frames": ("frames_", "slots_", "boots_refused"),
    "fragments": ("fragments_", "submaps_"),
    "reassembly": ("reassembly_",),
    "answers": ("answers_", "repeats_"),
    "ranges": ("ranges_",),
    "store": ("store_",),
    "line": ("line_", "arrivals_", "foreign_", "joined", "periods_"),
    "failed": (),
}
"""A line each; a counter goes to the last group one of whose beginnings it has."""
ALWAYS = ("sent", "received", "queued", "dropped", "discarded", "waiting", "wanted", "open")
"""Of the link's state a zero says something too."""


def status_lines(folder: Path) -> Iterator[str]:
    """Yield lines on every vehicle's link, from a mission's folder or a folder of stores.

    Raises
    ------
    ConfigError
        When the folder holds neither, or files that cannot be read.
    """
    counters = _counters(folder)
    stores = sorted({path for name in ("*.sqlite", "seal_*.counter") for path in folder.glob(name)})
    if not counters and not stores:
        raise ConfigError(
            f"{folder} holds no mission; give the --out folder of simulate, channel, leader or"
            " follower, or a --store folder"
        )
    for owner, values in counters.items():
        yield owner
        for group, line in _grouped(values).items():
            yield f"  {group:<11} {line}"
        yield from (f"  {line}" for line in advice_lines(values))
    for path in stores:
        yield _store_line(path)


def advice_lines(counters: Mapping[str, float]) -> Iterator[str]:
    """Yield a line for each count that somebody has to act on."""
    if counters.get("modem_own_echoes"):
        yield "frames bear our own modem's address: give every modem its own ?address="
    if counters.get("frames_with_our_number") or counters.get("modem_rejected_reflected"):
        yield "frames bear our own vehicle's number: give every vehicle its own --vehicle"
    if counters.get("boots_refused"):
        yield "a vehicle restarts without end, or two bear one number: give each its own --vehicle"
    if counters.get("rejected_version") or counters.get("modem_rejected_version"):
        yield "frames of another version were heard: bring all vehicles to one release"
    if counters.get("modem_rejected_plain"):
        yield "unsealed frames were heard: give every vehicle the --key"
    if counters.get("frames_sealed"):
        yield "sealed frames were heard: give this vehicle the --key of the others"


def _counters(folder: Path) -> dict[str, Mapping[str, float]]:
    """Return counters by vehicle: of a finished mission, or of processes that run or have died."""
    summary, processes = folder / "summary.json", sorted((folder / FOLDER).glob("*.json"))
    if summary.exists() and not processes:
        counters = _json(summary).get("counters", {})
        if not isinstance(counters, dict) or not all(
            isinstance(v, dict) for v in counters.values()
        ):
            raise ConfigError(f"{summary} holds no counters; give the folder of a mission")
        return counters
    return {path.stem: _json(path) for path in processes}


def _json(path: Path) -> dict[str, Any]:
    try:
        values = json.loads(path.read_text(encoding="ascii"))
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(
            f"{path} cannot be read ({error}); the mission has to write it"
        ) from error
    if not isinstance(values, dict):
        raise ConfigError(f"{path} holds no counters; give the folder of a mission")
    return values


def _grouped(counters: Mapping[str, object]) -> dict[str, str]:
    """Return one text a group; most zeros are left out."""
    parts: dict[str, list[str]] = {group: [] for group in GROUPS}
    for name, count in counters.items():
        if not isinstance(count, int | float):
            continue
        group, short = _place(name)
        if group and (count or short in ALWAYS):
            parts[group].append(f"{short.replace('_', ' ')} {count:g}")
    lines = {group: ", ".join(texts) for group, texts in parts.items() if texts}
    return lines if "rejected" in lines else {**lines, "rejected": "nothing"}


def _place(name: str) -> tuple[str, str]:
    """Return the group of a counter, and its name there."""
    if name.endswith("_failed") and not name.startswith("store_"):
        return "failed", name.removesuffix("_failed")
    found = ("", name)
    longest = 0
    for group, beginnings in GROUPS.items():
        for beginning in beginnings:
            if name.startswith(beginning) and len(beginning) > longest:
                longest = len(beginning)
                short = name.removeprefix(beginning) if beginning.endswith("_") else name
                found = (group, (short or name).removeprefix("modem_"))
    return found


def _store_line(path: Path) -> str:
    size_kb = path.stat().st_size / 1000.0
    if path.suffix == ".counter":
        marks = path.with_suffix(".marks")
        heard = _kept(marks) if marks.exists() else "{}"
        reserved = _kept(path)
        return (
            f"{path.stem}: counters reserved up to {reserved}, highest accepted by sender {heard}"
        )
    epoch = path.with_suffix(".epoch")
    aside = len(list(path.parent.glob(f"{path.stem}.aside-*.sqlite")))
    told = _kept(epoch) if epoch.exists() else "unknown"
    return f"{path.name}: {size_kb:.0f} kB, boot epoch {told}, {aside} earlier ones set aside"


def _kept(path: Path) -> str:
    """Return what a small file of a store says, or that it is damaged."""
    try:
        return DISK.read(path).strip()
    except UnicodeDecodeError:
        return "(damaged)"


def _configure(parser: argparse.ArgumentParser) -> None:
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="status")
    status = verbs.add_parser("status", help="frames by fate and cause, queues, stores")
    status.add_argument("folder", type=Path, metavar="DIR", help="a mission's --out or --store")


def _run(arguments: argparse.Namespace) -> None:
    for line in status_lines(arguments.folder):
        print(line)


COMMAND = Command(
    name="link", help="show the state of a mission's links", configure=_configure, run=_run
)
