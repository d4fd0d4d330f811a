"""Where a surveying vehicle truly is: lines, half-circle turns, and a drift about the end."""

from dataclasses import dataclass

import numpy as np

from firmware.geometry import Array
from host_tools.scenario import ScenarioSettings

GOLDEN = 0.6180339887498949

# Per vehicle: direction of the lines (north, east), direction of stepping, and the first corner as
# (share of the leg, share of the corner offset) north and east. The leader's lines run north, the
# first follower's across them; the others interleave, each with tracks of its own.
_PATTERNS: tuple[
    tuple[tuple[int, int], tuple[int, int], tuple[float, float, float, float]], ...
] = (
    ((1, 0), (0, 1), (0.0, 0.0, 0.0, 0.0)),
    ((0, 1), (1, 0), (0.0, 1.0, 0.0, 1.0)),
    ((0, -1), (-1, 0), (1.0, -0.5, 1.0, -0.5)),
    ((-1, 0), (0, -1), (1.0, -1.0, 1.0, -1.0)),
    ((0, -1), (1, 0), (0.0, 0.5, 1.0, 0.0)),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Path:
    """Positions and headings by time; every array is (T,), exact at the instants asked for."""

    north_m: Array
    east_m: Array
    yaw_rad: Array


class Turned:
    """A path that is left at some instant for a straight line; the turn itself takes no time."""

    def __init__(
        self, path: "Lawnmower | Turned", from_s: float, heading_rad: float, speed_mps: float
    ) -> None:
        self._path, self._from_s, self._heading_rad = path, from_s, heading_rad
        self._velocity_mps = speed_mps * np.array([np.cos(heading_rad), np.sin(heading_rad)])

    def at(self, time_s: Array | float) -> Path:
        """Return the path at the times (T,)."""
        time_s = np.atleast_1d(np.asarray(time_s, dtype=np.float64))
        before = self._path.at(np.minimum(time_s, self._from_s))
        after_s = np.maximum(time_s - self._from_s, 0.0)
        return Path(
            north_m=before.north_m + after_s * self._velocity_mps[0],
            east_m=before.east_m + after_s * self._velocity_mps[1],
            yaw_rad=np.where(after_s > 0.0, self._heading_rad, before.yaw_rad),
        )


class Lawnmower:
    """The true horizontal path of one vehicle as a function of time.

    Straight lines of leg_m are joined by half circles. When the block is done it is surveyed
    again, backwards, on shifted lines. After survey_s the vehicle drifts about its end point.
    """

    def __init__(self, scenario: ScenarioSettings, vehicle: int, rng: np.random.Generator) -> None:
        self._scenario = scenario
        self._survey_s = scenario.survey_s(vehicle)
        along, across, corner = _PATTERNS[vehicle]
        self._along = np.array(along, dtype=np.float64)
        self._across = np.array(across, dtype=np.float64)
        self._corner_m = np.array(
            [
                corner[0] * scenario.leg_m + corner[1] * scenario.corner_offset_m,
                corner[2] * scenario.leg_m + corner[3] * scenario.corner_offset_m,
            ]
        )
        self._lines_m = _line_positions(scenario, self._survey_s * scenario.speed_mps)
        radii_m = np.abs(np.diff(self._lines_m)) / 2.0
        self._starts_m = np.concatenate([[0.0], np.cumsum(scenario.leg_m + np.pi * radii_m)])
        self._phases = rng.uniform(0.0, 2.0 * np.pi, 4)

    def at(self, time_s: Array | float) -> Path:
        """Return the path at the times (T,)."""
        time_s = np.atleast_1d(np.asarray(time_s, dtype=np.float64))
        survey = self._survey(np.minimum(time_s, self._survey_s) * self._scenario.speed_mps)
        after_s = np.maximum(time_s - self._survey_s, 0.0)
        if not np.any(after_s > 0.0):
            return survey
        wander_m, turn_rad = self._wander(after_s)
        return Path(
            north_m=survey.north_m + wander_m[:, 0],
            east_m=survey.east_m + wander_m[:, 1],
            yaw_rad=survey.yaw_rad + turn_rad,
        )

    def _survey(self, travelled_m: Array) -> Path:
        leg_m = self._scenario.leg_m
        line = np.searchsorted(self._starts_m, travelled_m, side="right") - 1
        line = np.minimum(line, len(self._lines_m) - 2)
        rest_m = travelled_m - self._starts_m[line]
        forward = np.where(line % 2 == 0, 1.0, -1.0)
        step_m = self._lines_m[line + 1] - self._lines_m[line]
        angle = np.clip(rest_m - leg_m, 0.0, None) / (np.abs(step_m) / 2.0)
        straight_m = np.minimum(rest_m, leg_m)
        u_m = np.where(forward > 0, straight_m, leg_m - straight_m)
        u_m = u_m + forward * np.abs(step_m) / 2.0 * np.sin(angle)
        v_m = self._lines_m[line] + step_m / 2.0 * (1.0 - np.cos(angle))
        du, dv = forward * np.cos(angle), np.sign(step_m) * np.sin(angle)
        position_m = self._corner_m + np.outer(u_m, self._along) + np.outer(v_m, self._across)
        heading = np.outer(du, self._along) + np.outer(dv, self._across)
        return Path(
            north_m=position_m[:, 0],
            east_m=position_m[:, 1],
            yaw_rad=np.arctan2(heading[:, 1], heading[:, 0]),
        )

    def _wander(self, after_s: Array) -> tuple[Array, Array]:
        """Return displacement (T, 2) and turn (T,) of a slow drift that begins at rest."""
        rise = 1.0 - np.exp(-after_s / 60.0)
        periods_s = (210.0, 330.0, 270.0, 410.0)
        waves = [
            np.sin(2.0 * np.pi * after_s / period_s + phase) - np.sin(phase)
            for period_s, phase in zip(periods_s, self._phases, strict=True)
        ]
        radius_m = self._scenario.wander_m / 4.0
        wander_m = (
            radius_m * rise[:, None] * np.stack([waves[0] + waves[1], waves[2] + waves[3]], 1)
        )
        return wander_m, rise * (waves[1] + waves[2])


def _line_positions(scenario: ScenarioSettings, length_m: float) -> Array:
    """Return the across-track position of every line that a path of length_m can reach.

    Passes over the block alternate in direction; pass p is shifted by a golden-ratio fraction of
    the largest shift, so that lines of a long mission spread evenly over the block. The shift
    never asks for a turn tighter than the vehicle can make.
    """
    spacing_m = scenario.line_spacing_m
    most_m = min(scenario.resurvey_shift_share * spacing_m, spacing_m - scenario.turn_diameter_m)
    count = int(length_m / scenario.leg_m) + 3
    lines_m: list[float] = []
    lap = 0
    while len(lines_m) < count:
        shift_m = most_m * ((lap * GOLDEN) % 1.0)
        order = range(scenario.lines) if lap % 2 == 0 else range(scenario.lines - 1, -1, -1)
        for line in list(order)[1 if lap else 0 :]:
            lines_m.append(line * spacing_m + shift_m)
        lap += 1
    return np.array(lines_m[:count])
