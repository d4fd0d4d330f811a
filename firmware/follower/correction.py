"""What the leader's answers teach a follower about its own dead reckoning.

The state is how far dead reckoning has run away and how fast. An answer is one to two minutes old,
and holds what all answers before it held: only what is new in it counts. What came is kept in the
order of its times and filtered again whenever something older arrives. Nothing here corrects dead
reckoning itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from firmware.dead_reckoning import LOST_SIGMA_MPS
from firmware.follower.drift_filter import (
    AnswerSeen,
    DriftFilter,
    DriftSettings,
    DriftState,
    LostSpan,
    RangeSeen,
    Seen,
)
from firmware.geometry import Array
from firmware.sound_speed import SoundProfile, horizontal_m
from protocol.packets import SMALLEST_SIGMA_M
from protocol.settings import setting

_CHI_SQUARE_1_99, _CHI_SQUARE_2_999 = 6.6, 13.8  # shares of true innovations that lie below
_LEAST_NEWS = 0.05  # an answer hardly surer than dead reckoning alone is left out
_SHORT_STEP_S = 120.0  # of a clock set back: answers are as old
_KEPT = 96  # answers, ranges and losses of eight minutes; older ones are in the beginning


@dataclass(frozen=True, slots=True, kw_only=True)
class CorrectionSettings(DriftSettings):
    """What a follower believes of its dead reckoning, of answers and of ranges."""

    answer_sigma_m: float = setting(3.0, "m", "error of an answer that tells none", minimum=0.01)
    first_closures_s: float = setting(
        600.0, "s", "until then a leader may know no more than dead reckoning", minimum=1.0
    )
    echo_share: float = setting(
        0.5, "1", "of what dead reckoning may run away: what ranges alone tell", minimum=0.01,
        maximum=1.0,
    )  # fmt: skip
    sound_speed_mps: float = setting(
        1500.0, "m/s", "the mean over the path, where no profile is configured", minimum=1300.0,
        maximum=1700.0,
    )  # fmt: skip
    sound_profile: SoundProfile = setting(SoundProfile, "", "sound speed over depth")
    leader_depth_m: float | None = setting(
        None, "m", "since answers do not tell it; none: our own", minimum=0.0
    )
    shortest_range_m: float = setting(20.0, "m", "nearer, the direction says nothing", minimum=0.0)
    longest_range_m: float = setting(10_000.0, "m", "no modem here carries farther", minimum=10.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Filtered:
    """Something seen, and the state after it."""

    one: Seen
    state: DriftState


class DriftCorrection:
    """The drift of one vehicle, from answers and ranges in any order.

    When the leader changes its mind by more than the filter can believe, a second answer that
    agrees with the first makes the filter start over from the deployment.
    """

    def __init__(self, start_time_s: float, settings: CorrectionSettings) -> None:
        self._settings = settings
        self._filter = DriftFilter(settings)
        self._deployment = self._base = self._filter.deployed(start_time_s)
        self._seen: list[_Filtered] = []
        self._lost: list[LostSpan] = []
        self._losing_s = (np.inf, -np.inf)  # the newest lost span, as far as it was told
        self._aside: AnswerSeen | None = None
        self._echo = False  # the newest answer may be dead reckoning again
        self.empty = 0
        self.accepted = 0
        self.stale = 0
        self.restarted = 0
        self.gated = 0
        self.ranges_accepted = 0
        self.ranges_gated = 0

    def __getstate__(self) -> dict[str, Any]:
        """Return what a checkpoint holds: what was seen, but not the states, which follow."""
        return {**self.__dict__, "_seen": [filtered.one for filtered in self._seen]}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _seen=[])
        self._filter_on(state["_seen"])

    def receive_answer(
        self, time_s: float, reckoned_m: Array, answered_m: Array, sigma_m: float | None = None
    ) -> bool:
        """Learn from the leader's position (2,) for a past state; return whether it was believed.

        A later answer for the same state, if believed, replaces the earlier one. An answer older
        than all that is kept is stale; one that the filter finds impossible is put aside until
        another confirms it.
        """
        ran_away_m = np.asarray(reckoned_m - answered_m, dtype=np.float64)
        sane = np.all(np.isfinite(ran_away_m)) and np.isfinite(time_s)
        if not sane or (sigma_m is not None and not 0.0 < sigma_m < np.inf):
            self.gated += 1
            return False
        if time_s < self._base.time_s - 1e-6:
            self.stale += 1
            return False
        before = self._seen, self._echo
        answer = self._news(time_s, ran_away_m, sigma_m)
        if answer is None:
            return False
        self._forget_answer(time_s)
        if self._filter.chi_square(self._state_at(time_s), answer) <= _CHI_SQUARE_2_999:
            self._take(answer)
        elif not self._confirmed(answer):
            self._seen, self._echo = before
            return False
        self._aside = None
        self.accepted += 1
        return True

    def receive_range(
        self,
        time_s: float,
        reckoned_m: Array,
        leader_m: Array,
        leader_sigma_m: float,
        slant_m: float,
        depth_difference_m: float,
    ) -> bool:
        """Learn from the range to the leader; return whether it was believed.

        One heard while the motion is unknown counts for the newest instant of which that was told,
        give or take what the vehicle may have moved since.
        """
        s = self._settings
        begun_s, told_s = self._losing_s
        if begun_s < time_s < told_s:
            unseen_m = LOST_SIGMA_MPS * (told_s - time_s)
            time_s, leader_sigma_m = told_s, float(np.hypot(leader_sigma_m, unseen_m))
        range_m = horizontal_m(slant_m, depth_difference_m)
        numbers = [time_s, *reckoned_m, *leader_m, leader_sigma_m, range_m]
        sane = bool(np.isfinite(numbers).all()) and time_s >= self._base.time_s
        if not sane or not s.shortest_range_m <= range_m <= s.longest_range_m:
            self.ranges_gated += 1
            return False
        seen = RangeSeen(
            time_s=time_s,
            reckoned_m=np.asarray(reckoned_m),
            leader_m=np.asarray(leader_m),
            leader_sigma_m=leader_sigma_m,
            range_m=range_m,
            depth_difference_m=depth_difference_m,
        )
        if self._filter.chi_square(self._state_at(time_s), seen) > _CHI_SQUARE_1_99:
            self.ranges_gated += 1
            return False
        self.ranges_accepted += 1
        self._take(seen)
        return True

    def lose(self, begin_s: float, end_s: float) -> None:
        """Doubt a span in which the motion is unknown; a long one is told in parts."""
        if not self._losing_s[0] <= begin_s <= self._losing_s[1] <= end_s:
            self._losing_s = begin_s, begin_s
        begun_s, told_s = self._losing_s
        self._losing_s = begun_s, end_s
        added_m2 = LOST_SIGMA_MPS**2 * ((end_s - begun_s) ** 2 - (told_s - begun_s) ** 2)
        newest = self._seen[-1].one if self._seen else None
        if isinstance(newest, LostSpan) and newest.time_s == told_s:
            self._lost.remove(newest)
            self._forget(newest)
            added_m2 += newest.variance_m2
        self._lost.append(LostSpan(time_s=end_s, variance_m2=added_m2))
        self._take(self._lost[-1])
        if len(self._lost) > _KEPT:
            first, second = self._lost[:2]
            both_m2 = first.variance_m2 + second.variance_m2
            self._lost[:2] = [LostSpan(time_s=second.time_s, variance_m2=both_m2)]

    def set_back(self, from_s: float, to_s: float) -> None:
        """Let what is known by now be known at the time to which the clock was set back.

        By a step shorter than answers are old, what was seen keeps its time, unless that is yet to
        come: answers on their way tell of times before it.
        """
        self._lost = [replace(lost, time_s=min(lost.time_s, to_s)) for lost in self._lost]
        self._losing_s = (np.inf, -np.inf)
        if from_s - to_s < _SHORT_STEP_S and self._base.time_s <= to_s:
            seen = [replace(s.one, time_s=min(s.one.time_s, to_s)) for s in self._seen]
            self._seen = []
            self._filter_on(seen)
            return
        newest = self._seen[-1].state if self._seen else self._base
        now = self._filter.predicted(newest, max(from_s, newest.time_s))
        self._base, self._seen, self._aside = replace(now, time_s=to_s), [], None
        begun_s = self._deployment.time_s - (from_s - to_s)
        self._deployment = replace(self._deployment, time_s=begun_s)

    def corrected(self, time_s: float, reckoned_m: Array) -> tuple[Array, Array]:
        """Return the believed position (2,) at the time, and its covariance (2, 2)."""
        newest = self._seen[-1].state if self._seen else self._base
        state = self._filter.predicted(newest, max(time_s, newest.time_s))
        mean, covariance = state.blended()
        covariance_m2 = covariance[:2, :2]
        if self._echo:
            covariance_m2 = covariance_m2 + self._alone_m2(time_s) * np.eye(2)
        return np.asarray(reckoned_m - mean[:2]), covariance_m2

    def _state_at(self, time_s: float) -> DriftState:
        """Return the state after all that was seen up to the time."""
        before = [s.state for s in self._seen if s.one.time_s <= time_s]
        return before[-1] if before else self._base

    def _take(self, one: Seen) -> None:
        """Put something in its place, and filter again what is later."""
        later = [s.one for s in self._seen if s.one.time_s > one.time_s]
        self._seen = self._seen[: len(self._seen) - len(later)]
        self._filter_on([one, *later])
        while len(self._seen) > _KEPT:
            self._base = self._seen.pop(0).state

    def _forget_answer(self, time_s: float) -> None:
        """Take out the earlier answer for the same state."""
        for s in self._seen:
            if isinstance(s.one, AnswerSeen) and abs(s.one.time_s - time_s) < 1e-6:
                self._forget(s.one)
                return

    def _forget(self, one: Seen) -> None:
        """Take something out, and filter again what is later; what the beginning holds stays."""
        k = next((k for k, s in enumerate(self._seen) if s.one is one), len(self._seen))
        later = [s.one for s in self._seen[k + 1 :]]
        self._seen = self._seen[:k]
        self._filter_on(later)

    def _filter_on(self, seen: Sequence[Seen]) -> None:
        state = self._seen[-1].state if self._seen else self._base
        for one in seen:
            state = self._filter.updated(state, one)
            self._seen.append(_Filtered(one=one, state=state))

    def _news(self, time_s: float, ran_away_m: Array, sigma_m: float | None) -> AnswerSeen | None:
        """Return what an answer says beyond our own dead reckoning, or None if nothing.

        One that is no surer than our dead reckoning alone says nothing.
        """
        alone_m2 = self._alone_m2(time_s)
        if sigma_m is None:
            self._echo = self._is_echo(time_s, ran_away_m, alone_m2)
            sigma_m = self._settings.answer_sigma_m
        elif sigma_m**2 > (1.0 - _LEAST_NEWS) * alone_m2:
            self.empty += 1
            return None
        sigma_m = max(sigma_m, SMALLEST_SIGMA_M)  # a float32 tells of any
        return AnswerSeen(time_s=time_s, ran_away_m=ran_away_m, sigma_m=sigma_m)

    def _alone_m2(self, time_s: float) -> float:
        """Return the variance of dead reckoning that nobody corrects, along one axis."""
        at_s = max(time_s, self._deployment.time_s)
        lost_m2 = sum(lost.variance_m2 for lost in self._lost if lost.time_s <= at_s)
        return lost_m2 + float(self._filter.predicted(self._deployment, at_s).blended()[1][0, 0])

    def _is_echo(self, time_s: float, ran_away_m: Array, alone_m2: float) -> bool:
        """Return whether an answer that tells no variance may be our dead reckoning again.

        Before its first closures a leader knows little more than the dead reckoning that it was
        told, and answers with that. An answer near to dead reckoning is either such an echo, or
        the position of a vehicle that hardly drifted; the likelier by then is believed.
        """
        s = self._settings
        early = float(np.exp(-max(time_s - self._deployment.time_s, 0.0) / s.first_closures_s))
        missed_m2, noise_m2 = float(ran_away_m @ ran_away_m), s.answer_sigma_m**2
        echo, position = (
            share * np.exp(-0.5 * missed_m2 / variance_m2) / variance_m2
            for share, variance_m2 in (
                (early, noise_m2 + s.echo_share**2 * alone_m2),
                (1.0 - early, noise_m2 + alone_m2),
            )
        )
        return bool(echo > position)

    def _confirmed(self, answer: AnswerSeen) -> bool:
        """Start over from the deployment with an answer that agrees with the one put aside."""
        self.gated += 1
        aside, self._aside = self._aside, answer
        if aside is None:
            return False
        apart_m = float(np.hypot(*(answer.ran_away_m - aside.ran_away_m)))
        drifted_m = 3 * self._settings.bias_sigma_mps * abs(answer.time_s - aside.time_s)
        if apart_m > 4 * answer.sigma_m + drifted_m:
            return False
        self.restarted += 1
        self._base, self._seen = self._deployment, []
        self._filter_on(self._lost)
        self._take(answer)
        return True
