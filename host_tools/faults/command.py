"""`fathomlink faults`: trials over seeds, or one seed again with everything that befell it."""

import argparse
import itertools
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace

from tqdm import tqdm

from host_tools.commands import Command, count, seed
from host_tools.faults.catalogue import Fault, Plan, plan_of
from host_tools.faults.link_trial import FIRST_S, SPAN_S, link_trial
from host_tools.faults.mission_trial import FIRST_S as MISSION_FIRST_S
from host_tools.faults.mission_trial import SPAN_S as MISSION_SPAN_S
from host_tools.faults.mission_trial import mission_trial
from host_tools.faults.rig import Outcome
from host_tools.faults.survey import Survey
from protocol.errors import FathomError

TWICE_EVERY = 50
"""One seed in so many is run twice: the same seed must give the same bytes."""

Trial = Callable[[int], Outcome]


class FaultsFoundError(FathomError):
    """Some seed broke an invariant."""


@dataclass(slots=True)
class Tally:
    """What many trials came to."""

    trials: int = 0
    deaths: int = 0
    repeated: int = 0
    longest_s: float = 0.0
    seeds_of: Counter[Fault] = field(default_factory=Counter)
    broken: list[Outcome] = field(default_factory=list)

    def add(self, outcome: Outcome) -> None:
        """Count one trial."""
        self.trials += 1
        self.deaths += outcome.deaths
        self.seeds_of.update(outcome.fired.keys())
        self.longest_s = max(self.longest_s, outcome.recovered_s or 0.0)
        if outcome.violations:
            self.broken.append(outcome)


def trials(trial: Trial, seeds: Iterable[int]) -> Iterator[Outcome]:
    """Yield the outcome of each seed; some are run twice, and must come out the same."""
    for number in seeds:
        outcome = trial(number)
        if number % TWICE_EVERY == 0 and trial(number) != outcome:
            wrong = (*outcome.violations, "the same seed gave other bytes")
            outcome = replace(outcome, violations=wrong)
        yield outcome


def tier(name: str) -> tuple[Trial, Callable[[int], Plan]]:
    """Return the trial of a tier, and the plan that a seed has in it."""
    if name == "link":
        return link_trial, lambda number: plan_of(number, FIRST_S, SPAN_S)
    survey = Survey()
    return (
        lambda number: mission_trial(number, survey),
        lambda number: plan_of(number, MISSION_FIRST_S, MISSION_SPAN_S),
    )


def summary_lines(tally: Tally, took_s: float) -> list[str]:
    """Return what is to be said of many trials."""
    lines = [
        f"{tally.trials} trials, {tally.deaths} deaths of computers, {len(tally.broken)} broken;"
        f" longest way back {tally.longest_s:g} s; {60.0 * tally.trials / took_s:.0f} a minute"
    ]
    lines += [f"{tally.seeds_of[fault]:7d} seeds  {fault.value}" for fault in Fault]
    lines += [f"seed {bad.seed}: {'; '.join(bad.violations)}" for bad in tally.broken]
    return lines


def _one(trial: Trial, plan: Plan, number: int) -> Outcome:
    for strike in sorted(plan.strikes, key=lambda strike: strike.from_s):
        whose = "leader" if strike.vehicle == 0 else "follower"
        times = f"{strike.from_s:5.0f} to {strike.until_s:5.0f} s"
        print(f"{times}  {whose:<8}  {strike.fault.value}")
    outcome = trial(number)
    told = {fault.name.lower(): count for fault, count in outcome.fired.items()}
    print(f"fired {told}; {outcome.deaths} deaths; bytes {outcome.digest}")
    if outcome.recovered_s is not None:
        print(f"well again {outcome.recovered_s:g} s after the last fault")
    return outcome


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--tier",
        choices=("link", "mission"),
        default="link",
        help="link: without fit and graph; mission: short surveys (default: %(default)s)",
    )
    parser.add_argument("--seeds", type=count, default=1000, metavar="N", help="default: 1000")
    parser.add_argument("--first", type=seed, default=0, metavar="N", help="first seed (default 0)")
    parser.add_argument("--seed", type=seed, metavar="N", help="this seed alone, with its faults")


def _run(arguments: argparse.Namespace) -> None:
    trial, plan_for = tier(arguments.tier)
    if arguments.seed is not None:
        outcome = _one(trial, plan_for(arguments.seed), arguments.seed)
        _judge([outcome] if outcome.violations else [], arguments.tier)
        return
    tally, began_s = Tally(), time.perf_counter()
    seeds = itertools.islice(itertools.count(arguments.first), arguments.seeds)
    progress = tqdm(seeds, total=arguments.seeds, unit="seed", leave=False, disable=None)
    for outcome in trials(trial, progress):
        tally.add(outcome)
    print("\n".join(summary_lines(tally, time.perf_counter() - began_s)))
    _judge(tally.broken, arguments.tier)


def _judge(broken: list[Outcome], tier_name: str) -> None:
    if broken:
        first = broken[0]
        raise FaultsFoundError(
            f"{len(broken)} seeds broke an invariant; the first again: fathomlink faults"
            f" --tier {tier_name} --seed {first.seed} ({first.violations[0][:200]})"
        )


COMMAND = Command(
    name="faults",
    help="try the vehicles' programs under simulated faults",
    configure=_configure,
    run=_run,
)
