"""The field and its spectrum, as soundings tell them."""

import numpy as np
import pytest

from firmware.compression.binning import SoundingBins
from firmware.compression.field import Field, fitted_field_steps, fitted_trend, wavenumbers
from firmware.compression.lattice_frame import lattice_frame
from firmware.compression.steps import run
from firmware.geometry import Array
from tests.compression.conftest import made_survey, relief_m


def estimated(soundings_ned_m: Array, step_m: float = 1.0) -> Field:
    bins = SoundingBins()
    bins.add(soundings_ned_m, 0.0)
    cells = bins.result()
    frame = lattice_frame(cells, step_m)
    return run(fitted_field_steps(cells, frame, fitted_trend(cells, frame)))


def error_m2(field: Field) -> float:
    inside_m = np.random.default_rng(8).uniform([-38.0, -60.0], [38.0, 60.0], (4000, 2))
    return float(np.mean((field.depth_m(inside_m) - relief_m(*inside_m.T)) ** 2))


@pytest.mark.parametrize("noise_m", [0.1, 0.4])
def test_smooth_relief_is_known_far_better_than_a_cell(noise_m: float) -> None:
    field = estimated(made_survey(noise_m=noise_m, beams=192).soundings_ned_m)
    assert error_m2(field) < 0.1 * field.noise_m2


@pytest.mark.parametrize("noise_m", [0.1, 0.4])
def test_what_is_said_to_be_unknown_is_what_is_wrong(noise_m: float) -> None:
    field = estimated(made_survey(noise_m=noise_m, beams=192).soundings_ned_m)
    assert error_m2(field) == pytest.approx(field.unknown_m2, rel=0.7)


def test_few_soundings_leave_much_unknown() -> None:
    every = made_survey(beams=192).soundings_ned_m
    few = np.random.default_rng(2).choice(every, 60, replace=False)
    assert estimated(few).unknown_m2 > 0.1 > 10.0 * estimated(every).unknown_m2


def test_frequencies_without_signal_are_given_up() -> None:
    field = estimated(made_survey(noise_m=0.2, beams=192).soundings_ned_m)
    fine = wavenumbers(field.frame) > 0.25  # cycles per m; the relief's finest is 0.04
    assert (field.coefficients_m[fine] ** 2).max() < 0.1 * field.noise_m2
