"""Offsets of sheets as the estimate has them."""

import dataclasses
from unittest.mock import MagicMock

import numpy as np
import pytest

from firmware.leader.offsets import Offsets
from firmware.leader.pose_graph import PoseGraph
from tests.leader.sheets import northward, sheet_at, two_sheets


@pytest.fixture
def graph() -> PoseGraph:
    return northward()


def test_what_is_taken_out_of_an_offset_leaves_the_composed_past_as_unsure_as_it_was(
    graph: PoseGraph,
) -> None:
    (offset,) = Offsets(graph).of([two_sheets()])
    apart_m2, told_m2 = np.diag([30.0, 50.0]), np.array([[20.0, 5.0], [5.0, 40.0]])
    open_m2, told_m = offset.covariance_m2, np.array([7.0, -4.0])
    both_m2 = np.linalg.inv(np.linalg.inv(open_m2) + np.linalg.inv(told_m2))
    met_m = both_m2 @ (np.linalg.solve(open_m2, offset.shift_m) + np.linalg.solve(told_m2, told_m))
    told = dataclasses.replace(
        offset, shift_m=met_m, covariance_m2=both_m2 + apart_m2, apart_m2=apart_m2
    )
    left = told.without(told_m, told_m2)
    assert left.shift_m == pytest.approx(offset.shift_m, abs=1e-6)
    assert left.covariance_m2 == pytest.approx(open_m2 + apart_m2)
    assert left.open_sigma_m == pytest.approx(offset.sigma_m)


def test_pairs_with_a_sheet_on_no_node_are_left_out_and_ways_to_nodes_add_up(
    graph: PoseGraph,
) -> None:
    first, second = two_sheets()
    lost = dataclasses.replace(first, id=dataclasses.replace(first.id, vehicle=1))
    assert Offsets(graph).of([(lost, second)]) == []
    graph.lose(0, 19.0, 23.0)
    graph.lose(0, 101.0, 107.0)
    (offset,) = Offsets(graph).of([(first, lost), (first, second)])
    assert (offset.origin, offset.target) == (first, second)
    ways_m2 = [graph.anchor(0, sheet.time_s, sheet.track).apart_m2 for sheet in (first, second)]
    assert ways_m2[0][0, 0] > ways_m2[1][0, 0] > 0.0
    assert offset.apart_m2 == pytest.approx(ways_m2[0] + ways_m2[1])


def test_sheets_expected_to_be_asked_for_share_the_first_covariance(
    graph: PoseGraph, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = two_sheets()
    third = dataclasses.replace(first, id=dataclasses.replace(first.id, submap=7), time_s=50.0)
    (alone,) = Offsets(graph).of([(first, second)])
    asked = MagicMock(side_effect=graph.state_covariance)
    monkeypatch.setattr(graph, "state_covariance", asked)
    shared = Offsets(graph, expected=[first, second])
    shared.of([(third, second)])
    (offset,) = shared.of([(first, second)])
    assert asked.call_count == 1
    assert offset.covariance_m2 == pytest.approx(alone.covariance_m2, rel=1e-9)
    shared.of([(sheet_at(8, 70.0), second)])
    assert asked.call_count == 2


def test_offset_tells_drift_as_the_time_between_the_sheets_says(graph: PoseGraph) -> None:
    origin, target = two_sheets()
    (offset,) = Offsets(graph).of([(origin, target)])
    apart_s, known_m2 = target.time_s - origin.time_s, offset.covariance_m2
    assert offset.drifts.gain == pytest.approx(np.tile(-np.eye(2) / apart_s, (2, 1)), rel=0.1)
    drifts = offset.drifts.covariance(known_m2)
    assert np.diag(drifts) == pytest.approx(np.full(4, 0.2**2), rel=0.1)
    assert np.trace(offset.drifts.left) < 0.1 * np.trace(drifts)
