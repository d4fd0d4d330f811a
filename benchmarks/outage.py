"""An hour without the link, then its return: how far astray, and how soon all is well again.

    python -m benchmarks.outage --terrain FILE --seeds 3 [--scenario day-1] [--set ...]

runs every mission twice, with the link silent from minute 30 to minute 90, and undisturbed; both
last until minute 120. Errors are of live beliefs, over spans of ten minutes.
"""

import argparse
import math
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from host_tools.commands import add_survey_arguments, count, settings_of, status_of
from host_tools.mission_settings import MissionSettings, changed
from host_tools.simulate import simulate

BEGINS_MIN, SILENT_MIN, DURATION_MIN, SPAN_MIN = 30.0, 60.0, 120.0, 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Spans:
    """Mean live error in m of each vehicle (V,) over the spans (S,) of a mission, (V, S)."""

    names: list[str]
    error_m: np.ndarray


def live_errors(settings: MissionSettings, terrain: Path | None, seed: int) -> Spans:
    """Run a mission; return its vehicles' live errors."""
    with threadpool_limits(1):
        result = simulate(settings, terrain, seed)
    spans = math.ceil(settings.scenario.duration_min / SPAN_MIN)
    rows = []
    for vehicle in result.vehicles:
        true_m = vehicle.truth.position_m
        miss_m = np.hypot(*(vehicle.live_m - true_m).T)
        rows.append([part.mean() for part in np.array_split(miss_m[1:], spans)])
    return Spans(names=[vehicle.name for vehicle in result.vehicles], error_m=np.array(rows))


def main() -> None:
    """Run the missions; print the spans of each, and the ratio after the link's return."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.outage", description=__doc__, allow_abbrev=False
    )
    add_survey_arguments(parser)
    parser.set_defaults(scenario="day-1")
    parser.add_argument("--seeds", type=count, default=3, help="seeds 1 to N")
    arguments = parser.parse_args()
    undisturbed = changed(
        settings_of(arguments),
        {"duration_min": DURATION_MIN, "follower_duration_min": DURATION_MIN},
    )
    silent = {
        "scenario.water.silent_from_min": BEGINS_MIN,
        "scenario.water.silent_min": SILENT_MIN,
    }
    disturbed = changed(undisturbed, silent)
    ends_min = np.arange(SPAN_MIN, DURATION_MIN + 1.0, SPAN_MIN)
    back = ends_min > BEGINS_MIN + SILENT_MIN + SPAN_MIN
    print(f"{'live error (m) until minute':<32}" + "".join(f"{end:7.0f}" for end in ends_min))
    ratios = []
    for seed in range(1, arguments.seeds + 1):
        without = live_errors(undisturbed, arguments.terrain, seed)
        with_silence = live_errors(disturbed, arguments.terrain, seed)
        for name, free, silenced in zip(
            without.names, without.error_m, with_silence.error_m, strict=True
        ):
            for what, errors in (("undisturbed", free), ("silent 30-90", silenced)):
                cells = "".join(f"{error:7.2f}" for error in errors)
                print(f"{f'seed {seed} {name} {what}':<32}{cells}", flush=True)
        after = with_silence.error_m[:, back].mean(axis=1) / without.error_m[:, back].mean(axis=1)
        ratios.append(after)
    for name, ratio in zip(without.names, np.median(ratios, axis=0), strict=True):
        print(f"{name}: {ratio:.2f} x the undisturbed error from ten minutes after its return on")


if __name__ == "__main__":
    sys.exit(status_of("benchmarks.outage", main))
