"""How well the built map tells valid closures from invalid ones.

    python -m benchmarks.map_vote --closures 40 --seed 1 [--relief rough,gentle]

Three sub-maps of either line, one after the other; a closure between the middle ones, right to a
metre or wrong by 8 to 60 m, carries its neighbours along, which then vote. A vote is a logarithm
of a likelihood ratio: above 0 it supports the closure, below 0 it contradicts it, 0 abstains.
"""

import argparse
import os
import time

import numpy as np

from benchmarks.matching import DURATION_S, SPEED_MPS, TERRAINS, Seabed, survey, synthetic, terrain
from firmware.leader.map_vote import VoteSettings, VoteWindow, carried, vote
from firmware.leader.matches import MatchingSettings
from firmware.leader.matching import match
from firmware.submaps import GriddedSubmap

NEIGHBOURS = (-1, 0, 1)


def line(
    seabed: Seabed, middle: np.ndarray, heading_rad: float, rng: np.random.Generator
) -> list[GriddedSubmap]:
    """Return three sub-maps along a line."""
    step = np.array([np.cos(heading_rad), np.sin(heading_rad)]) * SPEED_MPS * DURATION_S
    return [survey(seabed, middle + n * step, heading_rad, rng, 0.02)[0] for n in NEIGHBOURS]


def windows(
    first: list[GriddedSubmap],
    second: list[GriddedSubmap],
    shift_m: np.ndarray,
    rng: np.random.Generator,
    settings: MatchingSettings,
) -> list[VoteWindow]:
    """Return the windows that the match of the middle sub-maps did not look at."""
    still = (np.zeros(2), np.zeros(2))
    made = []
    for a, reference in zip(NEIGHBOURS, first, strict=True):
        for b, query in zip(NEIGHBOURS, second, strict=True):
            if a == b == 0:
                continue
            ages_s = (a * DURATION_S, b * DURATION_S)
            shift, covariance = carried(shift_m, 0.5 * np.eye(2), ages_s, still, settings)
            walk = rng.normal(0.0, np.sqrt(0.04 * (abs(ages_s[0]) + abs(ages_s[1]))), 2)
            made.append(
                VoteWindow(
                    reference=reference,
                    query=query,
                    shift_m=shift + walk,
                    covariance_m2=covariance,
                    matching=settings,
                )
            )
    return made


def main() -> None:
    """Print the quantiles of the vote for valid and invalid closures, and their overlap."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.map_vote", description=__doc__)
    parser.add_argument("--closures", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--relief", default="rough,gentle,ripples,flat," + ",".join(TERRAINS))
    arguments = parser.parse_args()
    matching, settings = MatchingSettings(), VoteSettings()
    for kind in arguments.relief.split(","):
        if kind in TERRAINS and "FATHOMLINK_DATA" not in os.environ:
            print(f"{kind}: skipped, FATHOMLINK_DATA is not set")
            continue
        rng = np.random.default_rng(arguments.seed)
        bed = terrain(kind) if kind in TERRAINS else synthetic(kind, rng)
        valid: list[float] = []
        invalid: list[float] = []
        took_s: list[float] = []
        while len(valid) < arguments.closures:
            middle = rng.uniform(0.25, 0.75, 2) * bed.size_m
            if not np.isfinite(
                bed.at(*(middle[:, None] + [[-150, 0, 150, 0], [0, -150, 0, 150]]))
            ).all():
                continue
            first = line(bed, middle, 0.0, rng)
            second = line(bed, middle + rng.uniform(-30, 30, 2), np.pi / 2.0, rng)
            found = match(first[1], second[1], np.zeros(2), 100.0 * np.eye(2), matching).match
            misfit = found.misfit if found else 1.0
            angle, wrong_m = rng.uniform(0, 2 * np.pi), rng.uniform(8.0, 60.0)
            for shift, votes in (
                (rng.normal(0.0, 0.7, 2), valid),
                (wrong_m * np.array([np.cos(angle), np.sin(angle)]), invalid),
            ):
                made = windows(first, second, shift, rng, matching)
                started = time.perf_counter()
                votes.append(vote(made, settings, misfit).log_ratio)
                took_s.append(time.perf_counter() - started)
        right = np.quantile(valid, [0.05, 0.5, 0.95])
        wrong = np.quantile(invalid, [0.05, 0.5, 0.95])
        print(
            f"{kind:12s} votes at 5, 50, 95 %: valid {np.round(right, 1)} "
            f"invalid {np.round(wrong, 1)} "
            f"| valid contradicted {np.mean(np.array(valid) < 0):.2f} "
            f"invalid supported {np.mean(np.array(invalid) > 0):.2f} "
            f"abstained {np.mean(np.array(valid) == 0):.2f} | {1e3 * np.median(took_s):.0f} ms",
            flush=True,
        )


if __name__ == "__main__":
    main()
