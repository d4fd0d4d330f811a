"""Which of a window of one-way ranges to believe, when some are stretched by a common factor.

Within the 40 s of one transfer the two vehicles' relative motion is known far better than their
relative position. All true ranges therefore miss the prediction by nearly the same amount, while a
stretched one (Eq. 14) misses by a tenth of the range more. The window is explained as a whole: the
common miss and its rate are found under a mixture of true, stretched and wild ranges, and nothing
is believed when two explanations compete. The share of stretched ranges is learned over the
mission, so that 20 % and 80 % are the same problem. The prediction may be lost, too: else an
estimate that has gone astray would read every true range as a stretched one, and stay there.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from firmware.geometry import Array
from firmware.sound_speed import SoundProfile
from protocol.settings import Settings, setting

_WILD_DENSITY = 1e-4  # per metre: multipath from anywhere in the water column
_GRID_STEP_SIGMAS = 0.5
_SPREAD_OVER_S = 20.0
_SHARES = np.array([0.05, 0.2, 0.4, 0.6, 0.8, 0.95])
_CHANGED = 0.003  # how often a window's share is new: more leaves more of them undecided
_SELDOM, _SELDOM_SHARE = 3.0, 0.1  # times the usual rate, and how often: some drift runs away
_LONGEST_GRID = 1000  # half-widths: a kilometre of miss at the usual sigma


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeSettings(Settings):
    """How ranges are formed and judged."""

    sound_speed_mps: float = setting(
        1500.0, "m/s", "the mean over the path, where no profile is configured", minimum=1300.0,
        maximum=1700.0,
    )  # fmt: skip
    sound_profile: SoundProfile = setting(SoundProfile, "", "sound speed over depth")
    follower_depth_m: float | None = setting(
        None, "m", "of all followers, since frames do not tell it; none: the leader's own",
        minimum=0.0,
    )  # fmt: skip
    sigma_m: float = setting(1.0, "m", "noise of one range (Eq. 13)", minimum=1e-3)
    outlier_factor: float = setting(
        1.1, "1", "stretch of an outlier (Eq. 14)", minimum=1.0, maximum=2.0
    )
    outlier_share: float = setting(
        0.2, "1", "share of outliers before any were seen", minimum=0.01, maximum=0.99
    )
    window_spread_m: float = setting(
        1.3,
        "m",
        "error of relative dead reckoning over 20 s; it grows with the root of time",
        minimum=0.0,
    )
    rate_sigma_mps: float = setting(
        0.15, "m/s", "relative drift along the line of sight that is not known yet", minimum=1e-3
    )
    lost_share: float = setting(
        0.02, "1", "prior probability that the estimate is astray", minimum=1e-6, maximum=0.5
    )
    lost_m: float = setting(50.0, "m", "by how much predictions then miss", minimum=1.0)
    joined: int = setting(
        20, "ranges", "at most in windows that are joined while they are undecided", minimum=5,
        maximum=60,
    )  # fmt: skip
    joined_s: float = setting(
        60.0,
        "s",
        "of joined windows at most: drift along the line of sight keeps a steady rate",
        minimum=0.0,
    )
    shortest_m: float = setting(5.0, "m", "nearer, the direction says nothing", minimum=0.0)
    longest_m: float = setting(
        10_000.0, "m", "no modem here carries farther", minimum=10.0, maximum=24_000.0
    )
    held: int = setting(
        256, "ranges", "waiting for their sender's track: two minutes of four followers", minimum=16
    )
    bent_m: float = setting(
        0.5, "m", "a bend that a range's noise hides (1 m, Eq. 13)", minimum=0.01
    )
    bent_share: float = setting(
        0.02,
        "1",
        "largest bend over range at which it is used (a sigma of a sixth of it to the side)",
        minimum=0.0,
        maximum=1.0,
    )
    bent_alike: float = setting(
        2.0, "1", "weight of a bend over noise: the windows of two minutes all bend alike",
        minimum=1.0,
    )  # fmt: skip
    waiting: int = setting(64, "windows", "of 20 s that wait to be decided", minimum=1)
    certainty: float = setting(
        0.995, "1", "share of belief that one explanation must have", minimum=0.5, maximum=1.0
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

        The prediction misses by a common amount, whose sigma is prior_sigma_m unless the estimate
        is lost, and by a rate, because the vehicles' drift may not be known yet.
        """
        s = self._settings
        span_s = max(float(np.ptp(time_s)), _SPREAD_OVER_S)
        sigma_m = float(np.hypot(s.sigma_m, s.window_spread_m * np.sqrt(span_s / _SPREAD_OVER_S)))
        sane = np.isfinite(measured_m) & (measured_m >= s.shortest_m) & (measured_m <= s.longest_m)
        if not np.any(sane):
            return RangeVerdict(true=sane & False, stretched=sane & False, certain=False)
        age_s = time_s - np.mean(time_s[sane])
        lost_m = float(np.hypot(prior_sigma_m, s.lost_m))
        miss_m = _grid(4.0 * max(prior_sigma_m, 0.5 * lost_m) + 4.0 * sigma_m, sigma_m)
        reach_s = max(float(np.max(np.abs(age_s))), 1e-3)
        seldom_mps = _SELDOM * s.rate_sigma_mps
        rate_mps = _grid(2.0 * seldom_mps, sigma_m / reach_s)
        found_m = np.where(sane, measured_m, np.nan)[:, None, None]
        expected_m = (predicted_m[:, None] + age_s[:, None] * rate_mps)[:, None]
        as_true, as_stretched = (
            _density(found_m - factor * expected_m - factor * miss_m[:, None], sigma_m)
            for factor in (1.0, s.outlier_factor)
        )
        score = _log_prior(miss_m, prior_sigma_m, lost_m, s.lost_share)[:, None] + _log_prior(
            rate_mps, s.rate_sigma_mps, seldom_mps, _SELDOM_SHARE
        )
        score += self._log_likelihood(as_true[sane], as_stretched[sane])
        belief = np.exp(score - score.max())
        i, j = divmod(int(np.argmax(score)), score.shape[1])
        near = np.abs(miss_m - miss_m[i]) <= 3.0 * sigma_m
        certain = bool(belief[near].sum() / belief.sum() >= s.certainty)
        share = self.stretched_share
        reads_true = (1.0 - share) * as_true[:, i, j]
        reads_stretched = share * as_stretched[:, i, j]
        total = reads_true + reads_stretched + _WILD_DENSITY
        alike = (s.outlier_factor - 1.0) * predicted_m < sigma_m  # stretched or not is all one
        reads_true = np.where(alike, reads_true + reads_stretched, reads_true)
        reads_stretched = np.where(alike, 0.0, reads_stretched)
        true = sane & (reads_true > 0.9 * total)
        stretched = sane & (reads_stretched > 0.9 * total)
        return RangeVerdict(true=true, stretched=stretched, certain=certain)

    def learn(self, verdict: RangeVerdict) -> None:
        """Learn the share of stretched ranges from a verdict, once for each window."""
        self._seen["true"] += float(np.count_nonzero(verdict.true))
        self._seen["stretched"] += float(np.count_nonzero(verdict.stretched))

    def _log_likelihood(self, as_true: Array, as_stretched: Array) -> Array:
        """Return the log likelihood (G, V) of all ranges over every share that may be the true one.

        The share is as uncertain as what was seen so far leaves it: a beta distribution, or any
        now and then, since hours of few outliers do not tell that the next are few. The product of
        the densities of all that may be joined is no less than 1e-240: a double.
        """
        exponents = self._seen["stretched"] - 1.0, self._seen["true"] - 1.0
        weights = softmax(exponents[0] * np.log(_SHARES) + exponents[1] * np.log(1.0 - _SHARES))
        weights = (1.0 - _CHANGED) * weights + _CHANGED / len(_SHARES)
        likelihood = sum(
            weight * np.prod((1.0 - share) * as_true + share * as_stretched + _WILD_DENSITY, axis=0)
            for share, weight in zip(_SHARES, weights, strict=True)
        )
        return np.asarray(np.log(likelihood))


def _density(missed_m: Array, sigma_m: float) -> Array:
    """Return the density of ranges that are missed by so much."""
    return np.asarray(np.exp(missed_m**2 * (-0.5 / sigma_m**2)) / (np.sqrt(2 * np.pi) * sigma_m))


def _log_prior(values: Array, sigma: float, wide: float, wide_share: float) -> Array:
    """Return the log belief (N,) in values on a grid, of which a share is spread more widely."""
    usual, seldom = (np.exp(-0.5 * (values / width) ** 2) for width in (sigma, wide))
    belief = (1.0 - wide_share) * usual / usual.sum() + wide_share * seldom / seldom.sum()
    return np.asarray(np.log(belief))


def _grid(reach: float, sigma: float) -> Array:
    """Return values from -reach to reach, half a sigma apart, zero among them, bounded."""
    steps = int(min(np.ceil(reach / (_GRID_STEP_SIGMAS * sigma)), _LONGEST_GRID))
    return np.linspace(-reach, reach, 2 * steps + 1)
