"""Which way to go so that the vehicles learn most of where they are.

A candidate is one vehicle that keeps a heading for a while; all others go on as they do. Along it
the joint covariance of the vehicles' newest states and of known ground is carried forward: it grows
by dead reckoning, and shrinks by ranges, according to their geometry then, and by closures with the
ground on the way, according to its relief. That takes no measurements, only the places where they
will be made: it is the expected covariance of a linear filter (by which Davison and Murray, PAMI
2002, choose where to look).
"""

from dataclasses import dataclass

import numpy as np

from firmware.geometry import Array
from firmware.leader.observability import STATE
from firmware.leader.wander import Wandering
from protocol.settings import Settings, setting


@dataclass(frozen=True, slots=True, kw_only=True)
class ManoeuvreSettings(Settings):
    """How far ahead candidates are judged, and what is expected there."""

    horizon_s: float = setting(600.0, "s", "the length of a manoeuvre", minimum=60.0)
    step_s: float = setting(20.0, "s", "between predicted measurements", minimum=5.0)
    headings: int = setting(16, "", "tried, all around", minimum=4, maximum=72)
    reach_m: float = setting(
        50.0, "m", "from a sub-map's middle, where tracks overlap", minimum=5.0
    )
    range_sigma_m: float = setting(2.0, "m", "of a predicted range", minimum=0.1)
    closure_floor_m: float = setting(0.4, "m", "no closure tells more", minimum=0.01)
    worth: float = setting(
        0.8, "1", "of the uncertainty without it that a proposed manoeuvre may leave", minimum=0.01
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Ground:
    """A sub-map that may be crossed: where, and what a match would tell (2, 2) in 1/m^2."""

    position_m: Array
    information: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Situation:
    """Where V vehicles are and go, (V, 2) each, and the ground G that is known.

    joint (4V + 2G, 4V + 2G) is the covariance of the newest states, then of the ground's positions.
    """

    names: tuple[str, ...]
    positions_m: Array
    velocities_mps: Array
    ground: tuple[Ground, ...]
    joint: Array
    wandering: Wandering


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposal:
    """A heading for one vehicle; sigmas are the root mean square over all vehicles' positions.

    going_on_deg are the headings of all vehicles as they go now, by the estimate.
    """

    vehicle: int  # its place among the situation's
    name: str
    heading_deg: float
    going_on_deg: tuple[float, ...]
    minutes: float
    sigma_m: float
    otherwise_m: float

    def __str__(self) -> str:
        return (
            f"proposed: {self.name} steers {self.heading_deg:03.0f} degrees for {self.minutes:.0f} "
            f"minutes; positions would be known to {self.sigma_m:.1f} m instead of "
            f"{self.otherwise_m:.1f} m"
        )


def propose(situation: Situation, settings: ManoeuvreSettings) -> Proposal | None:
    """Return the candidate that leaves least uncertainty, or None if none is worth the way."""
    otherwise_m = expected_m(situation, situation.velocities_mps, settings)
    north_mps, east_mps = situation.velocities_mps.T
    going_on_deg = tuple(np.degrees(np.arctan2(east_mps, north_mps)).tolist())
    best: Proposal | None = None
    for vehicle, name in enumerate(situation.names):
        speed_mps = float(np.hypot(*situation.velocities_mps[vehicle]))
        for heading_deg in np.arange(settings.headings) * 360.0 / settings.headings:
            angle = np.radians(heading_deg)
            velocities_mps = situation.velocities_mps.copy()
            velocities_mps[vehicle] = speed_mps * np.array([np.cos(angle), np.sin(angle)])
            sigma_m = expected_m(situation, velocities_mps, settings)
            if sigma_m < (settings.worth * otherwise_m if best is None else best.sigma_m):
                best = Proposal(
                    vehicle=vehicle,
                    name=name,
                    heading_deg=float(heading_deg),
                    going_on_deg=going_on_deg,
                    minutes=settings.horizon_s / 60.0,
                    sigma_m=sigma_m,
                    otherwise_m=otherwise_m,
                )
    return best


def expected_m(situation: Situation, velocities_mps: Array, settings: ManoeuvreSettings) -> float:
    """Return the root mean square sigma of all positions after the horizon, each axis."""
    vehicles, step_s = len(situation.names), settings.step_s
    covariance, positions_m = situation.joint, situation.positions_m
    forward, noise = _dead_reckoning(vehicles, situation, step_s)
    met: set[tuple[int, int]] = set()
    for _ in range(round(settings.horizon_s / step_s)):
        positions_m = positions_m + velocities_mps * step_s
        covariance = forward @ covariance @ forward.T + noise
        for k in range(1, vehicles):
            row, apart_m = np.zeros((1, len(covariance))), positions_m[k] - positions_m[0]
            row[0, STATE * k : STATE * k + 2] = apart_m / max(float(np.hypot(*apart_m)), 1.0)
            row[0, :2] = -row[0, STATE * k : STATE * k + 2]
            covariance = _measured(covariance, row, np.array([[settings.range_sigma_m**-2]]))
        for k in range(vehicles):
            place = _crossed(situation, positions_m[k], settings)
            if place is None or (k, place) in met:
                continue
            met.add((k, place))
            rows = np.zeros((2, len(covariance)))
            rows[:, STATE * k : STATE * k + 2] = np.eye(2)
            at = STATE * vehicles + 2 * place
            rows[:, at : at + 2] = -np.eye(2)
            covariance = _measured(covariance, rows, situation.ground[place].information)
    axes = np.concatenate([STATE * k + np.arange(2) for k in range(vehicles)])
    return float(np.sqrt(np.mean(np.diag(covariance)[axes])))


def relief_information(
    depth_m: Array, cell_m: float, variance_m2: float, redundancy: float, floor_m: float
) -> Array:
    """Return what a match on half of a grid (R, C) would tell of a shift, (2, 2) in 1/m^2.

    Each cell tells along its slope; as many as the redundancy err together, and no match is better
    than the floor. A single row or column has no slopes.
    """
    if min(depth_m.shape) < 2:
        return np.zeros((2, 2))
    north, east = np.gradient(depth_m, cell_m)
    slopes = np.stack([north.ravel(), east.ravel()])
    slopes = slopes[:, np.isfinite(slopes).all(axis=0)]
    told = 0.5 * (slopes @ slopes.T) / (2.0 * variance_m2 * redundancy)
    values, axes = np.linalg.eigh(told)
    values = 1.0 / (1.0 / np.maximum(values, 1e-9) + floor_m**2)
    return np.asarray((axes * values) @ axes.T)


def _dead_reckoning(vehicles: int, situation: Situation, step_s: float) -> tuple[Array, Array]:
    size, wandering = len(situation.joint), situation.wandering
    forward, noise = np.eye(size), np.zeros((size, size))
    biases = [slice(STATE * k + 2, STATE * k + 4) for k in range(vehicles)]
    for k, bias in enumerate(biases):
        position = slice(STATE * k, STATE * k + 2)
        forward[position, bias] = -step_s * np.eye(2)
        noise[position, position] = wandering.noise**2 * step_s * np.eye(2)
        for other in biases:
            noise[bias, other] = wandering.walk**2 * step_s * np.eye(2)
        noise[bias, bias] += wandering.apart**2 * step_s * np.eye(2)
    return forward, noise


def _measured(covariance: Array, rows: Array, information: Array) -> Array:
    """Return the covariance (N, N) after a measurement by rows (M, N) of some information."""
    root = np.linalg.cholesky(information + 1e-12 * np.eye(len(information)))
    whitened = root.T @ rows
    cross = covariance @ whitened.T
    gain = np.linalg.solve(whitened @ cross + np.eye(len(rows)), cross.T)
    return np.asarray(covariance - cross @ gain)


def _crossed(situation: Situation, position_m: Array, s: ManoeuvreSettings) -> int | None:
    if not situation.ground:
        return None
    apart_m = np.hypot(*(np.array([g.position_m for g in situation.ground]) - position_m).T)
    nearest = int(np.argmin(apart_m))
    return nearest if apart_m[nearest] <= s.reach_m else None
