"""A bank of Kalman filters over drift: how far dead reckoning ran away, and how fast.

The state is (c, b, v), each with north and east: c in metres and b in metres a second are dead
reckoning's; v is the error of the leader's own position, in units of the sigma that is told with
it, wandering with a correlation time.

An answer is an estimate, not a measurement: it holds all that the leader was ever told, and so all
that earlier answers held. What is new in it is by how much it is surer than this filter; only that
counts, however often it is said. Errors of two estimates of which the later holds what the earlier
one held are correlated by the ratio of their sigmas: the difference of both has the difference of
both variances. Where the filter is the surer one, it learns nothing.

How much b wanders differs from sea to sea, and nobody knows it beforehand. Each filter of the bank
takes another walk for granted, and has the weight that what was seen gives to it: multiple-model
estimation, Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and
Navigation", 2001, section 11.6.2.
"""

from dataclasses import dataclass, replace

import numpy as np

from firmware.geometry import Array
from protocol.settings import Settings, setting

_WALKS = np.geomspace(1 / 256, 16.0, 13)  # a filter each; by wilder ones no lie would be gated
_MOST_TOLD = 5.0  # of walks by one thing seen, in nats
_BELIEVED = 8  # which of them takes about the believed walk


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftSettings(Settings):
    """What a follower believes of its dead reckoning and of the leader's errors."""

    start_sigma_m: float = setting(0.5, "m", "uncertainty of the start", minimum=1e-3)
    odometry_noise: float = setting(0.2, "m/sqrt(s)", "random part of dead reckoning", minimum=1e-4)
    bias_sigma_mps: float = setting(0.15, "m/s", "unmeasured current at the start", minimum=1e-4)
    bias_walk: float = setting(0.004, "m/s/sqrt(s)", "how the current wanders", minimum=1e-7)
    walk_factor: float = setting(
        4.0, "1", "by which the walk may well be wrong before answers tell", minimum=1.01
    )
    walk_memory_s: float = setting(
        3600.0, "s", "over which what they told of it fades: tides turn", minimum=60.0
    )
    leader_alike_s: float = setting(
        150.0, "s", "the leader's errors are alike for half a survey line, between closures",
        minimum=1.0,
    )  # fmt: skip
    fresh_share: float = setting(
        0.2, "1", "of a told sigma that is drawn anew each time", minimum=0.01, maximum=1.0
    )
    range_sigma_m: float = setting(1.5, "m", "noise of one range (Eq. 13) and slant", minimum=0.01)


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswerSeen:
    """How far dead reckoning had run away (2,) by an answer, and the answer's sigma."""

    time_s: float
    ran_away_m: Array
    sigma_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeSeen:
    """A horizontal range to the leader, where the leader was (2,) and dead reckoning was (2,).

    It was measured along a slant whose ends differ in depth.
    """

    time_s: float
    reckoned_m: Array
    leader_m: Array
    leader_sigma_m: float
    range_m: float
    depth_difference_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class LostSpan:
    """The variance that a span up to the time adds, in which the vehicle's motion is unknown.

    A long span comes in parts, each with what it adds to those before it.
    """

    time_s: float
    variance_m2: float


Seen = AnswerSeen | RangeSeen | LostSpan


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftState:
    """Means (W, 6) and covariances (W, 6, 6) of the bank at a time, and log weights (W,)."""

    time_s: float
    means: Array
    covariances: Array
    log_weights: Array

    def blended(self) -> tuple[Array, Array]:
        """Return mean (6,) and covariance (6, 6) of all filters together."""
        weights = np.exp(self.log_weights - self.log_weights.max())
        weights /= weights.sum()
        mean = weights @ self.means
        apart = self.means - mean
        covariance = np.tensordot(weights, self.covariances, axes=1)
        return mean, covariance + (weights * apart.T) @ apart


class DriftFilter:
    """The filters' steps, from state to state; it keeps nothing."""

    def __init__(self, settings: DriftSettings) -> None:
        self._settings = settings
        spread = np.log(settings.walk_factor)
        self._log_prior = -0.5 * (np.log(_WALKS) / spread + spread) ** 2
        mean_square = np.average(_WALKS**2, weights=np.exp(self._log_prior))
        self._walks = settings.bias_walk * _WALKS / np.sqrt(mean_square)

    def deployed(self, time_s: float) -> DriftState:
        """Return what is known at a start; a later one than the mission's has drifted since.

        A vehicle that begins without its past, its store gone, begins where dead reckoning is.
        Walks are log-normal about the believed one, which is the root of their mean square.
        """
        s, size = self._settings, len(_WALKS)
        sigmas = np.repeat([s.start_sigma_m, s.bias_sigma_mps, 1.0], 2)
        state = DriftState(
            time_s=min(time_s, 0.0),
            means=np.zeros((size, 6)),
            covariances=np.tile(np.diag(sigmas**2), (size, 1, 1)),
            log_weights=self._log_prior,
        )
        return self.predicted(state, time_s)

    def updated(self, state: DriftState, one: Seen) -> DriftState:
        """Return the state after something seen, at its time."""
        state = self.predicted(state, max(one.time_s, state.time_s))
        if isinstance(one, LostSpan):
            doubt_m2 = np.diag([one.variance_m2] * 2 + [0.0] * 4)
            return replace(state, covariances=state.covariances + doubt_m2)
        seen = [
            self._innovation(mean, covariance, one)
            for mean, covariance in zip(state.means, state.covariances, strict=True)
        ]
        innovation, spread, shared = (np.stack(part) for part in zip(*seen, strict=True))
        gain = np.linalg.solve(spread, shared.mT).mT
        missed = np.linalg.solve(spread, innovation[..., None])[..., 0]
        log_likely = -0.5 * (np.linalg.slogdet(spread)[1] + (innovation * missed).sum(axis=1))
        log_likely = np.maximum(log_likely, log_likely.max() - _MOST_TOLD)  # it may be a wrong one
        covariances = state.covariances - gain @ shared.mT
        return DriftState(
            time_s=state.time_s,
            means=state.means + (gain @ innovation[..., None])[..., 0],
            covariances=(covariances + covariances.mT) / 2,
            log_weights=state.log_weights + log_likely,
        )

    def chi_square(self, state: DriftState, one: AnswerSeen | RangeSeen) -> float:
        """Return the squared innovation of something seen, in units of its covariance.

        It is the least of two: by all that was learned, and by the filter that still believes what
        was believed at first. What speaks for a tide that begins to turn must not be kept out by
        the stillness before it.
        """
        state = self.predicted(state, max(one.time_s, state.time_s))
        squares = []
        for mean, covariance in (
            state.blended(),
            (state.means[_BELIEVED], state.covariances[_BELIEVED]),
        ):
            innovation, spread, _ = self._innovation(mean, covariance, one)
            if isinstance(one, AnswerSeen):  # a leader may change its mind: as if told anew
                spread = covariance[:2, :2] + one.sigma_m**2 * np.eye(2)
            squares.append(float(innovation @ np.linalg.solve(spread, innovation)))
        return min(squares)

    def predicted(self, state: DriftState, time_s: float) -> DriftState:
        """Return the state at a later time."""
        s, interval_s = self._settings, time_s - state.time_s
        alike, kept = np.exp(-interval_s / np.array([s.leader_alike_s, s.walk_memory_s]))
        transition = _on_both_axes(
            np.array([[1.0, interval_s, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, alike]])
        )
        fresh = np.diag([s.odometry_noise**2 * interval_s, 0.0, 1 - alike**2])
        wandered = np.zeros((3, 3))
        wandered[:2, :2] = np.array([[interval_s**2 / 3, interval_s / 2], [interval_s / 2, 1.0]])
        wandered *= interval_s
        noise = _on_both_axes(fresh + self._walks[:, None, None] ** 2 * wandered)
        return DriftState(
            time_s=time_s,
            means=state.means @ transition.T,
            covariances=transition @ state.covariances @ transition.T + noise,
            log_weights=self._log_prior + kept * (state.log_weights - self._log_prior),
        )

    def _innovation(
        self, mean: Array, covariance: Array, one: AnswerSeen | RangeSeen
    ) -> tuple[Array, Array, Array]:
        """Return what was not expected (M,), its covariance (M, M), and (6, M) with the state."""
        s, fresh = self._settings, self._settings.fresh_share
        known_m2 = covariance[:2, :2]
        if isinstance(one, AnswerSeen):
            news_m2, axes = np.linalg.eigh(known_m2 - one.sigma_m**2 * np.eye(2))
            learned_m2 = (axes * np.maximum(news_m2, 0.0)) @ axes.T
            spread_m2 = learned_m2 + (fresh * one.sigma_m) ** 2 * np.eye(2)
            shared = covariance[:, :2] @ np.linalg.solve(known_m2, learned_m2)
            return one.ran_away_m - mean[:2], spread_m2, shared
        lasting = float(np.sqrt(1.0 - fresh**2))
        leader_error_m = lasting * one.leader_sigma_m * mean[4:6]
        between_m = one.reckoned_m - mean[:2] - (one.leader_m - leader_error_m)
        predicted_m = max(float(np.hypot(*between_m)), 1.0)
        direction = between_m / predicted_m
        design = np.zeros((1, 6))
        design[0, :2], design[0, 4:6] = -direction, lasting * one.leader_sigma_m * direction
        # beyond the first order: across the range, the position's uncertainty bends it
        across_m2 = float(np.trace(known_m2)) / predicted_m
        # noise counts for more across than along a slant
        steepness = one.depth_difference_m / predicted_m
        range_m2 = s.range_sigma_m**2 * (1.0 + steepness**2)
        variance_m2 = range_m2 + (fresh * one.leader_sigma_m) ** 2 + across_m2**2 / 4
        shared = covariance @ design.T
        return np.array([one.range_m - predicted_m]), design @ shared + variance_m2, shared


def _on_both_axes(matrix: Array) -> Array:
    """Return matrices (..., 3, 3) over (c, b, v) as (..., 6, 6) over north and east of each."""
    both = np.zeros((*matrix.shape[:-2], 6, 6))
    both[..., ::2, ::2] = both[..., 1::2, 1::2] = matrix
    return both
