import dataclasses

import numpy as np
import pytest

from firmware.geometry import Array
from firmware.leader.calibration import Calibration, CalibrationSettings, Overlap
from firmware.leader.matches import MatchingSettings
from firmware.leader.pair_problem import noise_model
from firmware.leader.swath import levelled, swath_of
from firmware.submaps import GriddedSubmap, Track
from tests.matching.scenes import CELL_M, Scene

ROLL_RAD, SMILE = 0.0035, 0.0023
STILL = np.zeros(2)
NOISE = noise_model(MatchingSettings(), 0.0)


def line(scene: Scene, east_m: float, *, northward: bool) -> tuple[GriddedSubmap, Track]:
    """Return 80 m of a line along north at east_m with a swath of 62 m each way, and its track."""
    grid = scene.submap(300.0, east_m - 62.0, (41, 63))
    time_s = np.arange(41.0)
    north_m = 300.0 + CELL_M * (time_s if northward else time_s[::-1])
    track = Track(
        time_s=time_s,
        north_m=north_m,
        east_m=np.full(41, east_m),
        yaw_rad=np.full(41, 0.0 if northward else np.pi),
    )
    rows = time_s if northward else time_s[::-1]
    grid = dataclasses.replace(grid, time_s=np.repeat(rows[:, None], 63, axis=1))
    swath = swath_of(grid, track, STILL, 20.0)
    return levelled(grid, swath, np.array([-ROLL_RAD, -SMILE])), track


def overlap(scene: Scene, apart_m: float, sigma_m: float, away_m: Array = STILL) -> Overlap:
    grids = [line(scene, 300.0, northward=True), line(scene, 300.0 + apart_m, northward=False)]
    swaths = [swath_of(grid, track, STILL, 20.0) for grid, track in grids]
    return Overlap(
        reference=grids[0][0],
        query=grids[1][0],
        reference_swath=swaths[0],
        query_swath=swaths[1],
        shift_m=away_m,
        covariance_m2=np.eye(2) * sigma_m**2,
    )


def test_calibration_finds_roll_and_smile_from_neighbouring_lines(scene: Scene) -> None:
    calibration = Calibration(CalibrationSettings())
    away_m = np.array([2.0, -1.5])
    for number, apart_m in enumerate((80.0, -80.0, 60.0, -60.0)):
        assert calibration.learn(overlap(scene, apart_m, 3.0, away_m), NOISE, 100.0 * number)
    sigma = np.sqrt(np.diag(calibration.covariance))
    assert sigma[0] < 0.001
    assert calibration.errors == pytest.approx([ROLL_RAD, SMILE], abs=0.001)


def test_one_side_of_the_swath_leaves_roll_and_smile_apart_unknown(scene: Scene) -> None:
    calibration = Calibration(CalibrationSettings())
    calibration.learn(overlap(scene, 80.0, 3.0), NOISE, 0.0)
    together = np.array([2.0, 2.0 * 80.0 / 62.0])  # tilt of the difference between the passes
    assert np.sqrt(together @ calibration.covariance @ together) < 0.004
    assert np.sqrt(calibration.covariance[0, 0]) > 0.002


def test_an_uncertain_way_between_the_passes_teaches_nothing(scene: Scene) -> None:
    calibration = Calibration(CalibrationSettings())
    assert not calibration.learn(overlap(scene, 80.0, 30.0), NOISE, 0.0)
    assert calibration.errors == pytest.approx([0.0, 0.0])


def test_unrelated_seabed_teaches_nothing(scene: Scene) -> None:
    pair = overlap(scene, 60.0, 1.0)
    other, _ = line(Scene(seed=11, rms_m=3.0), 360.0, northward=False)
    calibration = Calibration(CalibrationSettings())
    assert not calibration.learn(dataclasses.replace(pair, query=other), NOISE, 0.0)


def test_evidence_fades_with_the_water(scene: Scene) -> None:
    pair = overlap(scene, 60.0, 3.0)
    once, again, late = (Calibration(CalibrationSettings(memory_s=600.0)) for _ in range(3))
    for calibration in (once, again, late):
        calibration.learn(pair, NOISE, 0.0)
    again.learn(pair, NOISE, 1.0)
    late.learn(pair, NOISE, 6000.0)
    spread = [np.linalg.eigvalsh(c.covariance)[0] for c in (once, again, late)]
    assert spread[2] > 0.9 * spread[0]
    assert spread[1] < 0.8 * spread[0]


def test_evidence_fades_once_whatever_comes_late(scene: Scene) -> None:
    pair = overlap(scene, 60.0, 3.0)
    early, late = (Calibration(CalibrationSettings(memory_s=600.0)) for _ in range(2))
    for now_s in (0.0, 600.0, 600.0):
        early.learn(pair, NOISE, now_s)
    for now_s in (0.0, 600.0, 0.0):
        late.learn(pair, NOISE, now_s)
    for calibration in (early, late):
        calibration.learn(pair, NOISE, 600.0)
    assert late.covariance == pytest.approx(early.covariance)


def test_cells_seen_from_several_headings_are_not_pure(scene: Scene) -> None:
    grid, track = line(scene, 300.0, northward=True)
    assert swath_of(grid, track, STILL, 20.0).pure.all()
    mixed = dataclasses.replace(grid, time_s=np.full(grid.depth_m.shape, 20.0))
    assert swath_of(mixed, track, STILL, 20.0).pure.mean() < 0.3
