"""Proposals: towards known relief, never for nothing, and with honest promises."""

import dataclasses

import numpy as np
import pytest

from firmware.geometry import Array
from firmware.leader import outlook
from firmware.leader.calibration import CalibrationSettings
from firmware.leader.manoeuvre import (
    Ground,
    ManoeuvreSettings,
    Situation,
    expected_m,
    propose,
    relief_information,
)
from firmware.leader.wander import Wandering
from tests.leader.vessels import sailed

SETTINGS = ManoeuvreSettings()
FLOOR_M, REDUNDANCY = SETTINGS.closure_floor_m, CalibrationSettings().redundancy
WANDERING = Wandering(noise=0.2, walk=0.002, apart=0.0007)


def lost(*ground: tuple[float, float], tells: Array | None = None) -> Situation:
    """Return two vehicles 300 m apart that sail north, 20 m unsure, and known ground."""
    told = 4.0 * np.eye(2) if tells is None else tells
    states = np.tile([400.0, 400.0, 1e-4, 1e-4], 2)
    return Situation(
        names=("leader", "follower 1"),
        positions_m=np.array([[0.0, 0.0], [0.0, 300.0]]),
        velocities_mps=np.array([[2.0, 0.0], [2.0, 0.0]]),
        ground=tuple(Ground(position_m=np.array(g), information=told) for g in ground),
        joint=np.diag([*states, *([1.0] * 2 * len(ground))]),
        wandering=WANDERING,
    )


def test_vehicle_is_sent_to_the_ground_that_is_known() -> None:
    found = propose(lost((-400.0, 0.0)), SETTINGS)
    assert found is not None
    assert (found.name, found.heading_deg) == ("leader", 180.0)
    assert found.sigma_m < 0.8 * found.otherwise_m
    assert "leader steers 180 degrees" in str(found)


def test_vehicle_that_can_get_there_goes() -> None:
    found = propose(lost((0.0, 1400.0)), SETTINGS)
    assert found is not None
    assert (found.vehicle, found.heading_deg) == (1, 90.0)


def test_flat_ground_is_not_worth_the_way() -> None:
    flat = relief_information(np.full((30, 40), 50.0), 2.0, 0.02, REDUNDANCY, FLOOR_M)
    assert propose(lost((-400.0, 0.0), tells=flat), SETTINGS) is None
    assert propose(lost(), SETTINGS) is None


def test_ground_that_is_crossed_anyway_needs_no_proposal() -> None:
    assert propose(lost((400.0, 0.0), (400.0, 300.0)), SETTINGS) is None


def test_relief_tells_along_its_slopes_only() -> None:
    ridges_m = 50.0 + np.sin(np.arange(60) / 4.0)[:, None] * np.ones((60, 40))
    told = relief_information(ridges_m, 2.0, 0.02, REDUNDANCY, FLOOR_M)
    assert told[0, 0] > 1.0
    assert told[1, 1] < 1e-6
    assert told[0, 0] <= FLOOR_M**-2


def test_holes_in_a_grid_tell_nothing() -> None:
    depth_m = np.random.default_rng(1).normal(50.0, 1.0, (30, 30))
    holed = depth_m.copy()
    holed[:, 15:] = np.nan
    whole, half = (relief_information(d, 2.0, 0.02, REDUNDANCY, FLOOR_M) for d in (depth_m, holed))
    assert np.trace(half) < np.trace(whole)


@pytest.mark.parametrize("shape", [(1, 40), (40, 1), (1, 1)])
def test_single_row_of_cells_tells_nothing(shape: tuple[int, int]) -> None:
    told = relief_information(np.full(shape, 50.0), 2.0, 0.02, REDUNDANCY, FLOOR_M)
    np.testing.assert_array_equal(told, np.zeros((2, 2)))
    assert propose(lost((-400.0, 0.0), tells=told), SETTINGS) is None


def test_remark_that_cannot_be_made_is_logged_and_raises_nothing(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fails(*_: object) -> None:
        raise ValueError("a bug")

    leader = sailed(50.0)
    for part in ("observe", "propose"):
        monkeypatch.setattr(outlook, part, fails)
    assert leader.outlook.observe(50.0) is None
    assert leader.outlook.propose() is None
    assert caplog.text.count("ValueError: a bug") == 2


def test_expected_sigma_without_measurements_is_that_of_dead_reckoning() -> None:
    alone = dataclasses.replace(
        lost(),
        names=("leader",),
        positions_m=np.zeros((1, 2)),
        velocities_mps=np.ones((1, 2)),
        joint=np.diag([400.0, 400.0, 1e-4, 1e-4]),
    )
    t = SETTINGS.horizon_s
    walk = (WANDERING.walk**2 + WANDERING.apart**2) * t**3 / 3
    expected = np.sqrt(400.0 + 1e-4 * t**2 + WANDERING.noise**2 * t + walk)
    assert expected_m(alone, alone.velocities_mps, SETTINGS) == pytest.approx(expected, rel=0.02)
