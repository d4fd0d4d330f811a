"""Which pairs of sub-maps are worth a match."""

from unittest.mock import MagicMock

import numpy as np
import pytest

from firmware.leader.closure_settings import ClosureSettings
from firmware.leader.drifts import NO_DRIFT
from firmware.leader.match_jobs import _may_hint, _worth_trying
from firmware.leader.offsets import Offset

SETTINGS = ClosureSettings(
    pairs_per_submap=6, known_pairs_per_submap=2, known_sigma_m=2.0, hint_prior_m=3.0
)


@pytest.mark.parametrize(
    ("sigma_m", "apart_m", "tried"), [(1.0, 0.0, 2), (9.0, 0.0, 6), (9.0, 8.9, 2)]
)
def test_few_pairs_of_which_a_match_can_tell_no_more_are_tried(
    sigma_m: float, apart_m: float, tried: int
) -> None:
    """The ways within the composed past stay as they are, however often places are matched."""
    assert len(_worth_trying([_offset(sigma_m, apart_m)] * 8, SETTINGS)) == tried


@pytest.mark.parametrize(
    ("sigma_m", "vehicles", "may"),
    [(9.0, (1, 1), True), (9.0, (0, 1), False), (1.0, (1, 1), False)],
)
def test_hints_come_of_what_one_vehicle_saw_twice(
    sigma_m: float, vehicles: tuple[int, int], *, may: bool
) -> None:
    """How two vehicles' passes tilt against each other is unknown, and leads far astray."""
    assert _may_hint(_offset(sigma_m, 0.0, vehicles), SETTINGS) is may


def _offset(sigma_m: float, apart_m: float, vehicles: tuple[int, int] = (1, 1)) -> Offset:
    return Offset(
        origin=MagicMock(**{"id.vehicle": vehicles[0]}),
        target=MagicMock(**{"id.vehicle": vehicles[1]}),
        shift_m=np.zeros(2),
        covariance_m2=sigma_m**2 * np.eye(2),
        apart_m2=apart_m**2 * np.eye(2),
        drifts=NO_DRIFT,
    )
