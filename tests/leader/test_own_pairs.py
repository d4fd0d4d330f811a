"""Pairs of one vehicle that gave no closure are weighed together while its drift is unknown."""

import dataclasses
from unittest.mock import MagicMock

import numpy as np
import pytest

from firmware.leader import own_pairs
from firmware.leader.atlas import Atlas, Sheet, SheetId
from firmware.leader.closure_settings import ClosureSettings
from firmware.leader.drift_search import DriftSearch, FoundDrift
from firmware.leader.judgement import Judgement, JudgementSettings
from firmware.leader.match_job import MatchJob
from firmware.leader.matches import Hint, Match, MatchingSettings, MatchOutcome, NoMatch
from firmware.leader.offsets import Offsets
from firmware.leader.open_pairs import OpenPairs
from firmware.leader.own_pairs import OwnPairs
from firmware.leader.pairing import Calibrations
from firmware.leader.pose_graph import PoseGraph
from firmware.leader.wander import Wandering
from protocol.errors import ConfigError
from tests.leader.sheets import job_of, northward, sheet_at

NOTHING = MatchOutcome(match=None, reason=NoMatch.UNSETTLED)
SETTINGS = ClosureSettings(drift_least_pairs=2, drift_known_mps=0.0, hint_prior_m=0.1)


def _sheet(submap: int, vehicle: int = 0) -> Sheet:
    """Return the sheet of so many times forty seconds."""
    sheet = sheet_at(submap, 40.0 * submap)
    return dataclasses.replace(
        sheet, id=SheetId(vehicle=vehicle, boot_epoch=0, submap=submap), time_s=40.0 * submap
    )


@pytest.fixture
def graph() -> PoseGraph:
    return northward()


@pytest.fixture
def atlas() -> Atlas:
    atlas = Atlas(16)
    for submap in range(6):
        atlas.add(_sheet(submap))
    return atlas


@pytest.fixture
def own() -> OwnPairs:
    """Return two pairs of a chain, the second of which spans the longer time."""
    own = OwnPairs(SETTINGS, 0.2)
    for first, second in ((1, 3), (0, 4)):
        own.note(job_of(_sheet(first), _sheet(second)), NOTHING)
    return own


@pytest.fixture
def calibrations() -> Calibrations:
    return Calibrations(MatchingSettings())


def _searched(
    own: OwnPairs, submap: int, atlas: Atlas, graph: PoseGraph, calibrations: Calibrations
) -> DriftSearch | None:
    return own.search(_sheet(submap), atlas, graph, Offsets(graph), calibrations)


def _spans(search: DriftSearch | None) -> set[tuple[int, int]]:
    assert search is not None
    return {(job.origin.id.submap, job.target.id.submap) for job in search.jobs}


def test_pairs_without_a_closure_are_searched_again_after_a_while(
    own: OwnPairs, atlas: Atlas, graph: PoseGraph, calibrations: Calibrations
) -> None:
    search = _searched(own, 4, atlas, graph, calibrations)
    assert _spans(search) == {(1, 3), (0, 4)}
    assert search is not None
    assert search.wandering == graph.wandering
    assert _searched(own, 5, atlas, graph, calibrations) is None  # forty seconds later
    assert _spans(_searched(own, 6, atlas, graph, calibrations)) == {(1, 3), (0, 4)}
    assert own.counters["drift_searches"] == 2


def test_known_drift_is_left_to_closures(
    atlas: Atlas, graph: PoseGraph, calibrations: Calibrations
) -> None:
    own = OwnPairs(dataclasses.replace(SETTINGS, drift_known_mps=1.0), 0.2)
    for first, second in ((1, 3), (0, 4)):
        own.note(job_of(_sheet(first), _sheet(second)), NOTHING)
    assert _searched(own, 4, atlas, graph, calibrations) is None


def test_only_pairs_of_one_chain_that_did_not_close_are_weighed(
    own: OwnPairs, atlas: Atlas, graph: PoseGraph, calibrations: Calibrations
) -> None:
    closed = MatchOutcome(match=MagicMock(Match), reason=None)
    own.note(job_of(_sheet(0), _sheet(3)), closed)
    own.note(job_of(_sheet(0, vehicle=1), _sheet(3)), NOTHING)
    own.note(job_of(_sheet(4), _sheet(0)), NOTHING)  # the other way round: it is known
    assert _spans(_searched(own, 4, atlas, graph, calibrations)) == {(1, 3), (0, 4)}


def test_pairs_of_the_same_soundings_are_weighed_once(
    own: OwnPairs, atlas: Atlas, graph: PoseGraph, calibrations: Calibrations
) -> None:
    near = dataclasses.replace(_sheet(5), time_s=170.0)
    atlas.add(near)
    own.note(job_of(_sheet(0), near), NOTHING)
    assert _spans(_searched(own, 4, atlas, graph, calibrations)) == {(1, 3), (0, 4)}


def test_pairs_that_closed_since_are_weighed_no_more(
    own: OwnPairs, atlas: Atlas, graph: PoseGraph, calibrations: Calibrations
) -> None:
    closed = MatchOutcome(match=MagicMock(Match), reason=None)
    raised = MatchOutcome(match=None, reason=NoMatch.RAISED)
    own.note(job_of(_sheet(2), _sheet(5)), NOTHING)
    own.note(job_of(_sheet(0), _sheet(4)), closed)
    own.note(job_of(_sheet(0), _sheet(5)), raised)
    assert _spans(_searched(own, 5, atlas, graph, calibrations)) == {(1, 3), (2, 5)}


def test_passes_of_long_ago_are_weighed_no_more(
    atlas: Atlas, graph: PoseGraph, calibrations: Calibrations
) -> None:
    own = OwnPairs(dataclasses.replace(SETTINGS, drift_memory_s=130.0), 0.2)
    for first, second in ((1, 3), (0, 4), (2, 4)):
        own.note(job_of(_sheet(first), _sheet(second)), NOTHING)
    assert _spans(_searched(own, 4, atlas, graph, calibrations)) == {(1, 3), (2, 4)}


def test_search_of_fewer_pairs_than_it_needs_is_refused() -> None:
    with pytest.raises(ConfigError, match="drift_least_pairs is 9"):
        ClosureSettings(drift_least_pairs=9)


def test_what_is_forgotten_is_weighed_no_more(
    own: OwnPairs, atlas: Atlas, graph: PoseGraph, calibrations: Calibrations
) -> None:
    own.forget(100.0)
    assert _searched(own, 4, atlas, graph, calibrations) is not None
    own.forget(1000.0)
    assert _searched(own, 9, atlas, graph, calibrations) is None


def _active(graph: PoseGraph) -> set[int]:
    return {number for number in range(graph.records) if graph.is_active(number)}


HINT = Hint(shift_m=np.array([3.0, -2.0]), covariance_m2=25.0 * np.eye(2))


def _search_of(*jobs: MatchJob) -> DriftSearch:
    wandering = Wandering(noise=0.2, walk=0.004, apart=0.001)
    return DriftSearch(jobs=jobs, wandering=wandering, drift_sigma_mps=0.2)


@pytest.mark.parametrize("is_turned", [False, True])
def test_what_is_found_takes_the_place_of_earlier_hints(
    own: OwnPairs, graph: PoseGraph, calibrations: Calibrations, *, is_turned: bool
) -> None:
    judgement, open_pairs = Judgement(JudgementSettings(), calibrations), OpenPairs(SETTINGS)
    before, job = _active(graph), job_of(_sheet(0), _sheet(4))
    looked = job_of(_sheet(4), _sheet(0)) if is_turned else job
    ambiguous = MatchOutcome(match=None, reason=NoMatch.AMBIGUOUS, hint=HINT)
    open_pairs.keep_or_settle(looked, ambiguous, graph, judgement)
    assert _active(graph) == before | {len(before)}
    for taken in range(1, 3):
        own.take(_search_of(job), FoundDrift(pair=0, hint=HINT), graph, judgement, open_pairs)
        assert _active(graph) == before | {len(before) + taken}
    open_pairs.keep_or_settle(looked, ambiguous, graph, judgement)  # told together with others
    own.take(_search_of(job), None, graph, judgement, open_pairs)
    assert _active(graph) == before | {len(before) + 2}
    assert own.counters["drifts_found"] == 2


def test_what_other_pairs_found_stays(
    own: OwnPairs, graph: PoseGraph, calibrations: Calibrations
) -> None:
    judgement, open_pairs = Judgement(JudgementSettings(), calibrations), OpenPairs(SETTINGS)
    before = len(_active(graph))
    for first, second in ((0, 4), (1, 3)):
        search = _search_of(job_of(_sheet(first), _sheet(second)))
        own.take(search, FoundDrift(pair=0, hint=HINT), graph, judgement, open_pairs)
    assert len(_active(graph)) == before + 2


def test_what_was_composed_is_not_remembered(
    own: OwnPairs, graph: PoseGraph, calibrations: Calibrations
) -> None:
    judgement, open_pairs = Judgement(JudgementSettings(), calibrations), OpenPairs(SETTINGS)
    for first, second in ((0, 4), (1, 3)):
        search = _search_of(job_of(_sheet(first), _sheet(second)))
        own.take(search, FoundDrift(pair=0, hint=HINT), graph, judgement, open_pairs)
        (number,) = own._of[0].hints
        graph._ledger.pop(number)


def test_what_a_closure_tells_is_not_told_again(
    own: OwnPairs, graph: PoseGraph, calibrations: Calibrations
) -> None:
    judgement, open_pairs = Judgement(JudgementSettings(), calibrations), OpenPairs(SETTINGS)
    before, closing = _active(graph), job_of(_sheet(1), _sheet(3))
    search = _search_of(job_of(_sheet(0), _sheet(4)), closing)
    own.note(closing, MatchOutcome(match=MagicMock(Match), reason=None))
    own.take(search, FoundDrift(pair=0, hint=HINT), graph, judgement, open_pairs)
    assert _active(graph) == before
    assert own.counters["drifts_superseded"] == 1


def test_search_that_cannot_be_made_is_counted(
    own: OwnPairs,
    atlas: Atlas,
    graph: PoseGraph,
    calibrations: Calibrations,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(own_pairs, "jobs_of", MagicMock(side_effect=ValueError))
    assert _searched(own, 4, atlas, graph, calibrations) is None
    assert own.counters["drift_searches_raised"] == 1
