"""`fathomlink emulate`: modems on pseudo-terminals, in real time, until interrupted."""

import argparse
from functools import partial

from host_tools.commands import Command, count, seed
from host_tools.emulators.run import KINDS, EmulationSettings, emulate


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("kind", choices=KINDS, help="the dialect that the modems speak")
    parser.add_argument(
        "--nodes", type=count, default=2, metavar="N", help="how many modems; default: %(default)s"
    )
    parser.add_argument(
        "--range",
        type=float,
        default=500.0,
        metavar="M",
        help="metres between neighbours; default: %(default)g",
    )
    parser.add_argument(
        "--seed", type=seed, default=1, metavar="N", help="of loss and noise; default: %(default)s"
    )


def _run(arguments: argparse.Namespace) -> None:
    emulate(
        EmulationSettings(
            kind=arguments.kind,
            nodes=arguments.nodes,
            range_m=arguments.range,
            seed=arguments.seed,
        ),
        say=partial(print, flush=True),
    )


COMMAND = Command(
    name="emulate",
    help="be Micro-Modems or Nanomodems on ports of this computer",
    configure=_configure,
    run=_run,
)
