"""Accuracy of whole missions over seeds, median, worst and mean.

    python -m benchmarks.accuracy --terrain FILE --scenario paper-1 --seeds 5 --set KEY=VALUE

takes what `fathomlink simulate` takes, and instead of a seed the first and how many. Speed is that
of the mission alone, one core, no report.
"""

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from host_tools.commands import (
    add_baseline_argument,
    add_survey_arguments,
    count,
    seed,
    settings_of,
    status_of,
)
from host_tools.evaluation import Evaluation, JudgedClosure, evaluate
from host_tools.registration import SEARCH_M
from host_tools.simulate import simulate

Figures = dict[str, float]
ACTIVE, FALSE = "closures active", "false among active"
FAR = f"tiles {SEARCH_M:.0f} m off or more, not in these"


@dataclass(frozen=True, slots=True)
class _Row:
    """A figure, its unit, and whether more of it is worse."""

    name: str
    unit: str
    more_is_worse: bool = True


def figures(evaluation: Evaluation, real_time: float) -> Figures:
    """Return the figures of one mission by the name of their row."""
    found: Figures = {}
    for name, errors in evaluation.vehicles.items():
        found |= {
            f"{name} live, share of dead reckoning": 100 * errors.live.share_of_dead_reckoning,
            f"{name} live, mean error": errors.live.mean_m,
            f"{name} live, NEES": errors.live.nees or np.nan,
            f"{name} final, mean error": errors.final.mean_m,
            f"{name} live, error at the end": errors.live.end_m,
            f"{name} final, error at the end": errors.final.end_m,
        }
    registration, tiles = evaluation.registration, evaluation.tiles
    active = [c for c in evaluation.closures if c.closure.active_at_end]
    return found | {
        "map error, mean": registration.mean_m,
        "map error, median": registration.median_m,
        "map under 0.5 m": 100 * registration.share_under_half_m,
        "map under 1 m": 100 * registration.share_under_1m,
        "map, share of the truth map": 100 * registration.mapped_share,
        "tile shift, median": tiles.median_m,
        "tile shift, 95 %": tiles.p95_m,
        FAR: float(tiles.far_tiles),
        "closures detected": float(len(evaluation.closures)),
        "valid among detected": _valid(list(evaluation.closures)),
        ACTIVE: float(len(active)),
        FALSE: float(sum(not c.is_valid for c in active)),
        "valid among active": _valid(active),
        "speed": real_time,
    }


def _valid(closures: list[JudgedClosure]) -> float:
    return 100 * float(np.mean([c.is_valid for c in closures])) if closures else np.nan


_UNITS: tuple[tuple[str, str, bool], ...] = (
    ("share of dead reckoning", "%", True),
    ("share of the truth map", "%", False),
    ("tiles", "", True),
    ("NEES", "", True),
    ("under", "%", False),
    ("valid", "%", False),
    ("false", "", True),
    ("closures", "", False),
    ("speed", "x real time", False),
    ("", "m", True),
)


def _row(name: str) -> _Row:
    unit, worse = next((unit, worse) for part, unit, worse in _UNITS if part in name)
    return _Row(name, unit, worse)


def table(runs: list[Figures]) -> list[str]:
    """Return a line a figure: median, worst and mean over the runs that have it."""
    lines = [f"{'':<42} {'median':>9} {'worst':>9} {'mean':>9}"]
    for name in runs[0]:
        row, values = _row(name), np.array([run[name] for run in runs])
        worst: Callable[[np.ndarray], float] = np.nanmax if row.more_is_worse else np.nanmin
        if np.isnan(values).all():
            lines.append(f"{name:<42} {'-':>9} {'-':>9} {'-':>9}")
            continue
        told = np.count_nonzero(np.isfinite(values))
        of = f" ({told} of {len(runs)} seeds)" if told < len(runs) else ""
        three = (np.nanmedian(values), worst(values), np.nanmean(values))
        columns = " ".join(f"{value:9.2f}" for value in three)
        lines.append(f"{name:<42} {columns} {row.unit}{of}")
    return lines


def total(runs: list[Figures]) -> str:
    """Return a line about the active closures of all runs."""
    false, active = (sum(run[name] for run in runs) for name in (FALSE, ACTIVE))
    return f"{false:,.0f} false of {active:,.0f} active closures over all {len(runs)} seeds"


def main() -> None:
    """Run the missions and print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.accuracy", description=__doc__, allow_abbrev=False
    )
    add_survey_arguments(parser)
    add_baseline_argument(parser)
    parser.add_argument("--seeds", type=count, default=5, metavar="N", help="default: 5")
    parser.add_argument("--first", type=seed, default=1, metavar="N", help="first seed (default 1)")
    arguments = parser.parse_args()
    settings, runs = settings_of(arguments), []
    for number in range(arguments.first, arguments.first + arguments.seeds):
        began_s = time.process_time()
        with threadpool_limits(1):
            result = simulate(settings, arguments.terrain, number, arguments.baseline)
        took_s = time.process_time() - began_s
        runs.append(figures(evaluate(result), settings.scenario.duration_s / took_s))
        live = [v for k, v in runs[-1].items() if "live, share" in k]
        print(f"seed {number}: live {' / '.join(f'{share:.1f}' for share in live)} %", flush=True)
    print("\n".join([*table(runs), total(runs)]))


if __name__ == "__main__":
    sys.exit(status_of("benchmarks.accuracy", main))
