"""Which mission a process takes part in, and how processes know that they mean the same one."""

import argparse
import hashlib
import json
from dataclasses import dataclass

from host_tools.commands import add_seed_argument, add_survey_arguments, settings_of
from host_tools.mission_settings import MissionSettings
from host_tools.simulator.placement import Site, place_survey
from host_tools.simulator.terrain import open_terrain
from protocol.settings import flatten


@dataclass(frozen=True, slots=True, kw_only=True)
class Voyage:
    """A mission to be: settings, seabed, seed, and the arguments that mean it."""

    settings: MissionSettings
    site: Site
    seed: int
    arguments: tuple[str, ...]

    @property
    def tick_s(self) -> float:
        """The period of all loops."""
        return self.settings.scenario.tick_s

    @property
    def fingerprint(self) -> str:
        """The same for two processes only if they mean the same mission."""
        raster, datum = self.site.raster, self.site.datum
        meant = [
            [[key, repr(value)] for key, value, *_ in flatten(self.settings)],
            [self.seed, raster.rows, raster.columns, raster.crs_wkt],
            [datum.origin_north_m, datum.origin_east_m, datum.depth_shift_m],
        ]
        return hashlib.sha256(json.dumps(meant).encode()).hexdigest()[:16]


def voyage_of(arguments: argparse.Namespace) -> Voyage:
    """Return the mission that the arguments of a command mean.

    Raises
    ------
    ConfigError
        For settings or a terrain that cannot be.
    """
    settings = settings_of(arguments)
    terrain = open_terrain(arguments.terrain, settings.scenario.relief_seed)
    return Voyage(
        settings=settings,
        site=place_survey(terrain, settings.scenario, arguments.seed),
        seed=arguments.seed,
        arguments=_as_given(arguments),
    )


def add_voyage_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that a mission of processes is meant by."""
    add_survey_arguments(parser)
    add_seed_argument(parser)


def _as_given(arguments: argparse.Namespace) -> tuple[str, ...]:
    """Return the arguments that make another process mean the same mission."""
    given = ["--scenario", arguments.scenario, "--seed", str(arguments.seed)]
    given += ["--profile", arguments.profile]
    if arguments.terrain is not None:
        given += ["--terrain", str(arguments.terrain)]
    if arguments.loss is not None:
        given += ["--loss", str(arguments.loss)]
    for change in arguments.changes:
        given += ["--set", change]
    return tuple(given)
