"""All subcommands of `fathomlink`: reads arguments, calls the module that does the work."""

import argparse
from collections.abc import Sequence
from typing import NoReturn

from threadpoolctl import threadpool_limits

from host_tools import (
    compress_files,
    config_show,
    inspector,
    link_status,
    reproduce,
    simulate,
)
from host_tools.commands import BAD_INPUT, Command, status_of
from host_tools.emulators import emulate
from host_tools.faults import command as faults
from host_tools.processes import channel, demo, vehicle
from host_tools.replay import gsf

COMMANDS: tuple[Command, ...] = (
    simulate.COMMAND,
    demo.COMMAND,
    channel.COMMAND,
    vehicle.FOLLOWER,
    vehicle.LEADER_COMMAND,
    reproduce.COMMAND,
    compress_files.COMPRESS,
    compress_files.RECONSTRUCT,
    emulate.COMMAND,
    faults.COMMAND,
    gsf.COMMAND,
    inspector.COMMAND,
    link_status.COMMAND,
    config_show.COMMAND,
)


class OneLineParser(argparse.ArgumentParser):
    """A parser whose complaint is one line, without the usage; each subcommand makes its own."""

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Read the arguments; exit with status 2 for one that is unknown."""
        known, unknown = super().parse_known_args(args, namespace or argparse.Namespace())
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return known, unknown

    def error(self, message: str) -> NoReturn:
        """Exit with status 2 and the message."""
        self.exit(BAD_INPUT, f"{self.prog}: {message} (try {self.prog} --help)\n")


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all subcommands."""
    parser = OneLineParser(
        prog="fathomlink",
        description="Cooperative bathymetric SLAM over a 1 kbit/s acoustic link.",
    )
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command in COMMANDS:
        subparser = subparsers.add_parser(command.name, help=command.help, description=command.help)
        command.configure(subparser)
        subparser.set_defaults(run=command.run)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one subcommand; return 0, or 2 with one line on stderr that says what is wrong."""
    parsed = build_parser().parse_args(arguments)
    with threadpool_limits(1):  # so that the same seed gives the same bytes
        return status_of("fathomlink", lambda: parsed.run(parsed))
