import numpy as np

from firmware.geometry import Array
from firmware.leader.alignment import fields_of
from firmware.leader.matches import MatchingSettings
from firmware.leader.pair_problem import noise_model
from firmware.leader.refinement import refine
from firmware.leader.screening import prepare
from tests.matching.scenes import Scene

NOISE = noise_model(MatchingSettings(), 0.0)


def ends_m(seed: int) -> tuple[Array, Array]:
    """Return where a fit of two noisy sub-maps ends, and where one that begins there does."""
    scene = Scene(seed, rms_m=0.2)
    first = prepare(scene.submap(200, 200, (61, 61), sigma_m=0.4))
    second = prepare(scene.submap(190, 215, (61, 61), sigma_m=0.4))
    assert first is not None
    assert second is not None
    fields = fields_of(first, 0.5), fields_of(second, 0.5)
    found = refine(first, second, fields, np.array([3.0, -2.5]), NOISE)
    assert found is not None
    again = refine(first, second, fields, found.shift_m, NOISE)
    assert again is not None
    return found.shift_m, again.shift_m


def test_fits_settle_though_noise_makes_most_of_the_slopes() -> None:
    found_m, again_m = np.array([ends_m(seed) for seed in range(10)]).swapaxes(0, 1)
    assert np.hypot(*found_m.T).mean() < 1.0  # the truth is no shift
    assert np.hypot(*(again_m - found_m).T).mean() < 0.1
