"""What the leader's answers teach a follower about its own dead reckoning.

The state is how far dead reckoning has run away, and how fast: (c_n, c_e, b_n, b_e). It is kept
at the time of the last state that an answer spoke of, because an answer is one to two minutes old;
from there it is carried to any later time by the drift. Dead reckoning itself is never corrected.
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
    bias_sigma_mps: float = setting(0.15, "m/s", "unmeasured current at the start", minimum=1e-4)
    bias_walk: float = setting(0.002, "m/s/sqrt(s)", "how the current wanders", minimum=1e-7)
    answer_sigma_m: float = setting(3.0, "m", "error of an answer that tells none", minimum=0.01)


class DriftCorrection:
    """A Kalman filter over the drift of one vehicle, fed by answers in the order of their times.

    The leader repeats an answer, and revises it when it learns more. A newer answer for the same
    state therefore replaces the older one; and when the leader changes its mind by more than the
    filter can believe, a second answer that agrees with the first makes the filter start over
    from the deployment.
    """

    def __init__(self, start_time_s: float, settings: CorrectionSettings) -> None:
        self._settings = settings
        sigmas = np.repeat([settings.start_sigma_m, settings.bias_sigma_mps], 2)
        self._deployment = _State(
            time_s=start_time_s, mean=np.zeros(4), covariance=np.diag(sigmas**2)
        )
        self._before = self._state = self._deployment  # without and with the newest answer
        self._aside: tuple[float, Array] | None = None
        self.accepted = 0
        self.stale = 0
        self.restarted = 0
        self.gated = 0

    def receive_answer(
        self, time_s: float, reckoned_m: Array, answered_m: Array, sigma_m: float | None = None
    ) -> bool:
        """Learn from the leader's position (2,) for a past state; return whether it was believed.

        An answer older than the last one used is stale; one that the filter finds impossible is
        put aside until another confirms it.
        """
        ran_away_m = np.asarray(reckoned_m - answered_m, dtype=np.float64)
        if not (np.all(np.isfinite(ran_away_m)) and np.isfinite(time_s)):
            self.gated += 1
            return False
        if time_s < self._state.time_s - 1e-6:
            self.stale += 1
            return False
        repeats = time_s <= self._state.time_s + 1e-6
        base = self._before if repeats else self._state
        sigma_m = sigma_m or self._settings.answer_sigma_m
        updated = self._updated(base, time_s, ran_away_m, sigma_m)
        if updated is None:
            updated = self._confirmed(time_s, ran_away_m, sigma_m)
            base = self._deployment
        if updated is None:
            return False
        self._before, self._state = base, updated
        self._aside = None
        self.accepted += 1
        return True

    def corrected(self, time_s: float, reckoned_m: Array) -> tuple[Array, Array]:
        """Return the believed position (2,) at the time, and its covariance (2, 2)."""
        state = self._predicted(self._state, max(time_s, self._state.time_s))
        return np.asarray(reckoned_m - state.mean[:2]), state.covariance[:2, :2]

    def _updated(
        self, base: "_State", time_s: float, ran_away_m: Array, sigma_m: float
    ) -> "_State | None":
        """Return the state with the answer in it, or None if it is beyond the gate."""
        state = self._predicted(base, time_s)
        spread_m2 = state.covariance[:2, :2] + sigma_m**2 * np.eye(2)
        innovation_m = ran_away_m - state.mean[:2]
        if innovation_m @ np.linalg.solve(spread_m2, innovation_m) > _CHI_SQUARE_2_999:
            return None
        gain = np.linalg.solve(spread_m2, state.covariance[:2]).T
        return _State(
            time_s=time_s,
            mean=state.mean + gain @ innovation_m,
            covariance=state.covariance - gain @ state.covariance[:2],
        )

    def _confirmed(self, time_s: float, ran_away_m: Array, sigma_m: float) -> "_State | None":
        """Return a state from the deployment and this answer alone, if the one aside agrees."""
        s, aside = self._settings, self._aside
        self.gated += 1
        self._aside = (time_s, ran_away_m)
        if aside is None:
            return None
        apart_m = float(np.hypot(*(ran_away_m - aside[1])))
        if apart_m > 4 * sigma_m + 3 * s.bias_sigma_mps * (time_s - aside[0]):
            return None
        self.restarted += 1
        return self._updated(self._deployment, time_s, ran_away_m, sigma_m)

    def _predicted(self, state: "_State", time_s: float) -> "_State":
        s, interval_s = self._settings, time_s - state.time_s
        transition = np.eye(4)
        transition[:2, 2:] = interval_s * np.eye(2)
        walk = s.bias_walk**2
        position_m2 = s.odometry_noise**2 * interval_s + walk * interval_s**3 / 3
        noise = np.diag(np.repeat([position_m2, walk * interval_s], 2))
        noise[[0, 1, 2, 3], [2, 3, 0, 1]] = walk * interval_s**2 / 2
        return _State(
            time_s=time_s,
            mean=transition @ state.mean,
            covariance=transition @ state.covariance @ transition.T + noise,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class _State:
    """How far dead reckoning has run away and how fast (4,), with covariance (4, 4)."""

    time_s: float
    mean: Array
    covariance: Array
