"""What ranges and closures tell, and what they leave open, by the graph's own covariances."""

import dataclasses

import numpy as np
import pytest

from firmware.leader.graph_settings import GraphSettings
from firmware.leader.observability import Observability, observe
from firmware.leader.pose_graph import PoseGraph
from firmware.submaps import Track

SECONDS, APART_M = 900, 400.0


def graph_of(*, ranges: bool, closures: bool) -> PoseGraph:
    """Return two vehicles that sail north side by side, the second one to the east."""
    time_s = np.arange(SECONDS + 1.0)
    graph = PoseGraph(GraphSettings())
    tracks = [
        Track(time_s=time_s, north_m=2 * time_s, east_m=0 * time_s + east_m, yaw_rad=0 * time_s)
        for east_m in (0.0, APART_M)
    ]
    for vehicle, track in enumerate(tracks):
        start_m = track.position_at(0.0)
        graph.add_chain(vehicle, 0.0, start_m, start_m)
        graph.extend(vehicle, track)
    for second in range(0, SECONDS + 1, 20):
        ends = [graph.anchor(v, float(second), track) for v, track in enumerate(tracks)]
        if ranges:
            graph.add_range(ends[0], ends[1], APART_M)
        if closures and second > 300:
            for end, track in zip(ends, tracks, strict=True):
                there = graph.anchor(0, 40.0, tracks[0])
                offset_m = track.position_at(float(second)) - tracks[0].position_at(40.0)
                graph.add_closure(there, end, offset_m, np.eye(2), active=True)
    return graph


def observed(*, ranges: bool = False, closures: bool = False) -> Observability:
    graph = graph_of(ranges=ranges, closures=closures)
    positions_m = np.array([graph.trajectory(v).position_m[-1] for v in (0, 1)])
    joint, reckoned = (
        graph.newest_covariance([0, 1], reckoned=only_reckoning) for only_reckoning in (False, True)
    )
    return observe(900.0, ("leader", "follower 1"), positions_m, joint, reckoned)


def undetermined(found: Observability) -> set[str]:
    return {q.name for q in found.quantities if q.is_undetermined}


def test_without_measurements_nothing_is_learned() -> None:
    found = observed()
    assert found.learned == pytest.approx(np.ones(8), abs=1e-6)
    assert found.blind == 8
    assert {"common position, northward", "rotation about the range, leader to follower 1"} <= (
        undetermined(found)
    )


def test_ranges_tell_the_distance_and_nothing_of_rotation_or_common_drift() -> None:
    found = observed(ranges=True)
    by_name = {q.name: q for q in found.quantities}
    assert by_name["distance, leader to follower 1"].sigma < 2.0
    assert not by_name["distance, leader to follower 1"].is_undetermined
    rotation = by_name["rotation about the range, leader to follower 1"]
    assert rotation.sigma > 0.95 * rotation.reckoned_sigma
    assert {"rotation about the range, leader to follower 1", "common position, northward"} <= (
        undetermined(found)
    )
    assert found.worst_like.startswith("common position")
    assert 0 < found.blind < 8


def test_closures_with_known_ground_leave_nothing_open() -> None:
    found = observed(ranges=True, closures=True)
    assert undetermined(found) == set()
    assert found.worst_m < 3.0
    assert any(line.endswith("determined") for line in found.lines())


def test_sigmas_are_those_of_the_joint_covariance() -> None:
    rng = np.random.default_rng(4)
    root = rng.standard_normal((8, 8))
    joint = root @ root.T
    found = observe(0.0, ("a", "b"), np.array([[0.0, 0.0], [0.0, 9.0]]), joint, joint + np.eye(8))
    by_name = {q.name: q.sigma for q in found.quantities}
    east = np.zeros(8)
    east[5], east[1] = 1.0, -1.0
    assert by_name["distance, a to b"] == pytest.approx(np.sqrt(east @ joint @ east))
    assert dataclasses.asdict(found)["time_s"] == 0.0
