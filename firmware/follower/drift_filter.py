"""A Kalman filter over drift: how far dead reckoning ran away, how fast, and the leader's errors.

The state is (c, b, u, v), each with north and east: c in metres and b in metres a second are
dead reckoning's; u is the error of the leader's answers and v that of its own position, both in
units of the sigma that is told with them, each wandering with a correlation time.
"""

from dataclasses import dataclass

import numpy as np

from firmware.geometry import Array
from protocol.settings import Settings, setting


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftSettings(Settings):
    """What a follower believes of its dead reckoning and of the leader's errors."""

    start_sigma_m: float = setting(0.5, "m", "uncertainty of the start", minimum=1e-3)
    odometry_noise: float = setting(0.2, "m/sqrt(s)", "random part of dead reckoning", minimum=1e-4)
    bias_sigma_mps: float = setting(0.15, "m/s", "unmeasured current at the start", minimum=1e-4)
    bias_walk: float = setting(0.004, "m/s/sqrt(s)", "how the current wanders", minimum=1e-7)
    answers_alike_s: float = setting(
        150.0, "s", "errors of answers are alike for half a survey line, between closures",
        minimum=1.0,
    )  # fmt: skip
    fresh_share: float = setting(
        0.4, "1", "of an answer's sigma that is drawn anew each time", minimum=0.01, maximum=1.0
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

    It was measured along a slant between depths that are apart_m apart.
    """

    time_s: float
    reckoned_m: Array
    leader_m: Array
    leader_sigma_m: float
    range_m: float
    apart_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftState:
    """Mean (8,) and covariance (8, 8) at a time."""

    time_s: float
    mean: Array
    covariance: Array


class DriftFilter:
    """The filter's steps, from state to state; it keeps nothing."""

    def __init__(self, settings: DriftSettings) -> None:
        self._settings = settings

    def deployed(self, time_s: float) -> DriftState:
        """Return what is known at a start; a later one than the mission's has drifted since.

        A vehicle that begins without its past, its store gone, begins where dead reckoning is.
        """
        s = self._settings
        sigmas = np.repeat([s.start_sigma_m, s.bias_sigma_mps, 1.0, 1.0], 2)
        first_s = min(time_s, 0.0)
        state = DriftState(time_s=first_s, mean=np.zeros(8), covariance=np.diag(sigmas**2))
        return self.predicted(state, time_s)

    def updated(self, state: DriftState, one: AnswerSeen | RangeSeen) -> DriftState:
        """Return the state after something seen, at its time."""
        state = self.predicted(state, max(one.time_s, state.time_s))
        innovation, design, noise = self._measured(state, one)
        spread = design @ state.covariance @ design.T + noise
        gain = np.linalg.solve(spread, design @ state.covariance).T
        keep = np.eye(8) - gain @ design
        return DriftState(
            time_s=state.time_s,
            mean=state.mean + gain @ innovation,
            covariance=keep @ state.covariance @ keep.T + gain @ noise @ gain.T,
        )

    def chi_square(self, state: DriftState, one: AnswerSeen | RangeSeen) -> float:
        """Return the squared innovation of something seen, in units of its covariance."""
        state = self.predicted(state, max(one.time_s, state.time_s))
        innovation, design, noise = self._measured(state, one)
        spread = design @ state.covariance @ design.T + noise
        return float(innovation @ np.linalg.solve(spread, innovation))

    def predicted(self, state: DriftState, time_s: float) -> DriftState:
        """Return the state at a later time."""
        s, interval_s = self._settings, time_s - state.time_s
        alike = float(np.exp(-interval_s / s.answers_alike_s))
        transition = np.diag([1.0, 1.0, 1.0, 1.0, alike, alike, alike, alike])
        transition[:2, 2:4] = interval_s * np.eye(2)
        walk = s.bias_walk**2
        position_m2 = s.odometry_noise**2 * interval_s + walk * interval_s**3 / 3
        noise = np.diag(np.repeat([position_m2, walk * interval_s, 1 - alike**2, 1 - alike**2], 2))
        noise[[0, 1, 2, 3], [2, 3, 0, 1]] = walk * interval_s**2 / 2
        return DriftState(
            time_s=time_s,
            mean=transition @ state.mean,
            covariance=transition @ state.covariance @ transition.T + noise,
        )

    def _measured(
        self, state: DriftState, one: AnswerSeen | RangeSeen
    ) -> tuple[Array, Array, Array]:
        """Return innovation (M,), design (M, 8) and noise (M, M) of something seen."""
        s, fresh = self._settings, self._settings.fresh_share
        lasting = float(np.sqrt(1.0 - fresh**2))
        if isinstance(one, AnswerSeen):
            design = np.zeros((2, 8))
            design[:, :2], design[:, 4:6] = np.eye(2), lasting * one.sigma_m * np.eye(2)
            noise = (fresh * one.sigma_m) ** 2 * np.eye(2)
            return one.ran_away_m - design @ state.mean, design, noise
        leader_error_m = lasting * one.leader_sigma_m * state.mean[6:8]
        between_m = one.reckoned_m - state.mean[:2] - (one.leader_m - leader_error_m)
        predicted_m = max(float(np.hypot(*between_m)), 1.0)
        direction = between_m / predicted_m
        design = np.zeros((1, 8))
        design[0, :2], design[0, 6:8] = -direction, lasting * one.leader_sigma_m * direction
        # beyond the first order: across the range, the position's uncertainty bends it
        across_m2 = float(np.trace(state.covariance[:2, :2])) / predicted_m
        steepness = one.apart_m / predicted_m  # noise counts for more across than along a slant
        range_m2 = s.range_sigma_m**2 * (1.0 + steepness**2)
        variance_m2 = range_m2 + (fresh * one.leader_sigma_m) ** 2 + across_m2**2 / 4
        return np.array([one.range_m - predicted_m]), design, np.array([[variance_m2]])
