"""What keeps a long mission's memory bounded: packed sub-maps, covered places, rows of closures."""

import pickle
from typing import cast
from unittest.mock import MagicMock

import numpy as np
import pytest

from firmware.leader import closure_log
from firmware.leader.atlas import Atlas, Sheet, SheetId, sheet_of
from firmware.leader.closure_log import ClosureLog, verdict_of
from firmware.leader.closures import Closure, Stage
from firmware.leader.coverage import CoverageSettings, redundant
from firmware.leader.judgement import Judgement, JudgementSettings
from firmware.leader.ledger import Anchor
from firmware.leader.match_job import MatchJob
from firmware.leader.match_jobs import SheetJobs
from firmware.leader.matches import MatchingSettings, MatchOutcome, NoMatch
from firmware.leader.pairing import Calibrations
from firmware.leader.shelf import MemoryShelf, packed, unpacked
from firmware.submaps import GriddedSubmap, Track


def grid_at(north_m: float, seed: int) -> GriddedSubmap:
    rng = np.random.default_rng(seed)
    depth_m = rng.normal(50.0, 2.0, (40, 70))
    depth_m[:3] = np.nan
    known = np.isfinite(depth_m)
    return GriddedSubmap(
        north0_m=north_m,
        east0_m=-70.0,
        cell_m=2.0,
        depth_m=depth_m,
        variance_m2=np.where(known, 0.01, np.nan),
        time_s=np.where(known, 86_000.0 + rng.uniform(0, 40, depth_m.shape), np.nan),
    )


def sheet_at(north_m: float, submap: int) -> Sheet:
    time_s = 40.0 * submap + np.arange(40.0)
    track = Track(time_s=time_s, north_m=north_m + time_s, east_m=0 * time_s, yaw_rad=0 * time_s)
    sheet = sheet_of(
        SheetId(vehicle=0, boot_epoch=0, submap=submap),
        track,
        grid_at(north_m, seed=submap),
    )
    assert sheet is not None
    return sheet


def closure_at(time_s: float, axis_deg: float | None) -> Closure:
    ids = [SheetId(vehicle=v, boot_epoch=17, submap=60_000 + v) for v in (0, 3)]
    ends = [Anchor(key=k, parameters=0, offset_m=np.zeros(2), time_s=time_s - k) for k in (1, 2)]
    return Closure(
        time_s=time_s,
        origin=ids[0],
        target=ids[1],
        origin_anchor=ends[0],
        target_anchor=ends[1],
        offset_m=np.array([1 / 3, -2.0]),
        covariance_m2=np.array([[0.3, 0.1], [0.1, 0.4]]),
        residual=0.01,
        misfit=1.0,
        axis_deg=axis_deg,
        origin_reckoned_m=np.zeros(2),
        target_reckoned_m=np.zeros(2),
        stage=Stage.CONSISTENT,
        number=7,
        active=True,
    )


def test_packed_grid_reads_back_to_tenths_of_a_millimetre() -> None:
    grid = grid_at(1234.5, seed=5)
    body = packed(grid)
    back = unpacked(body)
    assert (back.north0_m, back.east0_m, back.cell_m) == (1234.5, -70.0, 2.0)
    np.testing.assert_allclose(back.depth_m, grid.depth_m, atol=1e-4)
    np.testing.assert_allclose(back.variance_m2, grid.variance_m2, rtol=1e-6)
    np.testing.assert_allclose(back.time_s, grid.time_s, atol=1e-4)
    assert len(body) < 0.5 * 3 * grid.depth_m.nbytes


def test_shelved_sheet_is_not_matched_but_stays_part_of_the_map() -> None:
    atlas = Atlas(10)
    sheets = [sheet_at(0.0, k) for k in range(3)]
    for sheet in sheets:
        atlas.add(sheet)
    atlas.shelve(sheets[0].id)
    assert [sheet.id.submap for sheet in atlas] == [1, 2]
    assert sheets[0].id not in atlas
    grids = list(atlas.grids())
    assert len(grids) == 3
    np.testing.assert_allclose(grids[0][1].depth_m, sheets[0].grid.depth_m, atol=1e-4)
    for k in range(3, 14):
        atlas.add(sheet_at(0.0, k))
    assert (len(list(atlas.grids())), atlas.dropped) == (10, 4)


def test_what_the_atlas_drops_leaves_its_shelf() -> None:
    shelf = MemoryShelf()
    atlas = Atlas(3, shelf)
    for submap in range(6):
        atlas.add(sheet_at(0.0, submap))
        atlas.shelve(SheetId(vehicle=0, boot_epoch=0, submap=submap))
    assert atlas.dropped == 3
    assert [shelf.get(f"0/0/{submap}") is None for submap in range(6)] == [True] * 3 + [False] * 3


class FullShelf(MemoryShelf):
    """Takes one body, and no more."""

    def put(self, name: str, body: bytes) -> bool:
        return not self._bodies and super().put(name, body)


def test_what_the_shelf_refuses_stays_part_of_the_map_and_of_a_checkpoint() -> None:
    shelf = FullShelf()
    atlas = Atlas(3, shelf)
    sheets = [sheet_at(0.0, submap) for submap in range(3)]
    for sheet in sheets:
        atlas.add(sheet)
        atlas.shelve(sheet.id)
    resumed = pickle.loads(pickle.dumps(atlas))
    resumed.shelf = shelf
    for each in (atlas, resumed):
        depths_m = [grid.depth_m for _, grid in each.grids()]
        for depth_m, sheet in zip(depths_m, sheets, strict=True):
            np.testing.assert_allclose(depth_m, sheet.grid.depth_m, atol=1e-4)
    for submap in range(3, 6):
        atlas.add(sheet_at(0.0, submap))
    assert not any(each.get("0/0/1") for each in (shelf, atlas._refused))


def test_a_match_that_fails_is_a_reason_not_the_end_of_its_batch(
    caplog: pytest.LogCaptureFixture,
) -> None:
    class Broken:
        origin, target = sheet_at(0.0, 0), sheet_at(0.0, 1)

        def run(self) -> MatchOutcome:
            raise ValueError("no such grid")

    jobs = cast("tuple[MatchJob, ...]", (Broken(), Broken()))
    findings = SheetJobs(sheet=Broken.target, jobs=jobs).run()
    assert [outcome.reason for outcome in findings.outcomes] == [NoMatch.RAISED] * 2
    assert "the match of" in caplog.text


def test_places_that_are_covered_need_no_further_sub_map() -> None:
    settings = CoverageSettings(layers=2)
    sheets = [sheet_at(0.0, k) for k in range(5)] + [sheet_at(500.0, 5)]
    found = redundant(sheets, np.zeros((6, 2)), settings)
    assert [sheet_id.submap for sheet_id in found] == [2, 3, 4]


def test_corrections_decide_which_place_is_covered() -> None:
    sheets = [sheet_at(0.0, k) for k in range(3)]
    moves_m = np.array([[0.0, 0.0], [300.0, 0.0], [600.0, 0.0]])
    assert redundant(sheets, moves_m, CoverageSettings(layers=1)) == []
    apart = [sheet_at(300.0 * k, k) for k in range(3)]
    moves_m = np.array([[0.0, 0.0], [-300.0, 0.0], [600.0, 0.0]])
    assert redundant(apart, moves_m, CoverageSettings(layers=1)) == [apart[1].id]


@pytest.mark.parametrize(("new_m", "needed"), [(10.0, False), (40.0, True)])
def test_a_sub_map_is_needed_where_a_good_part_of_it_is_new(new_m: float, *, needed: bool) -> None:
    sheets = [sheet_at(0.0, 0), sheet_at(new_m, 1)]
    found = redundant(sheets, np.zeros((2, 2)), CoverageSettings(layers=1))
    assert found == ([] if needed else [sheets[1].id])


def test_a_closure_whose_sub_map_was_dropped_meanwhile_is_asked_no_map() -> None:
    judgement = Judgement(JudgementSettings(), Calibrations(MatchingSettings()))
    closure = closure_at(900.0, None)
    closure.stage, closure.active, closure.predicted_sigma_m = Stage.GATED, False, 20.0
    judgement.consider([closure], Atlas(4), MagicMock())
    assert list(judgement._waiting) == [closure]


def test_verdicts_read_back_exactly() -> None:
    log, closures = ClosureLog(), [closure_at(86_399.25, None), closure_at(5.0, 45.0)]
    for closure in closures:
        log.add(closure)
    for verdict, closure in zip(log, closures, strict=True):
        expected = verdict_of(closure)
        np.testing.assert_array_equal(verdict.offset_m, expected.offset_m)
        np.testing.assert_array_equal(verdict.covariance_m2, expected.covariance_m2)
        assert (verdict.origin, verdict.target) == (expected.origin, expected.target)
        assert (verdict.time_s, verdict.origin_time_s) == (expected.time_s, expected.origin_time_s)
        assert (verdict.stage, verdict.active) == (expected.stage, expected.active)
        assert (verdict.axis_deg, verdict.residual) == (expected.axis_deg, expected.residual)


def test_oldest_verdicts_go_when_there_are_too_many(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(closure_log, "MOST", 3)
    log = ClosureLog()
    for k in range(5):
        log.add(closure_at(float(k), None))
    assert [verdict.time_s for verdict in log] == [2.0, 3.0, 4.0]
    assert log.overwritten == 2
