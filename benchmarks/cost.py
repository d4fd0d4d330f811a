"""What a step costs against the length of a mission, and against the number of followers.

    python -m benchmarks.cost --hours 24 [--follower-hours 1] [--plot out/cost.png] [--set ...]

runs `day-1` as `benchmarks.days` does: once for the hours given, with one follower unless `--set
followers=N`, and for the follower hours with 1, 2, 3 and 4 followers, who share the air. A figure
at hour H is of the hour before H; one of some followers is of their mission's last hour.
"""

import argparse
import sys
from pathlib import Path

import matplotlib as mpl

from benchmarks.days import HEAD, Row, lasting, mission
from host_tools.commands import add_seed_argument, add_survey_arguments, settings_of, status_of
from host_tools.mission_settings import changed

mpl.use("Agg")
from matplotlib import pyplot as plt

FOLLOWERS = (1, 2, 3, 4)
MARKS_H = (1.0, 3.0, 10.0, 24.0)


def table(by_hour: list[Row], by_followers: list[Row]) -> str:
    """Return a line for each marked hour, for the last, and for each number of followers."""
    marked = [row for row in by_hour if row.hours in MARKS_H or row is by_hour[-1]]
    named = [(f"hour {row.hours:g}", row) for row in marked]
    named += [(f"followers {n}", row) for n, row in zip(FOLLOWERS, by_followers, strict=True)]
    lines = [
        f"{'':<11} {'median':>8} {'99 %':>7} {'leader':>7} {'follower':>9}",
        f"{'':<11} {'ms':>8} {'ms':>7} {'s/min':>7} {'s/min':>9}",
    ]
    for name, row in named:
        median, p99, *_ = row.steps_ms
        cpu = f"{row.leader_cpu_s:7.2f} {row.follower_cpu_s:9.2f}"
        lines.append(f"{name:<11} {median:8.2f} {p99:7.1f} {cpu}")
    return "\n".join(lines)


def draw(by_hour: list[Row], by_followers: list[Row], path: Path) -> None:
    """Draw the leader's steps above and CPU below, over hours to the left, followers to the right.

    Steps are logarithmic: their 99 % is hundreds of times their median.
    """
    figure, axes = plt.subplots(
        2, 2, figsize=(10.0, 6.5), sharex="col", sharey="row", layout="constrained"
    )
    hours = [row.hours for row in by_hour]
    for column, at, rows in ((0, hours, by_hour), (1, FOLLOWERS, by_followers)):
        steps, cpu = axes[:, column]
        for k, name in ((1, "99 %"), (0, "median")):
            steps.semilogy(at, [row.steps_ms[k] for row in rows], "o-", ms=4, label=name)
        cpu.plot(at, [row.leader_cpu_s for row in rows], "o-", ms=4, label="leader")
        cpu.plot(at, [row.follower_cpu_s for row in rows], "o-", ms=4, label="follower")
    axes[0, 0].set(title="one mission, hour by hour", ylabel="leader's step (ms of one core)")
    axes[0, 0].yaxis.set_major_formatter("{x:g}")
    axes[0, 1].set(title=f"missions of {by_followers[-1].hours:g} h, by followers")
    axes[1, 0].set(xlabel="end of the hour (h)", xlim=(0.0, None), ylim=(0.0, None))
    axes[1, 0].set(ylabel="CPU (s per minute of the mission)")
    axes[1, 1].set(xlabel="followers", xticks=FOLLOWERS)
    for panel in axes.flat:
        panel.grid(alpha=0.3)
    for panel in axes[:, 0]:
        panel.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def main() -> None:
    """Run the missions; print an hour a line as they go, then the table, and draw it."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cost", description=__doc__)
    add_survey_arguments(parser)
    add_seed_argument(parser)
    parser.set_defaults(scenario="day-1")
    parser.add_argument("--hours", type=float, default=3.0)
    parser.add_argument("--follower-hours", type=float, default=1.0)
    parser.add_argument("--plot", type=Path, default=Path("out/cost.png"), help="a .png or .svg")
    arguments = parser.parse_args()
    settings = settings_of(arguments)
    print(HEAD)
    by_hour, _ = mission(lasting(settings, arguments.hours), arguments.terrain, arguments.seed)
    by_followers = []
    for followers in FOLLOWERS:
        crew = lasting(changed(settings, {"followers": followers}), arguments.follower_hours)
        rows, _ = mission(crew, arguments.terrain, arguments.seed)
        by_followers.append(rows[-1])
    print(table(by_hour, by_followers))
    draw(by_hour, by_followers, arguments.plot)


if __name__ == "__main__":
    sys.exit(status_of("benchmarks.cost", main))
