"""Which closures are believed by the company that they keep."""

import dataclasses
from unittest.mock import MagicMock

import numpy as np
import pytest

from firmware.geometry import Array
from firmware.leader.atlas import Atlas, SheetId, sheet_of
from firmware.leader.closures import Closure, Stage
from firmware.leader.graph_settings import GraphSettings
from firmware.leader.judgement import Judgement, JudgementSettings
from firmware.leader.matches import MatchingSettings
from firmware.leader.pairing import Calibrations
from firmware.leader.pose_graph import PoseGraph
from firmware.submaps import Track
from tests.matching.scenes import Scene

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


@pytest.mark.parametrize("turned", [False, True])
def test_closures_of_the_same_soundings_do_not_vouch_for_each_other(*, turned: bool) -> None:
    """Own sub-maps overlap by half: what misleads the match of one misleads that of the next."""
    graph, track = moored()
    offset_m = np.array([60.0, 0.0])
    for apart_s, believed in ((20.0, False), (120.0, True)):
        ends_s = (600.0, 7200.0 + apart_s)
        pair = [
            closure_between(graph, track, 600.0, 7200.0, offset_m),
            closure_between(graph, track, *ends_s[::-1], -offset_m)
            if turned
            else closure_between(graph, track, *ends_s, offset_m),
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


def twice_sailed() -> tuple[PoseGraph, Track, Atlas]:
    """Return graph, track and sub-maps of a vehicle that sails the same line north again."""
    scene, time_s = Scene(seed=5), np.arange(681.0)
    north_m = np.interp(time_s, (0.0, 80.0, 600.0, 680.0), (200.0, 360.0, 200.0, 360.0))
    track = Track(time_s=time_s, north_m=north_m, east_m=0.0 * time_s + 260.0, yaw_rad=0.0 * time_s)
    graph, atlas = PoseGraph(GraphSettings()), Atlas(10)
    graph.add_chain(0, 0.0, track.position_at(0.0), track.position_at(0.0))
    graph.extend(0, track)
    graph.update()
    for begin_s in (0.0, 40.0, 600.0, 640.0):
        grid = scene.submap(float(track.position_at(begin_s)[0]), 200.0, (41, 60))
        part = np.s_[int(begin_s) : int(begin_s) + 41]
        sheet = sheet_of(
            SheetId(vehicle=0, boot_epoch=0, submap=int(begin_s) + 20),
            Track(
                time_s=time_s[part],
                north_m=north_m[part],
                east_m=track.east_m[part],
                yaw_rad=track.yaw_rad[part],
            ),
            dataclasses.replace(grid, time_s=grid.time_s + begin_s),
        )
        assert sheet is not None
        atlas.add(sheet)
    return graph, track, atlas


@pytest.mark.parametrize(
    ("off_m", "axis_deg", "believed"),
    [((1.0, -1.0), None, True), ((24.0, -30.0), None, False), ((1.0, -1.0), 0.0, False)],
)
def test_the_map_beside_a_closure_says_whether_it_is_true(
    off_m: tuple[float, float], axis_deg: float | None, *, believed: bool
) -> None:
    """Where it holds along one axis only, the map would slide along with it."""
    graph, track, atlas = twice_sailed()
    closure = closure_between(graph, track, 20.0, 620.0, np.array(off_m))
    closure.axis_deg = axis_deg
    judgement = Judgement(JudgementSettings(), UNCALIBRATED)
    judgement.consider([closure], atlas, graph)
    assert closure.active is believed
    assert judgement.counters["closures_believed_by_map"] == believed


def lone_closures(graph: PoseGraph, track: Track, *norths_m: float) -> list[Closure]:
    """Return closures two minutes apart, of which no map is asked."""
    closures = [
        closure_between(graph, track, 600.0 + k, 7200.0 + k, np.array([north_m, 0.0]))
        for k, north_m in zip(np.arange(0.0, 1200.0, 120.0), norths_m, strict=False)
    ]
    for closure in closures:
        closure.axis_deg = 0.0
    return closures


def test_a_closure_is_believed_alone_where_its_offset_was_known() -> None:
    graph, track = moored()
    known, unknown = lone_closures(graph, track, 0.0, 60.0)
    known.predicted_sigma_m, unknown.predicted_sigma_m = 6.5, 7.5
    Judgement(JudgementSettings(), UNCALIBRATED).consider([known, unknown], Atlas(10), graph)
    assert [graph.is_active(closure.number) for closure in (known, unknown)] == [True, False]
    assert [closure.stage for closure in (known, unknown)] == [Stage.CONSISTENT, Stage.GATED]


@pytest.mark.parametrize("forgotten", [False, True])
def test_a_closure_waits_for_company_until_it_is_forgotten(*, forgotten: bool) -> None:
    graph, track = moored()
    judgement = Judgement(JudgementSettings(), UNCALIBRATED)
    first, second = lone_closures(graph, track, 0.0, 0.0)
    judgement.consider([first], Atlas(10), graph)
    assert not first.active
    judgement.forget(first.time_s + (1.0 if forgotten else 0.0), graph)
    judgement.consider([second], Atlas(10), graph)
    assert [closure.active for closure in (first, second)] == [not forgotten] * 2
    assert judgement.counters["closures_given_up"] == forgotten


def test_the_oldest_of_too_many_that_wait_is_given_up() -> None:
    graph, track = moored()
    judgement = Judgement(JudgementSettings(waiting=2), UNCALIBRATED)
    closures = lone_closures(graph, track, -60.0, 0.0, 60.0)
    judgement.consider(closures, Atlas(10), graph)
    assert judgement.counters["closures_given_up"] == 1
    assert list(judgement._waiting) == closures[1:]


def test_an_audit_takes_closures_back_and_in_again_with_room_between() -> None:
    """Four sigmas and 95 %; a hint is as active as it fits."""
    graph, track = moored()
    (closure,) = lone_closures(graph, track, 0.0)
    closure.stage, closure.active = Stage.CONSISTENT, True
    judgement, audited = Judgement(JudgementSettings(), UNCALIBRATED), MagicMock()
    judgement.note_hint(10_000)
    told = []
    for chi_square in (15.0, 17.0, 7.0, 5.0):
        audited.chi_square.return_value = chi_square
        judgement.audit([closure], audited)
        told.append([call.kwargs["active"] for call in audited.set_active.call_args_list[-2:]])
    assert told == [[True, False], [False, False], [False, False], [True, True]]
    assert judgement.counters["closures_taken_back"] == 1
    assert judgement.counters["closures_taken_in_again"] == 1
