"""Sound speed between two depths, against numerical integration; what is no profile."""

import tomllib

import numpy as np
import pytest
from scipy.integrate import quad

from firmware.sound_speed import SoundProfile, horizontal_m
from protocol.errors import ConfigError
from protocol.settings import replace

SUMMER = (5.0, 1530.0, 15.0, 1528.0, 30.0, 1480.0, 80.0, 1475.0, 200.0, 1480.0)
UNUSED_MPS = 1.0


def profile(*points: float) -> SoundProfile:
    return SoundProfile(points=points)


@pytest.mark.parametrize(
    ("from_m", "to_m"),
    [(0.0, 3.0), (10.0, 60.0), (60.0, 10.0), (0.0, 400.0), (20.0, 20.01), (30.0, 80.0)],
)
def test_speed_is_the_harmonic_mean_over_depth(from_m: float, to_m: float) -> None:
    def slowness(depth_m: float) -> float:
        return float(1.0 / np.interp(depth_m, SUMMER[::2], SUMMER[1::2]))

    low_m, high_m = sorted((from_m, to_m))
    inside_m = [depth_m for depth_m in SUMMER[::2] if low_m < depth_m < high_m]
    travel_s = quad(slowness, low_m, high_m, points=inside_m or None, epsabs=0, epsrel=1e-12)[0]
    speed_mps = profile(*SUMMER).speed_mps(from_m, to_m, UNUSED_MPS)
    assert speed_mps == pytest.approx((high_m - low_m) / travel_s, abs=1e-8)


def test_speed_at_one_depth_is_local_and_that_of_a_thin_layer() -> None:
    summer = profile(*SUMMER)
    for depth_m, speed_mps in ((0.0, 1530.0), (22.5, 1504.0), (30.0, 1480.0), (900.0, 1480.0)):
        assert summer.speed_mps(depth_m, depth_m, UNUSED_MPS) == pytest.approx(speed_mps, abs=1e-9)
        thin_mps = summer.speed_mps(depth_m, depth_m + 1e-6, UNUSED_MPS)
        assert thin_mps == pytest.approx(speed_mps, abs=1e-5)


@pytest.mark.parametrize("points", [(40.0, 1490.0), (0.0, 1490.0, 50.0, 1490.0)])
def test_one_speed_holds_everywhere(points: tuple[float, ...]) -> None:
    for ends_m in ((0.0, 0.0), (10.0, 70.0), (70.0, 40.0)):
        assert profile(*points).speed_mps(*ends_m, UNUSED_MPS) == pytest.approx(1490.0, abs=1e-9)


def test_gradient_that_nearly_vanishes_keeps_the_speed() -> None:
    nearly = profile(0.0, 1500.0, 100.0, 1500.0 + 1e-9)
    assert nearly.speed_mps(0.0, 100.0, UNUSED_MPS) == pytest.approx(1500.0, abs=1e-9)


@pytest.mark.parametrize("points", [None, ()])
def test_without_points_the_speed_is_the_other(points: tuple[float, ...] | None) -> None:
    assert SoundProfile(points=points).speed_mps(0.0, 50.0, 1512.3) == 1512.3


def test_points_are_read_from_text_and_toml_alike() -> None:
    table = tomllib.loads("points = [0, 1500, 50.5, 1480]")
    for points in (table["points"], "0,1500,50.5,1480"):
        read = replace(SoundProfile(), {"points": points})
        assert read == profile(0.0, 1500.0, 50.5, 1480.0)
    nothings: tuple[object, ...] = ("", "none", [])
    for nothing in nothings:
        assert not replace(profile(0.0, 1500.0), {"points": nothing}).points


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ("0,1500,50", "3 numbers; give pairs"),
        ("0,1500,0,1490", "they must increase"),
        ("50,1500,0,1490", "they must increase"),
        ("0,1299", "from 1300 to 1700"),
        ("0,1500,50,1701", "from 1300 to 1700"),
        ("0,nan", "from 1300 to 1700"),
        ("nan,1500", "must be finite"),
        ("0,1500,inf,1500", "must be finite"),
        ("0;1500", "give a number"),
    ],
)
def test_what_is_no_profile_is_refused_with_a_reason(points: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        replace(SoundProfile(), {"points": points})


def test_slant_range_goes_less_far_across() -> None:
    assert horizontal_m(500.0, 300.0) == pytest.approx(400.0, abs=1e-12)
    assert horizontal_m(500.0, -300.0) == pytest.approx(400.0, abs=1e-12)
    assert np.isnan(horizontal_m(299.9, 300.0))
    assert np.isnan(horizontal_m(-5.0, 0.0))


def test_level_range_is_kept_to_the_last_bit() -> None:
    ranges_m = np.random.default_rng(1).uniform(1e-3, 24_000.0, 10_000)
    assert [horizontal_m(float(r), 0.0) for r in ranges_m] == ranges_m.tolist()
