"""What the leader's answers teach a follower about its own dead reckoning.

The state is how far dead reckoning has run away, and how fast: (c_n, c_e, b_n, b_e). It is kept at
the time of the last state that an answer spoke of, because an answer is one to two minutes old;
from there it is carried to any later time by the drift. Nothing here corrects dead reckoning itself.
"""

from dataclasses import dataclass

import numpy as np

from firmware.geometry import Array
from protocol.settings import Settings, setting

_CHI_SQUARE_2_999 = 13.8  # 99.9 % of a true innovation of two components lies below


@dataclass(frozen=True, slots=True, kw_only=True)
class CorrectionSettings(Settings):
    """What a follower believes of its dead reckoning and of answers."""

    start_sigma_m: float = setting(0.5, "m", "uncertainty of the start", minimum=1e-3)
    odometry_noise: float = setting(0.2, "m/sqrt(s)", "random part of dead reckoning", minimum=1e-4)
    bias_sigma_mps: float = setting(0.2, "m/s", "unmeasured current at the start", minimum=1e-4)
    bias_walk: float = setting(0.0008, "m/s/sqrt(s)", "how the current wanders", minimum=1e-7)
    answer_sigma_m: float = setting(2.0, "m", "error of an answer that tells none", minimum=0.01)
    rejections_before_reset: int = setting(
        3, "answers", "so many in a row that agree with each other outvote the filter", minimum=2
    )


class DriftCorrection:
    """A Kalman filter over the drift of one vehicle, fed by answers in the order of their times."""

    def __init__(self, start_time_s: float, settings: CorrectionSettings) -> None:
        self._settings = settings
        self._time_s = start_time_s
        self._mean = np.zeros(4)
        sigmas = np.repeat([settings.start_sigma_m, settings.bias_sigma_mps], 2)
        self._covariance = np.diag(sigmas**2)
        self._rejected: list[tuple[float, Array]] = []
        self.accepted = 0
        self.stale = 0
        self.outvoted = 0
        self.gated = 0

    def receive_answer(
        self, time_s: float, reckoned_m: Array, answered_m: Array, sigma_m: float | None = None
    ) -> bool:
        """Learn from the leader's position (2,) for a past state; return whether it was believed.

        An answer older than the last one used is stale; one that the filter finds impossible is
        put aside, and counts only when several in a row agree with each other.
        """
        if not (np.all(np.isfinite(answered_m)) and np.isfinite(time_s)):
            self.gated += 1
            return False
        if time_s < self._time_s - 1e-6:
            self.stale += 1
            return False
        ran_away_m = np.asarray(reckoned_m - answered_m)
        mean, covariance = self._predicted(time_s)
        noise_m2 = (sigma_m or self._settings.answer_sigma_m) ** 2 * np.eye(2)
        innovation_m = ran_away_m - mean[:2]
        spread_m2 = covariance[:2, :2] + noise_m2
        if innovation_m @ np.linalg.solve(spread_m2, innovation_m) > _CHI_SQUARE_2_999:
            return self._put_aside(time_s, ran_away_m)
        gain = np.linalg.solve(spread_m2, covariance[:2]).T
        self._mean = mean + gain @ innovation_m
        self._covariance = covariance - gain @ covariance[:2]
        self._time_s = time_s
        self._rejected.clear()
        self.accepted += 1
        return True

    def corrected(self, time_s: float, reckoned_m: Array) -> tuple[Array, Array]:
        """Return the believed position (2,) at the time, and its covariance (2, 2)."""
        mean, covariance = self._predicted(max(time_s, self._time_s))
        return np.asarray(reckoned_m - mean[:2]), covariance[:2, :2]

    def _predicted(self, time_s: float) -> tuple[Array, Array]:
        s, interval_s = self._settings, time_s - self._time_s
        transition = np.eye(4)
        transition[:2, 2:] = interval_s * np.eye(2)
        walk = s.bias_walk**2
        noise = np.diag(
            np.repeat([s.odometry_noise**2 * interval_s + walk * interval_s**3 / 3,
                       walk * interval_s], 2)
        )  # fmt: skip
        noise[[0, 1, 2, 3], [2, 3, 0, 1]] = walk * interval_s**2 / 2
        return transition @ self._mean, transition @ self._covariance @ transition.T + noise

    def _put_aside(self, time_s: float, ran_away_m: Array) -> bool:
        """Keep an impossible answer; start over from the last few if they agree among themselves."""
        s = self._settings
        self.gated += 1
        self._rejected = [*self._rejected, (time_s, ran_away_m)][-s.rejections_before_reset :]
        if len(self._rejected) < s.rejections_before_reset:
            return False
        times_s = np.array([t for t, _ in self._rejected])
        drifts_m = np.array([d for _, d in self._rejected])
        spread_m = np.ptp(drifts_m, axis=0)
        allowed_m = 4 * s.answer_sigma_m + 3 * s.bias_sigma_mps * np.ptp(times_s)
        if np.any(spread_m > allowed_m):
            return False
        self._mean = np.concatenate([ran_away_m, self._mean[2:]])
        sigmas = np.repeat([s.answer_sigma_m, s.bias_sigma_mps], 2)
        self._covariance = np.diag(sigmas**2)
        self._time_s = time_s
        self._rejected.clear()
        self.outvoted += 1
        return True
