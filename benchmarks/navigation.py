"""What each profile is worth to navigation: closures and live errors, by loss, over seeds.

    python -m benchmarks.navigation --terrain massbay_west_5m.tif --seeds 2 --loss 0.14 --loss 0.3

Live errors are shares of dead reckoning, the median over the seeds; `unlimited` sends every cell
and loses none. A coder is a profile, or a profile and its frames: `--coder lattice:2`.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.accuracy import Figures, figures
from host_tools.commands import add_mission_arguments, count, settings_of, status_of
from host_tools.evaluation import evaluate
from host_tools.simulate import simulate

_CODERS = ("unlimited", "paper", "dense", "lattice", "lattice:2")
_COLUMNS = (
    ("detected", "closures detected"),
    ("active", "closures active"),
    ("valid %", "valid among active"),
    ("leader %", "leader live, share of dead reckoning"),
    ("follower %", "follower_1 live, share of dead reckoning"),
    ("leader m", "leader live, mean error"),
    ("follower m", "follower_1 live, mean error"),
)


def mission(terrain: Path | None, coder: str, loss: float, seed: int) -> Figures:
    """Return the figures of one mission of `paper-1`."""
    parser = argparse.ArgumentParser()
    add_mission_arguments(parser)
    profile, _, frames = coder.partition(":")
    unlimited = profile == "unlimited"
    words = ["--scenario", "paper-1", "--loss", str(loss)]
    words += ["--profile", "paper" if unlimited else profile]
    if frames:
        words += ["--set", f"follower.frames_per_submap={frames}"]
    baseline = "unlimited" if unlimited else "none"
    with threadpool_limits(1):
        result = simulate(settings_of(parser.parse_args(words)), terrain, seed, baseline)
    return figures(evaluate(result), np.nan)


def line(coder: str, loss: float, runs: list[Figures]) -> str:
    """Return a row of the table: the median over the runs, and the live shares of each."""
    values = [float(np.nanmedian([run[name] for run in runs])) for _, name in _COLUMNS]
    each = " ".join(
        "/".join(f"{run[f'{vehicle} live, share of dead reckoning']:.1f}" for run in runs)
        for vehicle in ("leader", "follower_1")
    )
    return f"{coder:<12}{100 * loss:4.0f} % " + "".join(f"{v:11.1f}" for v in values) + f"   {each}"


def main() -> None:
    """Run the missions and print a line for each loss and coder."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.navigation", description=__doc__)
    parser.add_argument("--terrain", type=Path, metavar="FILE")
    parser.add_argument("--seeds", type=count, default=2, help="seeds 1 to N")
    parser.add_argument("--loss", type=float, action="append", help="default: 0.14 and 0.3")
    parser.add_argument("--coder", action="append", help=f"default: {' '.join(_CODERS)}")
    arguments = parser.parse_args()
    head = "".join(f"{name:>11}" for name, _ in _COLUMNS)
    print(f"{'coder':<12}{'loss':>6} {head}   by seed: leader, follower", flush=True)
    for loss in arguments.loss or (0.14, 0.3):
        for coder in arguments.coder or _CODERS:
            seeds = range(1, arguments.seeds + 1)
            runs = [mission(arguments.terrain, coder, loss, seed) for seed in seeds]
            print(line(coder, loss, runs), flush=True)


if __name__ == "__main__":
    sys.exit(status_of("benchmarks.navigation", main))
