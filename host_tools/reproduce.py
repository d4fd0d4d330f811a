"""`fathomlink reproduce`: section 6 of the paper rerun, its figures beside ours."""

import argparse
import json
import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from host_tools.commands import BASELINES, Command, count, folder_of
from host_tools.evaluation import Evaluation, as_plain, closure_counts, evaluate
from host_tools.matching_trial import PAIRS, TrialResult, run_trial, trial_lines
from host_tools.mission_settings import mission_of
from host_tools.scenario import named_scenario
from host_tools.simulate import simulate
from host_tools.simulator.placement import place_survey
from host_tools.simulator.terrain import open_terrain
from host_tools.writers import prepare_folder

SCENARIOS = ("paper-1", "paper-2")
# Mean live errors in metres, leader and follower (6.2); nothing is printed for the rest.
PAPER_MEANS_M = {
    ("paper-1", "none"): (19.76, 22.27),
    ("paper-1", "unlimited"): (21.05, 22.40),
    ("paper-1", "octree"): (23.69, 26.64),
    ("paper-2", "none"): (24.50, 29.26),
}
PAPER_SHARES = {("paper-1", "none"): (0.1798, 0.1769), ("paper-2", "none"): (0.1806, None)}
PAPER_MAPS = {"paper-1": (0.47, 0.33, 0.8806), "paper-2": (0.54, 0.41, 0.8495)}


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What is kept of one mission."""

    scenario: str
    baseline: str
    seed: int
    leader_live_m: float
    leader_share: float
    follower_live_m: float
    follower_share: float
    leader_end_m: float
    follower_end_m: float
    map_mean_m: float
    map_median_m: float
    map_under_1m: float
    active_closures: float
    valid_share: float


def outcome_of(scenario: str, baseline: str, seed: int, evaluation: Evaluation) -> Outcome:
    """Return the figures of one mission that the paper prints too."""
    leader, follower = (evaluation.vehicles[name] for name in ("leader", "follower_1"))
    active = closure_counts(evaluation.closures)["active"]
    return Outcome(
        scenario=scenario,
        baseline=baseline,
        seed=seed,
        leader_live_m=leader.live.mean_m,
        leader_share=leader.live.share_of_dead_reckoning,
        follower_live_m=follower.live.mean_m,
        follower_share=follower.live.share_of_dead_reckoning,
        leader_end_m=leader.live.end_m,
        follower_end_m=follower.live.end_m,
        map_mean_m=evaluation.registration.mean_m,
        map_median_m=evaluation.registration.median_m,
        map_under_1m=evaluation.registration.share_under_1m,
        active_closures=active["number"],
        valid_share=active["valid_share"],
    )


def check_sites(terrain: Path | None, seeds: Sequence[int]) -> None:
    """Raise ConfigError where a simulation finds no room, before the first has begun."""
    raster = open_terrain(terrain)
    for scenario in SCENARIOS:
        for seed in seeds:
            place_survey(raster, named_scenario(scenario), seed)


def simulations(
    terrain: Path | None, seeds: Sequence[int], announce: Callable[[str], None]
) -> Iterable[Outcome]:
    """Yield the outcomes of simulations 1 and 2 under every baseline and seed."""
    for scenario in SCENARIOS:
        settings = mission_of(named_scenario(scenario), {"follower.profile": "paper"})
        for baseline in BASELINES:
            for seed in seeds:
                announce(f"{scenario}, {baseline}, seed {seed}")
                result = simulate(settings, terrain, seed, baseline)
                yield outcome_of(scenario, baseline, seed, evaluate(result))


def simulation_lines(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the simulations as a table: the median over the seeds, the worst, the paper's."""
    lines = [
        f"{'scenario, communication':<24} {'vehicle':<9} {'live error, mean':>26} "
        f"{'share of dead reckoning':>24} {'at the end':>18}  paper"
    ]
    for scenario in SCENARIOS:
        for baseline in BASELINES:
            runs = [o for o in outcomes if (o.scenario, o.baseline) == (scenario, baseline)]
            if not runs:
                continue
            title = f"{scenario}, {baseline}"
            for k, vehicle in enumerate(("leader", "follower")):
                mean, share, end = (
                    [getattr(run, f"{vehicle}_{what}") for run in runs]
                    for what in ("live_m", "share", "end_m")
                )
                lines.append(
                    f"{title:<24} {vehicle:<9} {_spread(mean, '{:.2f} m'):>26} "
                    f"{_spread(share, '{:.1%}'):>24} {_spread(end, '{:.2f} m'):>18}  "
                    f"{_paper(scenario, baseline, k)}"
                )
        lines += _map_lines(scenario, outcomes)
    return lines


def _map_lines(scenario: str, outcomes: Sequence[Outcome]) -> list[str]:
    runs = [o for o in outcomes if (o.scenario, o.baseline) == (scenario, "none")]
    if not runs:
        return []
    mean_m, median_m, under = PAPER_MAPS[scenario]
    closures = statistics.median(run.active_closures for run in runs)
    return [
        f"{scenario}, map: mean {statistics.median(run.map_mean_m for run in runs):.3f} m "
        f"(paper {mean_m}), median {statistics.median(run.map_median_m for run in runs):.3f} m "
        f"({median_m}), under 1 m {statistics.median(run.map_under_1m for run in runs):.1%} "
        f"({under:.1%}); {closures:.0f} active closures"
    ]


def _spread(values: Sequence[float], form: str) -> str:
    return f"{form.format(statistics.median(values))} (worst {form.format(max(values))})"


def _paper(scenario: str, baseline: str, vehicle: int) -> str:
    means, shares = (table.get((scenario, baseline)) for table in (PAPER_MEANS_M, PAPER_SHARES))
    parts = [] if means is None else [f"{means[vehicle]} m"]
    share = None if shares is None else shares[vehicle]
    return ", ".join([*parts, *([] if share is None else [f"{share:.1%}"])]) or "-"


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--terrain", type=Path, metavar="FILE", help="default: a built-in relief")
    parser.add_argument(
        "--seeds", type=count, default=5, metavar="N", help="seeds 1 to N; default 5"
    )
    parser.add_argument(
        "--pairs",
        type=count,
        default=PAIRS,
        metavar="N",
        help=f"pairs of sub-maps for Figure 8; default {PAIRS}",
    )
    parser.add_argument(
        "--out", type=folder_of, metavar="DIR", help="write the figures there as well"
    )


def _run(arguments: argparse.Namespace) -> None:
    folder = None if arguments.out is None else prepare_folder(arguments.out)
    seeds = range(1, arguments.seeds + 1)
    check_sites(arguments.terrain, seeds)
    trial = _trial(arguments.terrain, arguments.pairs)
    lines = ["Section 6.1, Figure 8: closures between sub-maps", *trial_lines(trial), ""]
    print("\n".join(lines))
    total = len(SCENARIOS) * len(BASELINES) * arguments.seeds
    with tqdm(total=total, unit="mission", leave=False, disable=None) as bar:
        outcomes = []
        for outcome in simulations(arguments.terrain, seeds, bar.set_description):
            outcomes.append(outcome)
            bar.update()
    table = ["Section 6.2, simulations 1 and 2", *simulation_lines(outcomes)]
    print("\n".join(table))
    if folder is not None:
        text = "\n".join([*lines, *table]) + "\n"
        (folder / "reproduce.txt").write_text(text, encoding="utf-8")
        numbers = {"figure_8": as_plain(trial), "simulations": as_plain(outcomes)}
        (folder / "reproduce.json").write_text(json.dumps(numbers, indent=2), encoding="utf-8")


def _trial(terrain: Path | None, pairs: int) -> TrialResult:
    scenario = named_scenario("paper-1")
    site = place_survey(open_terrain(terrain), scenario, 1)
    with tqdm(total=pairs, unit="pair", desc="Figure 8", leave=False, disable=None) as bar:
        return run_trial(scenario, site, 1, pairs=pairs, progress=lambda _: bar.update())


COMMAND = Command(
    name="reproduce",
    help="rerun section 6 of the paper and print its figures beside ours",
    configure=_configure,
    run=_run,
)
