"""What a subcommand is, and the arguments that several of them share."""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from firmware.follower.settings import FollowerSettings
from host_tools.mission_settings import MissionSettings, mission_of
from host_tools.scenario import load_scenario
from protocol.errors import ConfigError, FathomError

PROFILES = ("paper", "dense", "lattice")
CHOICES = (*PROFILES, "auto")
BASELINES = ("none", "unlimited", "octree")
BAD_INPUT = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """One subcommand: its name, a line of help, its arguments, and what it does."""

    name: str
    help: str
    configure: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], None]


def status_of(name: str, work: Callable[[], None]) -> int:
    """Do the work; return 0, or 2 with one line on stderr that says what is wrong."""
    try:
        work()
        sys.stdout.flush()
    except FathomError as error:
        print(f"{name}: {' '.join(str(error).split())}", file=sys.stderr)
        return BAD_INPUT
    except BrokenPipeError:  # the reader, such as `head`, has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        of = "" if error.filename is None else f"{error.filename}: "
        print(f"{name}: {of}{error.strerror or error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print(f"{name}: interrupted", file=sys.stderr)
        return BAD_INPUT
    return 0


def add_settings_arguments(parser: argparse.ArgumentParser) -> None:
    """Add --scenario, --loss and --set."""
    parser.add_argument(
        "--scenario",
        default="paper-1",
        metavar="NAME|FILE.toml",
        help="paper-1, paper-2, field-1, day-1, or a file of scenario keys (default: %(default)s)",
    )
    parser.add_argument(
        "--loss",
        type=float,
        metavar="P",
        help="share of frames lost per receiver, both ways; default: that of the scenario",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="changes",
        help="change a setting; `fathomlink config show` lists them; may be repeated",
    )


def add_mission_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what says which mission is simulated: what is surveyed, seed, baseline."""
    add_survey_arguments(parser)
    add_seed_argument(parser)
    add_baseline_argument(parser)


def add_survey_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what says what is surveyed and how: terrain, scenario, settings, profile."""
    parser.add_argument(
        "--terrain",
        type=Path,
        metavar="FILE",
        help="GeoTIFF, BAG or other raster in a metric projection; default: a built-in relief",
    )
    add_settings_arguments(parser)
    profile = FollowerSettings().profile
    parser.add_argument("--profile", choices=CHOICES, default=profile, help=f"default: {profile}")


def add_seed_argument(parser: argparse.ArgumentParser) -> None:
    """Add --seed."""
    parser.add_argument("--seed", type=seed, default=1, metavar="N", help="default: 1")


def add_baseline_argument(parser: argparse.ArgumentParser) -> None:
    """Add --baseline."""
    parser.add_argument("--baseline", choices=BASELINES, default="none", help="default: none")


def settings_of(arguments: argparse.Namespace) -> MissionSettings:
    """Return the settings that --scenario, --loss and --set mean, the last given first in rank.

    Raises
    ------
    ConfigError
        For an unknown scenario or key, or a value that cannot be.
    """
    scenario = load_scenario(arguments.scenario)
    changes = parse_changes(arguments.changes)
    if arguments.loss is not None:
        changes = {"scenario.water.loss": arguments.loss, **changes}
    if getattr(arguments, "profile", None) is not None:
        is_octree = getattr(arguments, "baseline", None) == "octree"  # rides in paper's packets
        changes = {"follower.profile": "paper" if is_octree else arguments.profile, **changes}
    settings = mission_of(scenario, changes)
    settings.scenario.check()
    return settings


def parse_changes(texts: Sequence[str]) -> dict[str, object]:
    """Return the KEY=VALUE texts as a mapping; a later one replaces an earlier one.

    Raises
    ------
    ConfigError
        For a text without an equals sign.
    """
    changes: dict[str, object] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise ConfigError(f"--set {text!r} is not KEY=VALUE, such as --set duration_min=10")
        changes.pop(key.strip(), None)  # the later one comes after what was set in between
        changes[key.strip()] = value.strip()
    return changes


def check_apart(source: Path, out: Path) -> None:
    """Raise ConfigError where an output would be written over its input."""
    if source.resolve() == out.resolve():
        raise ConfigError(f"{out} would be written over its own input; give another name")


def folder_of(text: str) -> Path:
    """Return the text as a folder; an empty one would mean the current folder."""
    if not text:
        raise argparse.ArgumentTypeError("the name is empty; give a folder, such as out/mine")
    return Path(text)


def count(text: str) -> int:
    """Return the text as a number of something, 1 or more."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is none; give 1 or more")
    return value


def seed(text: str) -> int:
    """Return the text as a seed, 0 or more."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is negative; a seed is 0 or more")
    return value
