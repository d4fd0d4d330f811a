"""A pair that a match left open is looked at again once its offset is known much better."""

import dataclasses
from unittest.mock import MagicMock

import numpy as np
import pytest

from firmware.leader import loop_closing, offsets, open_pairs
from firmware.leader.atlas import Atlas, Sheet
from firmware.leader.closure_settings import ClosureSettings
from firmware.leader.closures import closure_of, enter_hint
from firmware.leader.estimate import Estimate
from firmware.leader.judgement import Judgement, JudgementSettings
from firmware.leader.ledger import Anchor
from firmware.leader.loop_closing import LoopClosing
from firmware.leader.match_job import MatchJob
from firmware.leader.match_jobs import jobs_again
from firmware.leader.matches import ANY_PAIR, Hint, Match, MatchingSettings, MatchOutcome, NoMatch
from firmware.leader.offsets import Offsets
from firmware.leader.open_pairs import OpenPairs
from firmware.leader.pairing import Calibrations
from firmware.leader.pose_graph import PoseGraph
from firmware.leader.settings import LeaderSettings
from tests.leader.sheets import LOOK, job_of, northward, sheet_at, two_sheets

AMBIGUOUS = MatchOutcome(match=None, reason=NoMatch.AMBIGUOUS)
UNSETTLED = MatchOutcome(match=None, reason=NoMatch.UNSETTLED)


@pytest.fixture
def graph() -> PoseGraph:
    return northward()


@pytest.fixture
def atlas() -> Atlas:
    atlas = Atlas(8)
    for submap in range(4):
        atlas.add(sheet_at(submap))
    return atlas


def _assert_turn(
    pairs: OpenPairs, atlas: Atlas, graph: PoseGraph, target: Sheet, origin: Sheet, radius_m: float
) -> None:
    ((looked_at, partners),) = pairs.turns(sheet_at(9), atlas, graph)
    assert looked_at is target
    ((partner, pair),) = partners
    assert (partner, pair.hint) == (origin, None)
    assert pair.radius_m == pytest.approx(radius_m)


def _second_looks(pairs: OpenPairs, sheet: Sheet, atlas: Atlas, graph: PoseGraph) -> list[MatchJob]:
    turns, calibrations = pairs.turns(sheet, atlas, graph), Calibrations(MatchingSettings())
    return pairs.second_looks(turns, Offsets(graph), graph, calibrations)


def _sheets(atlas: Atlas) -> list[Sheet]:
    return list(atlas)


def test_ambiguous_pair_stays_open_with_its_radius_and_its_hint(
    atlas: Atlas, graph: PoseGraph
) -> None:
    first, second, *_ = _sheets(atlas)
    pairs = OpenPairs(ClosureSettings())
    pairs.note(job_of(first, second, 16.0), AMBIGUOUS)
    pairs.note_hint(first.id, second.id, None)
    pairs.note(job_of(first, second, 4.0), AMBIGUOUS)
    _assert_turn(pairs, atlas, graph, second, first, 4.0)


def test_settled_and_impossible_pairs_are_forgotten(atlas: Atlas, graph: PoseGraph) -> None:
    first, second, third, _ = _sheets(atlas)
    pairs = OpenPairs(ClosureSettings())
    for origin in (first, second):
        pairs.note(job_of(origin, third, 16.0), AMBIGUOUS)
    pairs.settle(first.id, third.id)
    _assert_turn(pairs, atlas, graph, third, second, 16.0)
    pairs.note(job_of(second, third, 3.0), UNSETTLED)
    assert pairs.turns(sheet_at(9), atlas, graph) == []
    assert len(pairs) == 0


def test_sheets_take_turns_and_shelved_ones_are_left_out(atlas: Atlas, graph: PoseGraph) -> None:
    first, second, third, fourth = _sheets(atlas)
    pairs = OpenPairs(ClosureSettings(second_looks=1))
    for target in (second, third, fourth):
        pairs.note(job_of(first, target, 16.0), AMBIGUOUS)
    atlas.shelve(third.id)
    turns = []
    for _ in range(3):
        turns += [target for target, _ in pairs.turns(sheet_at(9), atlas, graph)]
        _second_looks(pairs, sheet_at(9), atlas, graph)
    assert turns == [second, fourth, second]


def test_longest_unseen_sheets_go_when_there_are_too_many(atlas: Atlas) -> None:
    first, second, third, fourth = _sheets(atlas)
    pairs = OpenPairs(ClosureSettings(open_submaps=2))
    for target in (second, third, fourth):
        pairs.note(job_of(first, target, 16.0), AMBIGUOUS)
    assert len(pairs) == 2
    assert pairs.hint(first.id, second.id) is None


def test_pair_whose_hint_was_composed_away_is_passed_over(atlas: Atlas, graph: PoseGraph) -> None:
    first, second, *_ = _sheets(atlas)
    pairs = OpenPairs(ClosureSettings())
    pairs.note(job_of(first, second, 16.0), AMBIGUOUS)
    pairs.note_hint(first.id, second.id, 10_000)
    assert pairs.hint(first.id, second.id) == 10_000
    assert 10_000 not in graph
    assert pairs.turns(sheet_at(9), atlas, graph) == []


def _looks(graph: PoseGraph, then_m: float, hint: int | None = None) -> list[MatchJob]:
    origin, target = two_sheets()
    calibrations = Calibrations(MatchingSettings())
    (offset,) = Offsets(graph).of([(origin, target)])
    return jobs_again(target, [(offset, then_m, hint)], graph, ClosureSettings(), calibrations)


def test_only_a_much_better_known_offset_is_worth_a_second_look(graph: PoseGraph) -> None:
    (job,) = _looks(graph, 1e6)
    limit_m = job.prior_radius_m / ClosureSettings().second_look_share
    assert len(_looks(graph, 1.01 * limit_m)) == 1
    assert _looks(graph, 0.99 * limit_m) == []


def test_what_is_not_known_of_a_pair_changes_no_setting(graph: PoseGraph) -> None:
    (job,) = _looks(graph, 1e6)
    assert job.settings == MatchingSettings()
    assert job.sigmas != ANY_PAIR


def test_what_the_pair_itself_has_told_does_not_make_it_better_known(graph: PoseGraph) -> None:
    (before,) = _looks(graph, 1e6)
    hint = enter_hint(
        before,
        Hint(shift_m=np.array([7.0, -4.0]), covariance_m2=0.1 * before.prior_covariance_m2),
        graph,
        dataclasses.replace(ClosureSettings(), hint_prior_m=0.0),
    )
    graph.update()
    (deceived,) = _looks(graph, 1e6)
    assert deceived.prior_sigma_m < 0.6 * before.prior_sigma_m
    (after,) = _looks(graph, 1e6, hint)
    assert after.prior_covariance_m2 == pytest.approx(
        before.prior_covariance_m2, rel=1e-3, abs=1e-3
    )
    assert after.prior_shift_m == pytest.approx(before.prior_shift_m, abs=5e-2)
    assert _looks(graph, before.prior_radius_m, hint) == []


def test_closure_is_told_where_the_sonar_really_looked(graph: PoseGraph) -> None:
    (job,) = _looks(graph, 1e6)
    grid = job.origin.grid
    found = Match(
        shift_m=np.zeros(2),
        covariance_m2=np.eye(2),
        residual=0.01,
        overlap_cells=100,
        axis_deg=None,
        misfit=1.0,
        centre_m=np.array([grid.north0_m, grid.east0_m]),
        reference_time_s=job.origin.time_s,
        query_time_s=job.target.time_s,
    )
    rolled = dataclasses.replace(LOOK, errors=np.array([0.01, 0.0]))
    outcome = MatchOutcome(match=found, reason=None)
    closures = [
        closure_of(dataclasses.replace(job, looks=looks), outcome, graph, 200.0)
        for looks in ((LOOK, LOOK), (rolled, LOOK))
    ]
    assert closures[0] is not None
    assert closures[1] is not None
    aside_m = closures[1].offset_m - closures[0].offset_m
    assert aside_m == pytest.approx([0.0, 0.01 * LOOK.altitude_m])


def test_no_sheet_has_two_turns_beside_a_new_one(atlas: Atlas, graph: PoseGraph) -> None:
    first, second, third, fourth = _sheets(atlas)
    pairs = OpenPairs(ClosureSettings(second_look_share=1e6))
    for target in (second, third):
        pairs.note(job_of(first, target, 16.0), AMBIGUOUS)
    atlas.shelve(second.id)
    _second_looks(pairs, fourth, atlas, graph)
    assert len(pairs) == 1
    assert _second_looks(pairs, third, atlas, graph) == []


def test_a_second_look_that_raises_takes_nothing_else_along(
    atlas: Atlas, graph: PoseGraph, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where what a pair has told is all that is known of it."""
    first, second, third, fourth = _sheets(atlas)
    closing = LoopClosing(graph, atlas, LeaderSettings())
    for target in (second, third):
        closing._open.note(job_of(first, target, 1e6), AMBIGUOUS)
    closing.add(fourth)
    closing._doubt = doubt = MagicMock()

    def looks(sheet: Sheet, *_: object) -> list[MatchJob]:
        if sheet is third:
            raise np.linalg.LinAlgError("Singular matrix")
        return [job_of(first, sheet, 1.0)]

    monkeypatch.setattr(open_pairs, "jobs_again", looks)
    batch = closing.next_jobs()
    assert batch is not None
    assert (batch.sheet, batch.doubt) == (fourth, doubt)
    assert second in [job.target for job in batch.jobs]
    assert closing.status()["second_looks_raised"] == 1


def test_offsets_that_raise_leave_a_sheet_its_first_looks(
    atlas: Atlas, graph: PoseGraph, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second, third, fourth = _sheets(atlas)
    settings = ClosureSettings(expected_overlap_m2=0.0, screened_per_submap=2)
    closing = LoopClosing(graph, atlas, LeaderSettings(closures=settings))
    closing._open.note(job_of(third, fourth, 1e6), AMBIGUOUS)
    closing.add(sheet_at(9, 100.0))

    def anchor_of(sheet: Sheet, estimate: Estimate) -> Anchor:
        if sheet is fourth:
            raise ValueError("no such row")
        return estimate.anchor(sheet.id.chain, sheet.time_s, sheet.track)

    monkeypatch.setattr(offsets, "anchor_of", anchor_of)
    batch = closing.next_jobs()
    assert batch is not None
    assert [job.origin for job in batch.jobs] == [first, second]
    assert closing.status()["second_looks_raised"] == 1


def test_first_looks_that_raise_leave_a_sheet_its_second_ones(
    atlas: Atlas, graph: PoseGraph, monkeypatch: pytest.MonkeyPatch
) -> None:
    closing = LoopClosing(graph, atlas, LeaderSettings())
    closing.add(_sheets(atlas)[0])
    monkeypatch.setattr(loop_closing, "jobs_for", MagicMock(side_effect=ValueError("no such grid")))
    batch = closing.next_jobs()
    assert batch is not None
    assert batch.jobs == ()
    assert closing.status()["submaps_unmatched"] == 1


@pytest.mark.parametrize("outcome", [AMBIGUOUS, UNSETTLED])
def test_neighbouring_pairs_together_tell_less_than_two(
    graph: PoseGraph, outcome: MatchOutcome
) -> None:
    """Hints of one false hill, seen from many sub-maps, do not outvote what is known otherwise."""
    (job,) = _looks(graph, 1e6)
    hint = Hint(shift_m=np.array([7.0, -4.0]), covariance_m2=0.1 * job.prior_covariance_m2)
    pairs = OpenPairs(dataclasses.replace(ClosureSettings(), hint_prior_m=0.0))
    judgement = Judgement(JudgementSettings(), Calibrations(MatchingSettings()))
    entered_m2 = []
    for k, apart_s in enumerate((0.0, 20.0, 40.0, 100.0)):
        target = dataclasses.replace(
            job.target,
            id=dataclasses.replace(job.target.id, submap=10 + k),
            time_s=job.target.time_s + apart_s,
        )
        again = dataclasses.replace(job, target=target)
        pairs.keep_or_settle(again, dataclasses.replace(outcome, hint=hint), graph, judgement)
        entered_m2.append(graph.closure(next(reversed(pairs._heard))).covariance_m2)
    assert len(pairs._heard) == 4
    lone_m2 = entered_m2[0] - hint.covariance_m2  # of the walk of dead reckoning
    for covariance_m2, said_before in zip(entered_m2, (0, 1, 2, 2), strict=True):
        told_m2 = (1 + said_before) ** 2 * hint.covariance_m2
        assert covariance_m2 - lone_m2 == pytest.approx(told_m2)


def test_match_takes_the_place_of_the_hint(graph: PoseGraph) -> None:
    (job,) = _looks(graph, 1e6)
    hint = Hint(shift_m=np.array([7.0, -4.0]), covariance_m2=0.1 * job.prior_covariance_m2)
    pairs = OpenPairs(dataclasses.replace(ClosureSettings(), hint_prior_m=0.0))
    judgement = Judgement(JudgementSettings(), Calibrations(MatchingSettings()))
    pairs.keep_or_settle(job, dataclasses.replace(AMBIGUOUS, hint=hint), graph, judgement)
    number = pairs.hint(job.origin.id, job.target.id)
    assert graph.is_active(number)
    pairs.keep_or_settle(job, dataclasses.replace(AMBIGUOUS, hint=hint), graph, judgement)
    assert pairs.hint(job.origin.id, job.target.id) == number
    assert judgement.counters["hints_taken"] == 1
    found = MatchOutcome(match=MagicMock(), reason=None)
    pairs.keep_or_settle(job, found, graph, judgement)
    assert not graph.is_active(number)
    assert len(pairs) == 0
    assert not pairs._heard  # once the graph has let it go it would be taken for composed
