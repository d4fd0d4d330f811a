"""Which of a window of one-way ranges to believe, when some are stretched by a common factor.

Within the 40 s of one transfer the two vehicles' relative motion is known far better than their
relative position. All true ranges therefore miss the prediction by nearly the same amount, while a
stretched one (Eq. 14) misses by a tenth of the range more. The window is explained as a whole: the
common miss and its rate are found under a mixture of true, stretched and wild ranges, and nothing
is believed when two explanations compete. The share of stretched ranges is learned over the
mission, so that 20 % and 80 % are the same problem.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware.geometry import Array
from protocol.settings import Settings, setting

_WILD_DENSITY = 1e-4  # per metre: multipath from anywhere in the water column
_GRID_STEP_SIGMAS = 0.5
_LONGEST_GRID = 1000  # half-widths: a kilometre of miss at the usual sigma


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeSettings(Settings):
    """How ranges are formed and judged."""

    sound_speed_mps: float = setting(
        1500.0, "m/s", "the mean over the path; a profile may be configured", minimum=1300.0,
        maximum=1700.0,
    )  # fmt: skip
    sigma_m: float = setting(1.0, "m", "noise of one range (Eq. 13)", minimum=1e-3)
    outlier_factor: float = setting(
        1.1, "1", "stretch of an outlier (Eq. 14)", minimum=1.0, maximum=2.0
    )
    outlier_share: float = setting(
        0.2, "1", "share of outliers before any were seen", minimum=0.01, maximum=0.99
    )
    window_spread_m: float = setting(
        1.3, "m", "relative dead reckoning over one window", minimum=0.0
    )
    rate_sigma_mps: float = setting(
        0.15, "m/s", "relative drift along the line of sight that is not known yet", minimum=1e-3
    )
    shortest_m: float = setting(5.0, "m", "nearer, the direction says nothing", minimum=0.0)
    longest_m: float = setting(
        10_000.0, "m", "no modem here carries farther", minimum=10.0, maximum=24_000.0
    )
    held: int = setting(
        256, "ranges", "waiting for their sender's track: two minutes of four followers", minimum=16
    )
    bent_m: float = setting(
        0.5, "m", "bend of a range that hides in its noise (1 m, Eq. 13)", minimum=0.01
    )
    bent_windows: int = setting(
        64, "windows", "of 20 s that wait until closures have straightened them", minimum=1
    )
    certainty: float = setting(
        0.99, "1", "share of belief that one explanation must have", minimum=0.5, maximum=1.0
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeVerdict:
    """What a window of ranges (R,) was found to be."""

    true: NDArray[np.bool_]
    stretched: NDArray[np.bool_]
    certain: bool


class RangeJudge:
    """Explains windows of ranges and remembers how many were stretched."""

    def __init__(self, settings: RangeSettings) -> None:
        self._settings = settings
        self._seen = {"true": 4.0 * (1 - settings.outlier_share),
                      "stretched": 4.0 * settings.outlier_share}  # fmt: skip

    @property
    def stretched_share(self) -> float:
        """The share of stretched ranges, as learned so far."""
        return self._seen["stretched"] / sum(self._seen.values())

    def judge(
        self, measured_m: Array, predicted_m: Array, time_s: Array, prior_sigma_m: float
    ) -> RangeVerdict:
        """Explain measured (R,) by predicted ranges (R,) at their times (R,).

        The prediction misses by a common amount, whose sigma is prior_sigma_m, and by a rate,
        because the vehicles' drift may not be known yet.
        """
        s = self._settings
        sigma_m = float(np.hypot(s.sigma_m, s.window_spread_m))
        sane = np.isfinite(measured_m) & (measured_m >= s.shortest_m) & (measured_m <= s.longest_m)
        if not np.any(sane):
            return RangeVerdict(true=sane & False, stretched=sane & False, certain=False)
        age_s = time_s - np.mean(time_s[sane])
        miss_m = _grid(4.0 * prior_sigma_m + 4.0 * sigma_m, sigma_m)
        reach_s = max(float(np.max(np.abs(age_s))), 1e-3)
        rate_mps = _grid(3.0 * s.rate_sigma_mps, sigma_m / reach_s)
        as_true, as_stretched = self._densities(
            np.where(sane, measured_m, np.nan)[:, None, None],
            predicted_m[:, None, None] + miss_m[:, None] + age_s[:, None, None] * rate_mps,
            sigma_m,
        )
        total = as_true + as_stretched + _WILD_DENSITY
        prior = (miss_m / prior_sigma_m)[:, None] ** 2 + (rate_mps / s.rate_sigma_mps) ** 2
        score = np.sum(np.log(total[sane]), axis=0) - 0.5 * prior
        belief = np.exp(score - score.max())
        i, j = divmod(int(np.argmax(score)), score.shape[1])
        near = np.abs(miss_m - miss_m[i]) <= 3.0 * sigma_m
        certain = bool(belief[near].sum() / belief.sum() >= s.certainty)
        odds = total[:, i, j]
        true = sane & (as_true[:, i, j] > 0.9 * odds)
        stretched = sane & (as_stretched[:, i, j] > 0.9 * odds)
        if certain:
            self._seen["true"] += float(np.count_nonzero(true))
            self._seen["stretched"] += float(np.count_nonzero(stretched))
        return RangeVerdict(true=true, stretched=stretched, certain=certain)

    def _densities(
        self, measured_m: Array, expected_m: Array, sigma_m: float
    ) -> tuple[Array, Array]:
        """Return the weighted densities (R, G, V) of each range being true, and being stretched."""
        share, factor = self.stretched_share, self._settings.outlier_factor
        scale = 1.0 / (np.sqrt(2 * np.pi) * sigma_m)
        true = np.exp(-0.5 * ((measured_m - expected_m) / sigma_m) ** 2)
        stretched = np.exp(-0.5 * ((measured_m - factor * expected_m) / sigma_m) ** 2)
        return (1 - share) * scale * true, share * scale * stretched


def _grid(reach: float, sigma: float) -> Array:
    """Return values from -reach to reach, half a sigma apart, zero among them, bounded."""
    steps = int(min(np.ceil(reach / (_GRID_STEP_SIGMAS * sigma)), _LONGEST_GRID))
    return np.linspace(-reach, reach, 2 * steps + 1)
