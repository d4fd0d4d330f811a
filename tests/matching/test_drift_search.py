"""A drift that moves all of a vehicle's pairs is found where no pair of them tells it alone."""

import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest

from firmware.geometry import Array
from firmware.leader.atlas import Sheet, SheetId, sheet_of
from firmware.leader.coarse_grid import coarse
from firmware.leader.drift_search import DriftSearch
from firmware.leader.match_job import MatchJob
from firmware.leader.matches import MatchingSettings, PairSigmas
from firmware.leader.wander import Wandering, mean_drift
from firmware.submaps import GriddedSubmap, Track
from tests.leader.sheets import LOOK
from tests.matching.scenes import Scene

DRIFT_MPS = np.array([0.12, -0.09])
SPEED_MPS, SUBMAP_S, LINES_M = 2.0, 40.0, 60.0
WIDTH_CELLS, CELL_M = 51, 2.0
STEADY = Wandering(noise=0.05, walk=1e-5, apart=1e-5)


class Swell:
    """A seabed of long, faint waves."""

    def __init__(self, rng: np.random.Generator, height_m: float = 0.3) -> None:
        lengths_m, ways_rad = rng.uniform(90.0, 250.0, 12), rng.uniform(0.0, np.pi, 12)
        self._waves = 2.0 * np.pi / lengths_m * np.array([np.cos(ways_rad), np.sin(ways_rad)])
        self._phases = rng.uniform(0.0, 2.0 * np.pi, 12)
        self._height_m = height_m / np.sqrt(6.0)

    def at(self, north_m: Array, east_m: Array) -> Array:
        waves = np.tensordot(north_m, self._waves[0], 0) + np.tensordot(east_m, self._waves[1], 0)
        return np.asarray(40.0 + self._height_m * np.sin(waves + self._phases).sum(axis=-1))


class Ridges(Swell):
    """A seabed whose waves all run one way, for ever."""

    def __init__(self, rng: np.random.Generator, way_rad: float) -> None:
        super().__init__(rng, height_m=0.4)
        towards = np.array([np.cos(way_rad), np.sin(way_rad)])
        self._waves = np.outer(towards, np.hypot(*self._waves))


def _sheet(submap: int, seabed: Swell, rng: np.random.Generator) -> Sheet:
    """Return a sub-map, by dead reckoning, of a line north and of one back beside it."""
    times_s = SUBMAP_S * submap + np.arange(SUBMAP_S + 1.0)
    out_s, is_back = 6 * SUBMAP_S, submap >= 6
    north_m = SPEED_MPS * np.where(is_back, 2 * out_s - times_s, times_s)
    east_m = np.full(times_s.size, LINES_M * is_back)
    reckoned_m = np.column_stack([north_m, east_m]) + np.outer(times_s, DRIFT_MPS)
    heading_rad = np.pi * is_back
    first_m = np.floor(reckoned_m.min(axis=0) / CELL_M) * CELL_M - [0.0, WIDTH_CELLS // 2 * CELL_M]
    shape = (int(SPEED_MPS * SUBMAP_S / CELL_M), WIDTH_CELLS)
    north, east = (
        first + CELL_M * np.arange(cells) for first, cells in zip(first_m, shape, strict=True)
    )
    order = np.argsort(reckoned_m[:, 0])
    seen_s = np.interp(north, reckoned_m[order, 0], times_s[order])[:, None] + np.zeros(shape)
    mesh = np.meshgrid(north, east, indexing="ij")
    depth_m = seabed.at(*(side - rate * seen_s for side, rate in zip(mesh, DRIFT_MPS, strict=True)))
    sheet = sheet_of(
        SheetId(vehicle=0, boot_epoch=0, submap=submap),
        Track(
            time_s=times_s,
            north_m=reckoned_m[:, 0],
            east_m=reckoned_m[:, 1],
            yaw_rad=np.full(times_s.size, heading_rad),
        ),
        GriddedSubmap(
            north0_m=first_m[0],
            east0_m=first_m[1],
            cell_m=CELL_M,
            depth_m=depth_m + 0.1 * rng.standard_normal(shape),
            variance_m2=np.full(shape, 0.01),
            time_s=seen_s,
        ),
    )
    assert sheet is not None
    return sheet


def _jobs(seabed: Swell, rng: np.random.Generator, tilt: float = 0.0) -> Iterator[MatchJob]:
    """Yield the pairs of both lines, side by side, none of whose offsets is known."""
    sheets = [_sheet(submap, seabed, rng) for submap in range(12)]
    for origin, target in ((sheets[k], sheets[11 - k]) for k in range(5)):
        lag_s = target.time_s - origin.time_s
        across_m = CELL_M * np.arange(WIDTH_CELLS)
        yield MatchJob(
            origin=origin,
            target=target,
            origin_grid=origin.grid,
            target_grid=dataclasses.replace(
                target.grid, depth_m=target.grid.depth_m + tilt * across_m
            ),
            origin_drift_mps=np.zeros(2),
            target_drift_mps=np.zeros(2),
            prior_shift_m=np.zeros(2),
            prior_covariance_m2=np.eye(2) * (0.2 * lag_s) ** 2,
            settings=MatchingSettings(),
            sigmas=PairSigmas(offset_m=0.03, tilt=5e-4, bend_per_m=3e-6),
            looks=(LOOK, LOOK),
        )


def _search(jobs: Iterator[MatchJob]) -> DriftSearch:
    return DriftSearch(jobs=tuple(jobs), wandering=STEADY, drift_sigma_mps=0.2)


@pytest.mark.parametrize("seed", range(4))
def test_drift_is_found_that_no_pair_tells(seed: int) -> None:
    rng = np.random.default_rng(seed)
    search = _search(_jobs(Swell(rng), rng))
    assert all(job.run().match is None for job in search.jobs)
    found = search.run()
    assert found is not None
    job = search.jobs[found.pair]
    assert job.origin.id.submap == 0  # the passes farthest apart in time
    lag_s = job.target.time_s - job.origin.time_s
    off_m = found.hint.shift_m + DRIFT_MPS * lag_s
    assert off_m @ np.linalg.solve(found.hint.covariance_m2, off_m) < 9.2
    assert np.linalg.eigvalsh(found.hint.covariance_m2)[-1] < 9.0**2


def test_level_seabed_tells_no_drift() -> None:
    rng = np.random.default_rng(1)
    assert _search(_jobs(Swell(rng, height_m=0.0), rng)).run() is None


@pytest.mark.parametrize(("seed", "way_rad"), [(0, 2.3), (1, 2.3), (3, 0.4), (3, 2.3)])
def test_ridges_that_go_on_tell_no_drift(seed: int, way_rad: float) -> None:
    """That sub-maps overlap at all would tell how far along it they lie: forty metres off."""
    rng = np.random.default_rng(seed)
    assert _search(_jobs(Ridges(rng, way_rad), rng)).run() is None


def test_pairs_that_fit_nowhere_tell_no_drift() -> None:
    """A roll bias that was never calibrated explains more than any drift does."""
    rng = np.random.default_rng(2)
    assert _search(_jobs(Swell(rng), rng, tilt=0.1)).run() is None


def test_coarse_cells_are_means_of_the_known_ones() -> None:
    grid = Scene(1).submap(100.0, 120.0, (5, 6), sigma_m=0.1)
    grid.depth_m[0, 0], grid.depth_m[2:4, 2:4], grid.time_s[0, 1] = np.nan, np.nan, np.nan
    found = coarse(grid)
    assert (found.north0_m, found.east0_m, found.cell_m) == (101.0, 121.0, 4.0)
    assert found.depth_m.shape == (2, 3)
    assert found.depth_m[0, 1] == pytest.approx(grid.depth_m[:2, 2:4].mean())
    assert found.depth_m[0, 0] == pytest.approx(np.nanmean(grid.depth_m[:2, :2]))
    assert found.time_s[0, 0] == pytest.approx(grid.time_s[1, :2].mean())
    assert np.isnan(found.depth_m[1, 1])
    assert found.variance_m2[0, 0] == pytest.approx(0.01 / 3)
    rebuilt = coarse(dataclasses.replace(grid, reconstructed=True))
    assert rebuilt.variance_m2[0, 0] == pytest.approx(0.01)


@pytest.mark.parametrize("span_s", [(0.0, 400.0), (0.0, 90.0), (130.0, 370.0)])
def test_mean_drift_agrees_with_drawn_ones(span_s: tuple[float, float]) -> None:
    rng, duration_s, drift_mps = np.random.default_rng(3), 400.0, 0.1
    walking = Wandering(noise=0.3, walk=0.006, apart=0.0)
    steps = rng.standard_normal((20_000, int(duration_s)))
    drifts = drift_mps * rng.standard_normal((20_000, 1)) + walking.walk * np.cumsum(steps, axis=1)
    moved_m = drifts + walking.noise * rng.standard_normal(drifts.shape)
    mean_mps = moved_m.sum(axis=1) / duration_s
    within_m = moved_m[:, int(span_s[0]) : int(span_s[1])].sum(axis=1)
    gain_s = float(mean_mps @ within_m / (mean_mps @ mean_mps))
    known = mean_drift(span_s, duration_s, walking, drift_mps)
    assert known.variance_m2ps2 == pytest.approx(np.var(mean_mps), rel=0.05)
    assert known.gain_s == pytest.approx(gain_s, rel=0.02)
    assert known.left_m2 == pytest.approx(np.var(within_m - gain_s * mean_mps), rel=0.05, abs=1e-6)
