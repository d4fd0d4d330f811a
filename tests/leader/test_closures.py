"""What a match becomes: a closure or a hint between nodes of the graph, and the gate before it."""

import dataclasses

import numpy as np
import pytest

from firmware.geometry import Array
from firmware.leader.atlas import Sheet, SheetId, sheet_of
from firmware.leader.closure_settings import ClosureSettings
from firmware.leader.closures import Closure, Stage, closure_of, enter_hint, gated
from firmware.leader.displacement import Look
from firmware.leader.graph_settings import GraphSettings
from firmware.leader.match_job import MatchJob
from firmware.leader.matches import ANY_PAIR, Hint, Match, MatchingSettings, MatchOutcome, NoMatch
from firmware.leader.pose_graph import PoseGraph
from firmware.submaps import GriddedSubmap, Track

END_S = 400
FIRST_S, SECOND_S = 40.0, 320.0  # middles of the two passes
RAN_AWAY_M = np.array([5.0, -3.0]), np.array([20.0, 8.0])  # at those times
DRIFT_MPS = np.array([0.2, 0.1]), np.array([-0.1, 0.3])
LOOKS = tuple(
    Look(
        vehicle=vehicle,
        starboard=np.array([0.0, 1.0]),
        altitude_m=40.0,
        half_width_m=70.0,
        errors=np.zeros(2),
        covariance=np.diag([0.01, 0.0]) ** 2,
    )
    for vehicle in (0, 1)
)


def true_m(time_s: float) -> Array:
    return np.array([100.0 * np.sin(time_s / 60.0), 0.5 * time_s])


def track() -> Track:
    """Return dead reckoning that runs away by another drift on each pass."""
    times_s = np.arange(END_S + 1.0)
    passes = [0 if time_s < 180.0 else 1 for time_s in times_s]
    reckoned_m = [
        true_m(t) + RAN_AWAY_M[k] + DRIFT_MPS[k] * (t - (FIRST_S, SECOND_S)[k])
        for t, k in zip(times_s, passes, strict=True)
    ]
    north_m, east_m = np.transpose(reckoned_m)
    return Track(time_s=times_s, north_m=north_m, east_m=east_m, yaw_rad=0.0 * times_s)


def sheet(middle_s: float) -> Sheet:
    part = np.s_[int(middle_s) - 20 : int(middle_s) + 21]
    whole, shape = track(), (4, 4)
    found = sheet_of(
        SheetId(vehicle=0, boot_epoch=0, submap=int(middle_s)),
        Track(
            time_s=whole.time_s[part],
            north_m=whole.north_m[part],
            east_m=whole.east_m[part],
            yaw_rad=whole.yaw_rad[part],
        ),
        GriddedSubmap(
            north0_m=0.0,
            east0_m=0.0,
            cell_m=2.0,
            depth_m=np.ones(shape),
            variance_m2=np.full(shape, 0.01),
            time_s=np.full(shape, middle_s),
        ),
    )
    assert found is not None
    return found


@pytest.fixture
def graph() -> PoseGraph:
    graph = PoseGraph(GraphSettings(closure_floor_m=0.0))
    graph.add_chain(0, 0.0, np.zeros(2), np.zeros(2))
    graph.extend(0, track())
    graph.update()
    return graph


@pytest.fixture
def job() -> MatchJob:
    origin, target = sheet(FIRST_S), sheet(SECOND_S)
    return MatchJob(
        origin=origin,
        target=target,
        origin_grid=origin.grid,
        target_grid=target.grid,
        origin_drift_mps=DRIFT_MPS[0],
        target_drift_mps=DRIFT_MPS[1],
        prior_shift_m=np.zeros(2),
        prior_covariance_m2=400.0 * np.eye(2),
        settings=MatchingSettings(),
        sigmas=ANY_PAIR,
        looks=(LOOKS[0], LOOKS[1]),
    )


def test_closure_is_the_way_between_the_positions_from_which_both_saw_a_place(
    job: MatchJob, graph: PoseGraph
) -> None:
    place_m, seen_s = np.array([30.0, 90.0]), (33.0, 331.0)
    found = Match(
        shift_m=RAN_AWAY_M[0] - RAN_AWAY_M[1],
        covariance_m2=np.diag([2.0, 3.0]),
        residual=0.01,
        misfit=1.0,
        overlap_cells=100,
        axis_deg=None,
        centre_m=place_m + RAN_AWAY_M[0],
        reference_time_s=seen_s[0],
        query_time_s=seen_s[1],
    )
    closure = closure_of(job, MatchOutcome(match=found, reason=None), graph, 400.0)
    assert closure is not None
    assert closure.offset_m == pytest.approx(true_m(seen_s[1]) - true_m(seen_s[0]))
    anchors = closure.origin_anchor, closure.target_anchor
    for anchor, time_s in zip(anchors, seen_s, strict=True):
        assert anchor.time_s == time_s
        assert anchor.lever_m == pytest.approx(place_m - true_m(time_s))
    rolls_m2 = 2.0 * (40.0 * 0.01) ** 2  # of two vehicles, to starboard
    assert closure.covariance_m2 == pytest.approx(np.diag([2.0, 3.0 + rolls_m2]))
    assert (closure.stage, closure.number, closure.active) == (Stage.DETECTED, None, False)
    nothing = MatchOutcome(match=None, reason=NoMatch.AMBIGUOUS)
    assert closure_of(job, nothing, graph, 400.0) is None


def test_hint_is_the_way_between_the_middles_of_both_sub_maps(
    job: MatchJob, graph: PoseGraph
) -> None:
    hint = Hint(shift_m=RAN_AWAY_M[0] - RAN_AWAY_M[1], covariance_m2=np.diag([50.0, 80.0]))
    settings = ClosureSettings(hint_prior_m=19.0, hint_span_s=50.0)
    number = enter_hint(job, hint, graph, settings)
    assert number is not None
    assert graph.is_active(number)
    record = graph.closure(number)
    assert record.offset_m == pytest.approx(true_m(SECOND_S) - true_m(FIRST_S))
    walk_m2 = 50.0 * job.settings.walk_m2_per_s
    assert record.covariance_m2 == pytest.approx(np.diag([50.0, 80.0]) + walk_m2 * np.eye(2))
    known_better = dataclasses.replace(job, prior_covariance_m2=np.diag([18.9, 10.0]) ** 2)
    assert enter_hint(known_better, hint, graph, settings) is None


def test_closures_are_gated_each_by_what_the_graph_knows_of_its_own_offset(
    graph: PoseGraph,
) -> None:
    """Just within the gate and just beyond it, along the axis that is known worst."""
    settings, closures, sigmas_m = ClosureSettings(), [], []
    ends_s = ((40.0, 320.0), (40.0, 320.0), (200.0, 230.0), (10.0, 390.0))
    for (origin_s, target_s), share in zip(ends_s, (0.98, 1.02, 1.02, 0.0), strict=True):
        anchors = [graph.anchor(0, time_s, track()) for time_s in (origin_s, target_s)]
        joint_m2 = graph.covariance(anchors)
        way_m2 = np.kron([[-1.0, 1.0]], np.eye(2))
        prior_m2 = way_m2 @ joint_m2 @ way_m2.T
        values, axes = np.linalg.eigh(prior_m2)
        off_m = np.sqrt(share * settings.gate_chi_square * (values[1] + 900.0)) * axes[:, 1]
        sigmas_m.append(np.sqrt(values[1]))
        closures.append(
            Closure(
                time_s=400.0,
                origin=SheetId(vehicle=0, boot_epoch=0, submap=0),
                target=SheetId(vehicle=0, boot_epoch=0, submap=1),
                origin_anchor=anchors[0],
                target_anchor=anchors[1],
                offset_m=graph.position(anchors[1]) - graph.position(anchors[0]) + off_m,
                covariance_m2=900.0 * np.eye(2),
                residual=0.01,
                misfit=1.0,
                axis_deg=None,
                origin_reckoned_m=np.zeros(2),
                target_reckoned_m=np.zeros(2),
            )
        )
    assert gated(closures, graph, settings) == [closures[0], closures[3]]
    for closure, sigma_m in ((closures[0], sigmas_m[0]), (closures[3], sigmas_m[3])):
        assert closure.stage is Stage.GATED
        assert closure.predicted_sigma_m == pytest.approx(sigma_m)
        assert closure.number is not None
        assert not graph.is_active(closure.number)
        record = graph.closure(closure.number)
        assert np.array_equal(record.offset_m, closure.offset_m)
        assert np.array_equal(record.covariance_m2, closure.covariance_m2)
    for closure in closures[1:3]:
        assert (closure.stage, closure.number) == (Stage.DETECTED, None)
    assert gated([], PoseGraph(GraphSettings()), settings) == []
