"""False closures that agree with each other, against true ones: the audit alone, and a doubt."""

import dataclasses

import numpy as np
import pytest

from firmware.geometry import Array
from firmware.leader.atlas import SheetId
from firmware.leader.closures import Closure, Stage
from firmware.leader.judgement import Judgement, JudgementSettings
from firmware.leader.matches import MatchingSettings
from firmware.leader.pairing import Calibrations
from firmware.leader.pose_graph import PoseGraph
from firmware.submaps import Track
from tests.leader.test_pose_graph import close, started, walk

SECONDS = 1200
LIMITS = (6.0, 16.0)
SHEET = SheetId(vehicle=0, boot_epoch=0, submap=0)


@dataclasses.dataclass
class Mission:
    """One vehicle; closures of which the last `false` say that it has drifted elsewhere."""

    seed: int
    true: int
    false: int
    wrong_m: float = 40.0

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        self.track, true_m = walk(rng, SECONDS, 0.3)
        self.graph = started(self.track)
        self.judgement = Judgement(JudgementSettings(), Calibrations(MatchingSettings()))
        self.closures: list[Closure] = []
        wrong_m = rng.normal(0.0, 1.0, 2)
        wrong_m *= self.wrong_m / np.hypot(*wrong_m)
        for k in range(self.true + self.false):
            first_s = int(rng.integers(0, SECONDS - 300))
            last_s = int(rng.integers(first_s + 300, SECONDS))
            error_m = rng.normal(0.0, 0.7, 2)
            if k >= self.true:
                error_m += wrong_m * (last_s - first_s) / SECONDS + wrong_m / 4.0
            self._close(true_m, first_s, last_s, error_m)
        self.graph.update()
        self.true_m = true_m

    def thrown_out(self) -> list[bool]:
        return [not closure.active for closure in self.closures]

    def error_m(self) -> float:
        return float(np.hypot(*(self.graph.trajectory(0).position_m[-1] - self.true_m[-1])))

    def _close(self, true_m: Array, first_s: int, last_s: int, error_m: Array) -> None:
        number = close(self.graph, self.track, true_m, first_s, last_s, error_m)
        record = self.graph.closure(number)
        self.closures.append(
            Closure(
                time_s=float(last_s),
                origin=SHEET,
                target=SHEET,
                origin_anchor=record.origin,
                target_anchor=record.target,
                offset_m=record.offset_m,
                covariance_m2=record.covariance_m2,
                residual=0.01,
                misfit=1.0,
                axis_deg=None,
                origin_reckoned_m=_at(self.track, first_s),
                target_reckoned_m=_at(self.track, last_s),
                stage=Stage.CONSISTENT,
                number=number,
                active=True,
            )
        )


def _at(track: Track, time_s: int) -> Array:
    return track.position_at(float(time_s))


def _audited(mission: Mission) -> Mission:
    mission.judgement.audit(mission.closures, mission.graph)
    mission.graph.update()
    return mission


def _settled(mission: Mission) -> Mission:
    """Let a doubt that an audit leaves be solved, as a worker would."""
    doubt = mission.judgement.doubt(mission.closures, mission.graph)
    assert doubt is not None
    false = doubt.run()
    assert false is not None
    mission.judgement.settle(doubt, false, mission.closures, mission.graph)
    mission.graph.update()
    return mission


@pytest.mark.parametrize("seed", range(4))
def test_doubt_throws_out_the_false_closures_and_no_true_one(seed: int) -> None:
    mission = Mission(seed, true=20, false=9)
    before_m = mission.error_m()
    _settled(_audited(mission))
    assert mission.thrown_out() == [False] * 20 + [True] * 9
    assert mission.error_m() < before_m
    assert mission.judgement.counters["closures_thrown_out"] <= 9


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(("false", "wrong_m"), [(1, 40.0), (3, 15.0), (6, 12.0)])
def test_audits_and_doubts_come_to_rest(seed: int, false: int, wrong_m: float) -> None:
    mission = Mission(seed, 20, false, wrong_m)
    for _ in range(4):
        _audited(mission)
        doubt = mission.judgement.doubt(mission.closures, mission.graph)
        if doubt is None:
            break
        _settled(mission)
    assert doubt is None
    assert mission.thrown_out()[:20].count(True) <= 1


def test_audit_alone_takes_back_true_closures() -> None:
    audited = [_audited(Mission(seed, true=20, false=9)).thrown_out() for seed in range(4)]
    assert sum(out[:20].count(True) for out in audited) > 8


def test_true_closure_that_was_taken_back_is_restored() -> None:
    mission = Mission(5, true=20, false=0)
    mission.closures[3].active = False
    mission.graph.set_active(mission.closures[3].number or 0, active=False)
    mission.graph.update()
    _settled(mission)
    assert not any(mission.thrown_out())
    assert mission.judgement.counters["closures_restored"] == 1


def test_closures_that_agree_leave_no_doubt() -> None:
    mission = _audited(Mission(6, true=20, false=0))
    assert not any(mission.thrown_out())
    assert mission.judgement.doubt(mission.closures, mission.graph) is None


def test_closure_that_was_composed_meanwhile_is_passed_over() -> None:
    mission = Mission(7, true=20, false=9)
    _audited(mission)
    doubt = mission.judgement.doubt(mission.closures, mission.graph)
    assert doubt is not None
    false = doubt.run()
    assert false is not None
    del mission.graph._ledger[mission.closures[-1].number or 0]
    mission.judgement.settle(doubt, false, mission.closures, mission.graph)
    assert mission.thrown_out()[20:-1] == [True] * 8


def test_hopeless_doubt_ends() -> None:
    """Closures that contradict each other all alike: whatever is left, the solution ends."""
    mission = Mission(8, true=1, false=0)
    rng, graph = np.random.default_rng(8), PoseGraph(mission.graph._settings)
    graph = started(mission.track, 0, graph)
    numbers = [
        close(graph, mission.track, mission.true_m, 100, 1100, rng.normal(0.0, 500.0, 2))
        for _ in range(12)
    ]
    graph.update()
    false = graph.doubt(dict.fromkeys(numbers, True), LIMITS).run()
    assert false is not None
    assert len(false) >= 10


def test_doubt_without_a_solution_says_so() -> None:
    mission = Mission(9, true=3, false=0)
    numbers = [closure.number or 0 for closure in mission.closures]
    doubt = mission.graph.doubt(dict.fromkeys(numbers, True), LIMITS)
    doubt = dataclasses.replace(doubt, believed=())
    assert doubt.run() is None
