"""The incremental pose graph against a dense solution of the same records."""

import dataclasses
from typing import Any
from unittest.mock import patch

import gtsam
import numpy as np
import pytest

from firmware.leader import solver
from firmware.leader.graph_settings import GraphSettings
from firmware.leader.ledger import (
    Anchor,
    OdometryRecord,
    PriorRecord,
    RangeRecord,
    SharedDriftRecord,
)
from firmware.leader.pose_graph import PoseGraph
from firmware.submaps import Track
from protocol.errors import ConfigError, EstimationError

SETTINGS = GraphSettings()


def walk(rng: np.random.Generator, seconds: int, heading_rad: float) -> tuple[Track, np.ndarray]:
    """Return a dead-reckoned track that drifts, and the true positions (T, 2)."""
    time_s = np.arange(seconds + 1.0)
    leg = np.where((time_s // 200) % 2 == 0, heading_rad, heading_rad + np.pi)
    steps_m = 2.0 * np.column_stack([np.cos(leg), np.sin(leg)])
    true_m = np.cumsum(steps_m, axis=0) - steps_m[0]
    noise_m = np.array([0.1, 0.05]) + 0.2 * rng.standard_normal(steps_m.shape)
    drift_m = np.cumsum(noise_m, axis=0) - noise_m[0]
    north_m, east_m = (true_m + drift_m).T
    return Track(time_s=time_s, north_m=north_m, east_m=east_m, yaw_rad=leg), true_m


def started(track: Track, vehicle: int = 0, graph: PoseGraph | None = None) -> PoseGraph:
    graph = graph or PoseGraph(SETTINGS)
    start_m = np.array([track.north_m[0], track.east_m[0]])
    graph.add_chain(vehicle, 0.0, start_m, start_m)
    graph.extend(vehicle, track)
    return graph


def close(
    graph: PoseGraph,
    track: Track,
    true_m: np.ndarray,
    a_s: int,
    b_s: int,
    error_m: float | np.ndarray = 0.0,
) -> int:
    ends = [graph.anchor(0, float(t), track) for t in (a_s, b_s)]
    offset_m = true_m[b_s] - true_m[a_s] + error_m
    return graph.add_closure(ends[0], ends[1], offset_m, np.eye(2), active=True)


def test_nothing_is_anchored_where_a_track_is_unknown() -> None:
    track, _ = walk(np.random.default_rng(1), 400, 0.3)
    heard = (track.time_s <= 180.0) | (track.time_s >= 220.0)
    gapped = Track(**{f.name: getattr(track, f.name)[heard] for f in dataclasses.fields(track)})
    graph = started(gapped)
    for time_s in (180.0, 184.0, 216.0, 220.0):
        graph.anchor(0, time_s, gapped)
    for time_s in (188.0, 200.0, 212.0):
        with pytest.raises(EstimationError, match="no state near"):
            graph.anchor(0, time_s, gapped)


def test_closures_recover_the_drift_that_dead_reckoning_hides() -> None:
    track, true_m = walk(np.random.default_rng(1), 800, 0.3)
    graph = started(track)
    for a_s, b_s in ((20, 380), (100, 500), (150, 650), (30, 770)):
        close(graph, track, true_m, a_s, b_s)
    graph.update()
    estimate = graph.trajectory(0)
    reckoned_m = np.column_stack([track.north_m, track.east_m])
    error_m = np.hypot(*(estimate.correct(track.time_s, reckoned_m) - true_m).T)
    assert error_m.mean() < 0.1 * np.hypot(*(reckoned_m - true_m).T).mean()
    assert estimate.bias_mps[-1] == pytest.approx([0.1, 0.05], abs=0.03)


def test_incremental_and_batch_solutions_agree_to_five_centimetres() -> None:
    rng = np.random.default_rng(2)
    track, true_m = walk(rng, 1200, 0.0)
    other, other_true_m = walk(rng, 1200, 1.5)
    graph = started(other, 1, started(track))
    for second in range(60, 1200, 40):
        ends = graph.anchor(0, float(second), track), graph.anchor(1, float(second), other)
        range_m = float(np.hypot(*(true_m[second] - other_true_m[second])))
        graph.add_range(*ends, range_m + rng.standard_normal())
        if second > 400:
            close(graph, track, true_m, second - 390, second)
            there = graph.anchor(0, second - 40.0, track)
            offset_m = other_true_m[second] - true_m[second - 40]
            graph.add_closure(there, ends[1], offset_m, np.eye(2), active=True)
        graph.update()
    before_m = np.vstack([graph.trajectory(v).position_m for v in (0, 1)])
    graph.solve_batch()
    after_m = np.vstack([graph.trajectory(v).position_m for v in (0, 1)])
    assert np.abs(before_m - after_m).max() < 0.05


def test_covariance_is_that_of_the_dense_information_matrix() -> None:
    track, true_m = walk(np.random.default_rng(3), 100, 0.0)
    graph = started(track)
    close(graph, track, true_m, 10, 90)
    graph.update()
    anchors = [graph.anchor(0, t, track) for t in (0.0, 50.0, 100.0)]
    linear = graph._solver._isam.getFactorsUnsafe().linearize(graph._solver._values)
    ordering = sorted(graph._solver._values.keys())
    jacobian, _ = linear.jacobian()
    dense_m2 = np.linalg.inv(jacobian.T @ jacobian)
    first = {key: 2 + 4 * k for k, key in enumerate(k for k in ordering if chr(k >> 56) == "x")}
    rows = [first[a.key] + axis for a in anchors for axis in (0, 1)]
    assert graph.covariance(anchors) == pytest.approx(dense_m2[np.ix_(rows, rows)], rel=1e-6)


def test_a_leap_of_the_clock_costs_no_more_than_the_track_that_is_known() -> None:
    track, _ = walk(np.random.default_rng(5), 200, 0.0)
    leapt = dataclasses.replace(track, time_s=np.where(track.time_s > 100, 1e6, 0) + track.time_s)
    with patch.object(Track, "gap_s", autospec=True, side_effect=Track.gap_s) as gap_s:
        graph = started(leapt)
    assert graph._chains[0].times_s == [*range(0, 101, 10), *range(1_000_100, 1_000_201, 10)]
    assert gap_s.call_count < 30


def test_deactivated_closure_leaves_no_trace() -> None:
    track, true_m = walk(np.random.default_rng(4), 600, 0.0)
    graph, untouched = started(track), started(track)
    for g in (graph, untouched):
        close(g, track, true_m, 20, 380)
        g.update()
    wrong = close(graph, track, true_m, 50, 550, error_m=3.0)
    graph.update()
    graph.set_active(wrong, active=False)
    graph.update()
    difference_m = graph.trajectory(0).position_m - untouched.trajectory(0).position_m
    assert np.abs(difference_m).max() < 1e-3


def test_long_chain_without_closures_stays_solvable() -> None:
    time_s = np.arange(0.0, 20_000.0, 10.0)
    track = Track(time_s=time_s, north_m=2 * time_s, east_m=0 * time_s, yaw_rad=0 * time_s)
    graph = started(track)
    graph.update()
    assert graph.rebuilds <= 1  # once, when Cholesky gives the chain up
    assert graph.trajectory(0).position_m[-1] == pytest.approx([2 * time_s[-1], 0.0], abs=1e-3)


def test_graph_outlives_a_rebuild_that_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    track, _ = walk(np.random.default_rng(4), 400, 0.3)
    graph = started(track)
    rebuild, failures = graph._solver._rebuild, [RuntimeError("indeterminate")]

    def fails_once(values: object) -> None:
        if failures:
            raise failures.pop()
        rebuild(values)  # type: ignore[arg-type]

    monkeypatch.setattr(graph._solver, "_rebuild", fails_once)
    monkeypatch.setattr(solver, "_WORN", 0.0)  # so that every update builds anew
    graph.extend(0, track)
    graph.update()
    assert graph.rebuilds == 1
    monkeypatch.undo()
    graph.update()
    assert graph.trajectory(0).time_s[-1] == 400.0


def test_factors_are_handed_the_very_point_about_which_the_solver_is_linearised() -> None:
    """Else gtsam's binding copies it, for each factor again."""
    graph = started(walk(np.random.default_rng(6), 100, 0.3)[0])
    graph.update()
    solver, handed = graph._solver, list[gtsam.Values]()

    def error(_this: object, values: gtsam.Values, jacobians: Any) -> np.ndarray:
        handed.append(values)
        jacobians[0] = np.eye(4)
        return np.zeros(4)

    key = next(key for key in solver._values.keys() if solver.state(key).size == 4)
    factors = gtsam.NonlinearFactorGraph()
    factors.push_back(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(4), [key], error))
    solver._isam.update(factors, gtsam.Values())
    assert handed
    assert all(values is solver._about for values in handed)


def test_gap_in_a_track_is_bridged_by_composed_positions() -> None:
    track, _ = walk(np.random.default_rng(5), 300, 0.0)
    kept = (track.time_s < 100) | (track.time_s > 180)
    gappy = Track(
        **{n: getattr(track, n)[kept] for n in ("time_s", "north_m", "east_m", "yaw_rad")}
    )
    graph = started(gappy)
    graph.update()
    estimate = graph.trajectory(0)
    assert not np.any((estimate.time_s > 110) & (estimate.time_s < 170))
    assert estimate.position_m[-1] == pytest.approx([track.north_m[-1], track.east_m[-1]], abs=1e-3)


def test_time_without_a_node_is_an_error_that_names_the_nearest() -> None:
    track, _ = walk(np.random.default_rng(6), 100, 0.0)
    with pytest.raises(EstimationError, match=r"no node near 500\.0 s; the nearest is at 100\.0 s"):
        started(track).anchor(0, 500.0, track)
    with pytest.raises(EstimationError, match="no chain 7"):
        started(track).anchor(7, 10.0, track)


def test_ledger_holds_every_record_that_the_graph_was_told() -> None:
    track, _ = walk(np.random.default_rng(7), 50, 0.0)
    graph = started(track, 1, started(track))
    number = graph.add_range(graph.anchor(0, 50.0, track), graph.anchor(1, 50.0, track), 5.0)
    assert isinstance(graph.record(number), RangeRecord)
    kinds = [type(graph.record(k)) for k in range(number)]
    assert kinds.count(PriorRecord) == 4
    assert kinds.count(SharedDriftRecord) == 1
    assert kinds.count(OdometryRecord) == 10


def test_current_that_turns_for_one_vehicle_turns_for_the_other() -> None:
    """The first vehicle sees the turn by fixes; the other has none after the tenth minute."""
    time_s = np.arange(0.0, 1801.0)
    drift_m = np.cumsum(np.where(time_s < 900.0, 0.1, -0.1))
    track = Track(time_s=time_s, north_m=drift_m, east_m=0 * time_s, yaw_rad=0 * time_s)
    misses_m = []
    for settings in (SETTINGS, dataclasses.replace(SETTINGS, walk_apart=250.0)):
        graph = started(track, 1, started(track, 0, PoseGraph(settings)))
        for second in range(0, 1801, 60):
            for vehicle in (0, 1) if second <= 600 else (0,):
                anchor = graph.anchor(vehicle, float(second), track)
                graph.add_absolute(anchor, np.zeros(2), np.eye(2))
        graph.update()
        misses_m.append(float(np.abs(graph.trajectory(1).position_m[-1, 0])))
    assert misses_m[0] < 0.5 * misses_m[1]


def test_vehicles_that_would_never_be_tied_are_refused() -> None:
    assert GraphSettings(node_interval_s=7.5, alike_interval_s=60.0)
    for node_s, alike_s in ((8.0, 60.0), (10.0, 45.0), (1.1, 11.0)):
        with pytest.raises(ConfigError, match="multiple of node_interval_s"):
            GraphSettings(node_interval_s=node_s, alike_interval_s=alike_s)


def test_range_says_nothing_of_a_compass_that_turns_the_whole_map() -> None:
    """Nodes turned by an angle, and the compass by as much: the way between instants turns too."""
    turn_rad = np.radians(1.0)
    turned = np.array([[np.cos(turn_rad), -np.sin(turn_rad)], [np.sin(turn_rad), np.cos(turn_rad)]])
    states = {1: np.array([30.0, -20.0, 0.2, 0.1]), 2: np.array([-60.0, 70.0, -0.1, 0.2])}
    ends = [
        Anchor(key=key, parameters=9, offset_m=np.array(offset_m), time_s=4.0, lag_s=4.0)
        for key, offset_m in ((1, [8.0, 3.0]), (2, [-2.0, 9.0]))
    ]
    record = RangeRecord(origin=ends[0], target=ends[1], range_m=100.0, sigma_m=1.0)
    misses_m = []
    for turn, heading_rad in ((np.eye(2), 0.0), (turned, -turn_rad), (turned, 0.0)):
        values = {key: np.concatenate([turn @ s[:2], turn @ s[2:]]) for key, s in states.items()}
        values[9] = np.array([heading_rad, 0.0])
        misses_m.append(record.innovation_m(values.__getitem__)[0])
    assert misses_m[1] == pytest.approx(misses_m[0], abs=2e-3)
    assert abs(misses_m[2] - misses_m[0]) > 0.03


def test_between_nodes_drift_makes_a_position_less_sure() -> None:
    track, _ = walk(np.random.default_rng(5), 3, 0.0)
    graph = started(track)
    sigma_m = float(np.sqrt(graph.covariance([graph.anchor(0, 3.0, track)])[1, 1]))
    assert sigma_m == pytest.approx(np.hypot(0.5, 3.0 * 0.2), rel=0.01)


def test_closures_between_lines_do_not_vouch_for_the_compass() -> None:
    """A whole map may turn about its start: what the sonar saw beside the track turns with it."""
    rng, turn_rad = np.random.default_rng(3), np.radians(0.5)
    turned = np.array([[1.0, -turn_rad], [turn_rad, 1.0]])
    times_s = np.arange(0.0, 1371.0)
    line, age_s = np.divmod(times_s, 350.0)
    along_m = np.minimum(2.0 * age_s, 600.0)
    along_m = np.where(line % 2, 600.0 - along_m, along_m)
    true_m = np.column_stack([along_m, 100.0 * line + 2.0 * np.maximum(age_s - 300.0, 0.0)])
    reckoned_m = true_m @ turned.T
    north_m, east_m = reckoned_m.T
    track = Track(time_s=times_s, north_m=north_m, east_m=east_m, yaw_rad=0.0 * north_m)
    graph = started(track)
    for first_s in np.arange(10.0, 290.0, 20.0):
        for before in range(3):
            ends_s = [350.0 * before + first_s, 350.0 * before + 650.0 - first_s]
            seen_m = true_m[[int(t) for t in ends_s]].mean(axis=0)
            ends = [
                dataclasses.replace(
                    graph.anchor(0, t, track), lever_m=turned @ (seen_m - true_m[int(t)])
                )
                for t in ends_s
            ]
            offset_m = ends[0].lever_m - ends[1].lever_m + 0.5 * rng.standard_normal(2)
            graph.add_closure(ends[0], ends[1], offset_m, 0.25 * np.eye(2), active=True)
    graph.update()
    far = graph.anchor(0, 1350.0, track)
    away_m = float(np.hypot(*true_m[1350]))
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(graph.covariance([far]))[-1]))
    assert sigma_m > 0.7 * np.radians(SETTINGS.heading_bias_sigma_deg) * away_m
    assert np.hypot(*(graph.position(far) - true_m[1350])) < 3.0 * sigma_m
