"""Streaming cells: bounded, robust, and the same however the soundings are cut."""

import numpy as np

from firmware.compression.binning import SoundingBins, coarsened
from firmware.compression.settings import BinningSettings
from tests.compression.conftest import Survey, relief_m


def test_cells_do_not_depend_on_how_the_soundings_come(survey: Survey) -> None:
    pings, whole = SoundingBins(), SoundingBins()
    for start in range(0, len(survey.time_s), 96):
        part = slice(start, start + 96)
        pings.add(survey.soundings_ned_m[part], survey.time_s[part])
    whole.add(survey.soundings_ned_m, survey.time_s)
    np.testing.assert_array_equal(pings.result().depth_m, whole.result().depth_m)


def test_wild_soundings_hardly_move_the_cells(survey: Survey) -> None:
    rng = np.random.default_rng(2)
    soundings = survey.soundings_ned_m.copy()
    wild = rng.random(len(soundings)) < 0.05
    soundings[wild, 2] += rng.uniform(-20.0, 20.0, int(wild.sum()))
    bins = SoundingBins()
    bins.add(soundings, survey.time_s)
    cells = bins.result()
    error_m = cells.depth_m - relief_m(cells.north_m, cells.east_m)
    assert np.sqrt(np.mean(error_m**2)) < 0.25  # m; 2.9 m if they were believed
    dropped = bins.dropped_fliers
    assert dropped > 0.8 * wild.sum()
    bins.result()
    assert bins.dropped_fliers == dropped  # however often one asks


def test_bad_numbers_are_counted_and_left_out() -> None:
    bins = SoundingBins()
    bins.add(np.array([[0.0, 0.0, np.nan], [np.inf, 0.0, 1.0], [0.0, 0.0, 40.0]]), 0.0)
    assert bins.result().count.sum() == 1
    assert bins.dropped_bad == 2


def test_cells_double_when_the_cap_is_reached(survey: Survey) -> None:
    bins = SoundingBins(BinningSettings(max_cells=1000))
    bins.add(survey.soundings_ned_m, survey.time_s)
    cells = bins.result()
    assert cells.count.size <= 1000
    assert cells.cell_m > 1.0
    assert cells.count.sum() > 0.99 * len(survey.soundings_ned_m)
    error_m = cells.depth_m - relief_m(cells.north_m, cells.east_m)
    assert np.sqrt(np.mean(error_m**2)) < 0.5
    assert np.all(np.isfinite(cells.variance_m2))


def test_coarser_cells_keep_every_sounding(survey: Survey) -> None:
    cells = coarsened(survey.bins, 2.0)
    assert cells.count.sum() == survey.bins.count.sum()
    assert cells.count.size < 0.6 * survey.bins.count.size


def test_nothing_gives_no_cells() -> None:
    assert SoundingBins().result().count.size == 0
