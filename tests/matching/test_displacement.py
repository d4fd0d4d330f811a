"""Roll and refraction move what a sonar sees aside; closures are told where it really lay."""

import dataclasses
import math

import numpy as np
import pytest

from firmware.leader.displacement import Look, displaced

ALTITUDE_M = 40.0
HALF_WIDTH_M = ALTITUDE_M * math.tan(math.radians(60.0))
ROLL_RAD, FASTER = math.radians(0.2), 2.0 / 1500.0  # sonar head, and sound against what is assumed
STARBOARD = np.array([0.0, 1.0])


def _seen_across_m(true_m: float) -> float:
    """Return where a sonar sees a flat seabed that lies so far across its track."""
    slant_m, angle = math.hypot(true_m, ALTITUDE_M), math.atan2(true_m, ALTITUDE_M)
    steered = math.asin(math.sin(angle + ROLL_RAD) / (1.0 + FASTER))
    return slant_m / (1.0 + FASTER) * math.sin(steered)


def _look(starboard: np.ndarray, vehicle: int = 1, sigma: float = 1e-4) -> Look:
    smile = FASTER * HALF_WIDTH_M / ALTITUDE_M
    return Look(
        vehicle=vehicle,
        starboard=starboard,
        altitude_m=ALTITUDE_M,
        half_width_m=HALF_WIDTH_M,
        errors=np.array([-ROLL_RAD, smile]),
        covariance=sigma**2 * np.eye(2),
    )


@pytest.mark.parametrize("true_m", [10.0, 30.0, -30.0, -50.0])
def test_lines_of_opposite_heading_are_as_far_apart_as_they_are(true_m: float) -> None:
    seen_m = _seen_across_m(true_m)
    levers = (seen_m * STARBOARD, -seen_m * STARBOARD)
    added_m, _ = displaced((_look(STARBOARD), _look(-STARBOARD)), levers)
    seemed_m = levers[0] - levers[1]
    assert abs(seemed_m[1] - 2.0 * true_m) > 0.1
    assert (seemed_m + added_m)[1] == pytest.approx(2.0 * true_m, abs=0.03)


def test_one_vehicle_on_the_same_line_again_errs_alike() -> None:
    look, lever_m = _look(STARBOARD), 30.0 * STARBOARD
    added_m, left_m2 = displaced((look, look), (lever_m, lever_m))
    assert added_m == pytest.approx(np.zeros(2))
    assert left_m2 == pytest.approx(np.zeros((2, 2)))


def test_what_is_not_known_of_two_sonars_adds_up() -> None:
    lever_m, looks = 30.0 * STARBOARD, (_look(STARBOARD), _look(STARBOARD, vehicle=2))
    _, left_m2 = displaced(looks, (lever_m, lever_m))
    across = 30.0 / HALF_WIDTH_M
    alone_m2 = (1e-4 * ALTITUDE_M) ** 2 * (1.0 + 4.0 * across**2)
    assert left_m2[1, 1] == pytest.approx(2.0 * alone_m2)
    assert left_m2[0, 0] == pytest.approx(0.0)


def test_each_sonar_errs_by_itself() -> None:
    """One that errs sees a place to port of another one that does not."""
    erring = _look(STARBOARD)
    right = dataclasses.replace(
        _look(STARBOARD, vehicle=2), errors=np.zeros(2), covariance=np.zeros((2, 2))
    )
    seen_m, true_m = _seen_across_m(30.0) * STARBOARD, -20.0 * STARBOARD
    alone_m2 = (1e-4 * ALTITUDE_M) ** 2 * (1.0 + 4.0 * (30.0 / HALF_WIDTH_M) ** 2)
    for looks, levers in (((erring, right), (seen_m, true_m)), ((right, erring), (true_m, seen_m))):
        added_m, left_m2 = displaced(looks, levers)
        apart_m = (levers[0] - levers[1] + added_m)[1]
        assert abs(apart_m) == pytest.approx(50.0, abs=0.03)
        assert left_m2[1, 1] == pytest.approx(alone_m2, rel=0.05)


def test_what_is_not_known_of_one_sonar_counts_twice_between_opposite_headings() -> None:
    lever_m = 30.0 * STARBOARD
    _, left_m2 = displaced((_look(STARBOARD), _look(-STARBOARD)), (lever_m, -lever_m))
    alone_m2 = (1e-4 * ALTITUDE_M) ** 2 * (1.0 + 4.0 * (30.0 / HALF_WIDTH_M) ** 2)
    assert left_m2 == pytest.approx(np.diag([0.0, 4.0 * alone_m2]))


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_nothing_is_moved_farther_than_at_the_edge_of_the_swath(side: float) -> None:
    edge_m, look = side * HALF_WIDTH_M * STARBOARD, _look(STARBOARD)
    assert look.displacement(3.0 * edge_m) == pytest.approx(look.displacement(edge_m))
    assert look.displacement(0.9 * edge_m) != pytest.approx(look.displacement(edge_m))
