"""How much drift wanders is learned from the mission, and unknown where nothing tells."""

import numpy as np
import pytest

from firmware.geometry import Array
from firmware.leader.composition import CompositionSettings
from firmware.leader.graph_settings import GraphSettings
from firmware.leader.pose_graph import PoseGraph
from firmware.leader.wander import (
    DriftChange,
    changes_of,
    expected_walk,
    likely_walk,
    reckoned_m2,
)
from firmware.submaps import Track
from protocol.errors import EstimationError

INTERVAL_S = 300.0
BELIEVED, FACTOR = GraphSettings().bias_walk, GraphSettings().walk_factor


def _changes(
    rng: np.random.Generator, walk: float, assumed: float, noise_mps: float, count: int
) -> list[DriftChange]:
    """Return changes as a Kalman filter would estimate them that assumes a walk."""
    prior, noise = assumed**2 * INTERVAL_S, noise_mps**2
    changes = []
    for _ in range(count):
        true_mps = walk * np.sqrt(INTERVAL_S) * rng.standard_normal(2)
        measured_mps = true_mps + noise_mps * rng.standard_normal(2)
        gain = prior / (prior + noise)
        changes.append(
            DriftChange(
                interval_s=INTERVAL_S,
                expected=prior * np.eye(2),
                change_mps=gain * measured_mps,
                found=gain * noise * np.eye(2),
            )
        )
    return changes


@pytest.mark.parametrize("walk", [0.0005, 0.002, 0.008])
@pytest.mark.parametrize("assumed", [0.001, 0.004])
def test_walk_is_found_whatever_the_estimate_assumed(walk: float, assumed: float) -> None:
    changes = _changes(np.random.default_rng(5), walk, assumed, noise_mps=0.01, count=200)
    assert likely_walk(changes, BELIEVED, FACTOR) == pytest.approx(walk, rel=0.3)


@pytest.mark.parametrize("size_mps", [0.0, 0.3])
def test_walk_is_that_of_the_posterior_of_what_was_measured(size_mps: float) -> None:
    """Each change was measured along one axis; it is held against walks by the thousand."""
    rng, expected_m2ps2, spread = np.random.default_rng(8), 0.006**2 * INTERVAL_S, np.log(FACTOR)
    log_walks = np.log(BELIEVED) + np.linspace(-8.0, 8.0, 8001)
    log_likely = -0.5 * ((log_walks - np.log(BELIEVED) + spread**2) / spread) ** 2
    changes = []
    for angle_rad in rng.uniform(0.0, np.pi, 6):
        measured_mps, noise_mps = size_mps * rng.standard_normal(), rng.uniform(0.02, 0.06)
        gain = expected_m2ps2 / (expected_m2ps2 + noise_mps**2)
        axis = np.array([np.cos(angle_rad), np.sin(angle_rad)])
        changes.append(
            DriftChange(
                interval_s=INTERVAL_S,
                expected=expected_m2ps2 * np.eye(2),
                change_mps=gain * measured_mps * axis,
                found=expected_m2ps2 * (np.eye(2) - gain * np.outer(axis, axis)),
            )
        )
        variances = np.exp(2.0 * log_walks) * INTERVAL_S + noise_mps**2
        log_likely -= 0.5 * (np.log(variances) + measured_mps**2 / variances)
    walk = np.sqrt(np.average(np.exp(2.0 * log_walks), weights=np.exp(log_likely)))
    assert abs(walk / BELIEVED - 1.0) > 0.2
    assert likely_walk(changes, BELIEVED, FACTOR) == pytest.approx(walk, rel=0.02)


def test_variance_of_dead_reckoning_is_what_many_short_steps_add_up_to() -> None:
    noise, walk, step_s = 0.3, 0.02, 0.05
    transition, covariance = np.array([[1.0, step_s], [0.0, 1.0]]), np.diag([5.0, 0.1]) ** 2
    for _ in range(2400):
        covariance = transition @ covariance @ transition.T
        covariance += step_s * np.diag([noise, walk]) ** 2
    found_m2 = reckoned_m2(120.0, noise, walk, start_m=5.0, drift_mps=0.1)
    assert found_m2 == pytest.approx(covariance[0, 0], rel=2e-3)


@pytest.mark.parametrize("unheard_s", [0.0, 600.0, 3600.0])
def test_way_unheard_of_is_as_unsure_as_many_short_steps(unheard_s: float) -> None:
    settings = GraphSettings()
    time_s = np.concatenate([[0.0], np.arange(unheard_s, 4801.0)])
    still = np.zeros_like(time_s)
    graph = PoseGraph(settings)
    graph.add_chain(0, 0.0, np.zeros(2), np.zeros(2))
    graph.extend(0, Track(time_s=time_s, north_m=still, east_m=still, yaw_rad=still))
    expected_m2 = reckoned_m2(
        4800.0,
        settings.odometry_noise,
        settings.bias_walk,
        start_m=settings.start_sigma_m,
        drift_mps=settings.bias_sigma_mps,
    )
    assert np.diag(graph.predicted_covariance(0, 4800.0)) == pytest.approx(expected_m2)


def test_without_evidence_the_belief_stays() -> None:
    told_nothing = BELIEVED**2 * INTERVAL_S * np.eye(2)
    blind = DriftChange(
        interval_s=INTERVAL_S, expected=told_nothing, change_mps=np.zeros(2), found=told_nothing
    )
    for changes in ([], [blind] * 20):
        found = likely_walk(changes, BELIEVED, FACTOR)
        assert found == pytest.approx(BELIEVED, rel=0.05)


def test_little_evidence_moves_it_little() -> None:
    rng = np.random.default_rng(6)
    few = likely_walk(_changes(rng, 0.0, BELIEVED, 0.06, 1), BELIEVED, FACTOR)
    many = likely_walk(_changes(rng, 0.0, BELIEVED, 0.01, 50), BELIEVED, FACTOR)
    assert many < 0.1 * BELIEVED < 0.5 * BELIEVED < few < BELIEVED


def test_vague_changes_do_not_argue_for_still_water() -> None:
    vague = _changes(np.random.default_rng(7), 0.0, BELIEVED, 0.1, 50)
    assert likely_walk(vague, BELIEVED, FACTOR) == pytest.approx(BELIEVED, rel=0.02)
    wild = _changes(np.random.default_rng(7), 10.0 * BELIEVED, BELIEVED, 0.1, 50)
    assert likely_walk(wild, BELIEVED, FACTOR) > 5.0 * BELIEVED


def test_changes_are_between_successive_epochs() -> None:
    found = np.diag(np.arange(1.0, 7.0))
    bias_mps = np.array([[0.0, 0.0], [1.0, 2.0], [1.5, 1.0]])
    changes = changes_of(np.array([0.0, 300.0, 500.0]), bias_mps, 10.0 * found, found)
    assert [change.interval_s for change in changes] == [300.0, 200.0]
    assert np.allclose(changes[1].change_mps, [0.5, -1.0])
    assert np.allclose(changes[0].found, np.diag([1.0 + 3.0, 2.0 + 4.0]))
    assert expected_walk(changes[:1]) == pytest.approx(np.sqrt(50.0 / INTERVAL_S))


@pytest.mark.parametrize("vehicles", [1, 2, 3])
def test_vehicles_that_share_a_drift_do_not_vouch_for_stillness(vehicles: int) -> None:
    """Composed again and again with nothing measured, the graph goes on to expect the same."""
    times_s = np.arange(2401.0)
    track = Track(time_s=times_s, north_m=2 * times_s, east_m=0 * times_s, yaw_rad=0 * times_s)
    graph = PoseGraph(GraphSettings())
    for vehicle in range(vehicles):
        graph.add_chain(vehicle, 0.0, np.zeros(2), np.zeros(2))
        graph.extend(vehicle, track)
    for _ in range(4):
        graph.compose(2400.0, CompositionSettings())
        keys = [graph._chains[0].key_at(time_s) for time_s in (1800.0, 2400.0)]
        joint = graph._solver.covariance([key for key in keys if key is not None])[2::4, 2::4]
        walk = np.sqrt((joint[0, 0] + joint[1, 1] - 2 * joint[0, 1]) / 600.0)
        assert walk == pytest.approx(BELIEVED, rel=0.1)
        assert graph.wandering.walk == pytest.approx(BELIEVED, rel=1e-3)


def test_graph_that_cannot_tell_its_drift_is_composed_and_learns_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    graph = _laps(0.1 * np.ones((3000, 2)), np.random.default_rng(1))
    learned, nodes = graph.wandering.walk, graph.nodes

    def fails(_: float) -> list[DriftChange]:
        raise EstimationError("singular")

    monkeypatch.setattr(graph, "drift_changes", fails)
    graph.compose(3600.0, CompositionSettings())
    assert graph.nodes < nodes
    assert graph.wandering.walk == learned


def _laps(current_mps: Array, rng: np.random.Generator) -> PoseGraph:
    """Return a graph after laps in a current (T, 2), with an absolute fix every two minutes."""
    time_s = np.arange(len(current_mps), dtype=np.float64)
    steps_m = current_mps + 0.2 * rng.standard_normal(current_mps.shape)
    drift_m = np.cumsum(steps_m, axis=0) - steps_m[0]
    angle = time_s / 60.0
    true_m = 100.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    north_m, east_m = (true_m + drift_m).T
    track = Track(time_s=time_s, north_m=north_m, east_m=east_m, yaw_rad=angle)
    graph = PoseGraph(GraphSettings())
    graph.add_chain(0, 0.0, true_m[0] + drift_m[0], true_m[0])
    graph.extend(0, track)
    for fix_s in range(120, len(time_s), 120):
        graph.add_absolute(graph.anchor(0, float(fix_s), track), true_m[fix_s], np.eye(2))
    graph.update()
    graph.compose(float(time_s[-1]), CompositionSettings())
    return graph


def test_graph_learns_a_turning_current_from_a_steady_one() -> None:
    time_s = np.arange(3000.0)[:, None]
    steady_mps = 0.1 * np.ones((3000, 2))
    turning_mps = 0.2 * np.hstack([np.cos(time_s / 573.0), np.sin(time_s / 573.0)])
    steady, turning = (
        _laps(current_mps, np.random.default_rng(7)) for current_mps in (steady_mps, turning_mps)
    )
    ahead = [graph.predicted_covariance(0, 2990.0 + 600.0) for graph in (steady, turning)]
    assert np.trace(ahead[1]) > 4.0 * np.trace(ahead[0])
