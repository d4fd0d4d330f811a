"""Which closures are believed by the company that they keep."""

import numpy as np

from firmware.geometry import Array
from firmware.leader.atlas import Atlas, SheetId
from firmware.leader.closures import Closure, Stage
from firmware.leader.graph_settings import GraphSettings
from firmware.leader.judgement import Judgement, JudgementSettings
from firmware.leader.matches import MatchingSettings
from firmware.leader.pairing import Calibrations
from firmware.leader.pose_graph import PoseGraph
from firmware.submaps import Track

HOURS, TIDE_S, TIDE_MPS = 5.0, 12.4 * 3600.0, 0.2
UNCALIBRATED = Calibrations(MatchingSettings())


def moored() -> tuple[PoseGraph, Track]:
    """Return the graph of a vehicle that stays where it is while the tide turns, and its track."""
    time_s = np.arange(HOURS * 3600.0 + 1.0)
    turn = 2 * np.pi / TIDE_S
    north_m = TIDE_MPS / turn * (1.0 - np.cos(turn * time_s))
    track = Track(time_s=time_s, north_m=north_m, east_m=0.0 * time_s, yaw_rad=0.0 * time_s)
    graph = PoseGraph(GraphSettings(node_interval_s=60.0))
    graph.add_chain(0, 0.0, np.zeros(2), np.zeros(2))
    graph.extend(0, track)
    for fix_s in range(300, int(time_s[-1]) + 1, 300):
        graph.add_absolute(graph.anchor(0, float(fix_s), track), np.zeros(2), np.eye(2))
    graph.update()
    return graph, track


def closure_between(
    graph: PoseGraph, track: Track, then_s: float, now_s: float, offset_m: Array
) -> Closure:
    ends = [graph.anchor(0, time_s, track) for time_s in (then_s, now_s)]
    covariance_m2 = 0.25 * np.eye(2)
    return Closure(
        time_s=now_s,
        origin=SheetId(vehicle=0, boot_epoch=0, submap=int(then_s)),
        target=SheetId(vehicle=0, boot_epoch=0, submap=int(now_s)),
        origin_anchor=ends[0],
        target_anchor=ends[1],
        offset_m=offset_m,
        covariance_m2=covariance_m2,
        residual=0.01,
        misfit=1.0,
        axis_deg=None,
        origin_reckoned_m=track.position_at(then_s),
        target_reckoned_m=track.position_at(now_s),
        stage=Stage.GATED,
        number=graph.add_closure(ends[0], ends[1], offset_m, covariance_m2, active=False),
    )


def test_true_closures_vouch_for_each_other_hours_into_a_turning_tide() -> None:
    graph, track = moored()
    for hour in (1.0, 2.5, 4.5):
        pair = [
            closure_between(graph, track, 600.0 + k, hour * 3600.0 + k, np.zeros(2))
            for k in (0.0, 240.0)
        ]
        Judgement(JudgementSettings(), UNCALIBRATED).consider(pair, Atlas(10), graph)
        assert all(closure.active for closure in pair), hour


def test_closures_of_the_same_soundings_do_not_vouch_for_each_other() -> None:
    """Own sub-maps overlap by half: what misleads the match of one misleads that of the next."""
    graph, track = moored()
    for apart_s, believed in ((20.0, False), (120.0, True)):
        pair = [
            closure_between(graph, track, 600.0, 7200.0 + k, np.array([60.0, 0.0]))
            for k in (0.0, apart_s)
        ]
        for closure in pair:
            closure.axis_deg = 0.0  # then the map beside it is not asked
        Judgement(JudgementSettings(), UNCALIBRATED).consider(pair, Atlas(10), graph)
        assert [closure.active for closure in pair] == [believed, believed]


def test_closures_that_contradict_dead_reckoning_do_not() -> None:
    graph, track = moored()
    offsets_m = np.zeros(2), np.array([60.0, 0.0])
    pair = [
        closure_between(graph, track, 600.0 + k, 7200.0 + k, offset_m)
        for k, offset_m in zip((0.0, 120.0), offsets_m, strict=True)
    ]
    for closure in pair:
        closure.axis_deg = 0.0  # then the map beside it is not asked
    Judgement(JudgementSettings(), UNCALIBRATED).consider(pair, Atlas(10), graph)
    assert not any(closure.active for closure in pair)
