"""A mission of processes over emulated modems beside the same one over plain lines, by seed.

    python -m benchmarks.modems --terrain FILE --seeds 3 --loss 0.14 --set KEY=VALUE

paper-1 whole, a process for each vehicle, in virtual time: raw lines that carry frames, and
Micro-Modems at rate 4, whose packets hold two frames that are lost together.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path

import numpy as np

from host_tools.commands import add_survey_arguments, count, status_of
from host_tools.processes.demo import run_demo
from host_tools.processes.emulated_modems import MODEMS
from host_tools.processes.voyage import Voyage, voyage_of

LINKS = ("raw", "micromodem")
FIGURES = ("live", "final")


def errors_m(arguments: argparse.Namespace, link: str, seed: int, out: Path) -> np.ndarray:
    """Return the mean errors (vehicles, 2), live and final, of one mission."""
    given = {**vars(arguments), "seed": seed, "changes": [*MODEMS[link], *arguments.changes]}
    voyage: Voyage = voyage_of(argparse.Namespace(**given))
    out.mkdir()
    run_demo(voyage, out, lambda _: None, report=False, modems=link)
    vehicles = json.loads((out / "summary.json").read_text())["vehicles"]
    return np.array([[v[name]["mean_m"] for name in FIGURES] for v in vehicles.values()])


def table(found: dict[str, np.ndarray]) -> list[str]:
    """Return a line a figure: means over seeds and vehicles, and their ratio.

    found has errors (seeds, vehicles, 2) by link.
    """
    lines = [f"{'mean error':<12}" + "".join(f"{link:>12}" for link in LINKS) + f"{'ratio':>8}"]
    for k, name in enumerate(FIGURES):
        raw_m, modems_m = (float(np.mean(found[link][..., k])) for link in LINKS)
        lines.append(f"{name:<12}{raw_m:10.2f} m{modems_m:10.2f} m{modems_m / raw_m:8.2f}")
    return lines


def main() -> None:
    """Run the missions and print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.modems", description=__doc__, allow_abbrev=False
    )
    add_survey_arguments(parser)
    parser.add_argument("--seeds", type=count, default=3, help="seeds 1 to N")
    arguments = parser.parse_args()
    found: dict[str, list[np.ndarray]] = {link: [] for link in LINKS}
    for seed in range(1, arguments.seeds + 1):
        for link in LINKS:
            with tempfile.TemporaryDirectory() as folder:
                found[link].append(errors_m(arguments, link, seed, Path(folder) / "out"))
            told = ", ".join(f"{live:.2f} / {final:.2f} m" for live, final in found[link][-1])
            print(f"seed {seed}, {link}: live / final {told}", flush=True)
    print("\n".join(table({link: np.array(errors) for link, errors in found.items()})))


if __name__ == "__main__":
    sys.exit(status_of("benchmarks.modems", main))
