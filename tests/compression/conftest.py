"""A small survey over a made relief, for every test of the compressor."""

from dataclasses import dataclass

import numpy as np
import pytest

from firmware.compression.binning import SoundingBins
from firmware.geometry import Array
from firmware.submaps import BinnedSoundings, Track


def relief_m(north_m: Array, east_m: Array) -> Array:
    """Return a smooth relief of some metres with features of 10 to 60 m."""
    return np.asarray(
        40.0
        + 1.5 * np.sin(north_m / 12.0)
        + 0.9 * np.cos(east_m / 7.0 + north_m / 25.0)
        + 0.4 * np.sin(east_m / 4.0)
    )


@dataclass(frozen=True)
class Survey:
    """Soundings (N, 3), their times, the cells they fall in, and the track."""

    soundings_ned_m: Array
    time_s: Array
    bins: BinnedSoundings
    track: Track


def made_survey(noise_m: float = 0.15, beams: int = 96, seed: int = 1) -> Survey:
    """Return forty seconds over the relief, 2 m/s north, 60 degrees to either side."""
    rng = np.random.default_rng(seed)
    time_s = np.repeat(np.arange(160) / 4.0, beams)
    angles = np.tile(np.deg2rad(np.linspace(-60.0, 60.0, beams)), 160)
    north_m = 2.0 * (time_s - 20.0)
    east_m = 40.0 * np.tan(angles)
    depth_m = relief_m(north_m, east_m) + noise_m * rng.normal(size=north_m.size)
    soundings_ned_m = np.column_stack([north_m, east_m, depth_m])
    bins = SoundingBins()
    bins.add(soundings_ned_m, time_s)
    seconds = np.arange(40.0)
    track = Track(
        time_s=seconds,
        north_m=2.0 * (seconds - 20.0),
        east_m=np.zeros(40),
        yaw_rad=np.zeros(40),
    )
    return Survey(soundings_ned_m, time_s, bins.result(), track)


@pytest.fixture(scope="session")
def survey() -> Survey:
    """Return the survey that most tests share."""
    return made_survey()
