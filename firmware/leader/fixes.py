"""Absolute positions: GNSS at the surface, USBL from a ship or about a follower. Judged, then used.

A fix waits until its vehicle's dead reckoning is known at its time; one right after another is
dropped at once unless it is much surer. It is gated by the estimate's own covariance: an impossible
one is dropped, too, and everything dropped is counted.
"""

from collections import Counter, deque
from dataclasses import dataclass

import numpy as np

from firmware.leader.fleet import Fleet
from firmware.leader.pose_graph import PoseGraph
from firmware.soundings import Fix
from protocol.errors import EstimationError
from protocol.settings import Settings, setting
from protocol.vehicles import LEADER

_SWIFT_MPS = 5.0  # no survey is faster


@dataclass(frozen=True, slots=True, kw_only=True)
class FixSettings(Settings):
    """Which fixes are believed, and how many wait."""

    gate_chi_square: float = setting(
        13.8, "1", "99.9 % of true innovations of two components pass", minimum=1.0
    )
    sigma_floor_m: float = setting(
        1.0, "m", "for the way from the antenna and the instant to the key frame", minimum=0.0
    )
    sigma_limit_m: float = setting(
        1e4, "m", "a fix that is worse says nothing of a survey", minimum=1.0
    )
    apart_s: float = setting(
        60.0,
        "s",
        "what is wrong with a fix lasts for minutes: more of them tell no more",
        minimum=0.0,
    )
    held: int = setting(64, "fixes", "of vehicles whose track is late; the oldest go", minimum=1)
    longest_wait_s: float = setting(900.0, "s", "as long as a follower keeps a frame", minimum=10.0)


class Fixes:
    """Fixes in by `hold`, factors out by `use`; bounded, everything dropped is counted."""

    def __init__(self, settings: FixSettings, followers: int) -> None:
        self.counters: Counter[str] = Counter()
        self._settings, self._followers = settings, followers
        self._held: deque[tuple[float, Fix]] = deque(maxlen=settings.held)
        self._used: dict[int, tuple[float, Fix]] = {}  # each vehicle's last, and its time

    def hold(self, time_s: float, fix: Fix) -> None:
        """Keep a fix that tells something new until it can be used."""
        if not LEADER <= fix.vehicle <= self._followers:
            self.counters["fixes_of_unknown_vehicles"] += 1
            return
        sane = np.isfinite([fix.north_m, fix.east_m]).all()
        if not sane or not 0.0 < fix.sigma_m <= self._settings.sigma_limit_m:
            self.counters["fixes_bad"] += 1
            return
        if self._is_alike(time_s, fix):
            self.counters["fixes_alike"] += 1
            return
        if len(self._held) == self._held.maxlen:
            self.counters["fixes_overwritten"] += 1
        self._held.append((time_s, fix))

    def use(self, fleet: Fleet, graph: PoseGraph, now_s: float) -> None:
        """Judge and enter the fixes whose vehicles are known at their times."""
        for _ in range(len(self._held)):
            time_s, fix = self._held.popleft()
            if not fleet.reaches(fix.vehicle, time_s):
                if now_s - time_s <= self._settings.longest_wait_s:
                    self._held.append((time_s, fix))
                else:
                    self.counters["fixes_too_late"] += 1
                continue
            try:
                self.counters[self._entered(time_s, fix, fleet, graph)] += 1
            except EstimationError:
                self.counters["fixes_unplaceable"] += 1

    def _is_alike(self, time_s: float, fix: Fix) -> bool:
        """Return whether a fix is hardly surer than one of its vehicle shortly before or after.

        One that it contradicts may be the wild one of the two: both are judged.
        """
        return any(
            other.vehicle == fix.vehicle
            and abs(time_s - other_s) < self._settings.apart_s
            and fix.sigma_m > other.sigma_m / 2.0
            and _agree(fix, other, abs(time_s - other_s))
            for other_s, other in (*self._held, *self._used.values())
        )

    def _entered(self, time_s: float, fix: Fix, fleet: Fleet, graph: PoseGraph) -> str:
        """Enter a fix that its gate lets pass; return the counter of what became of it.

        Raises EstimationError where the graph cannot tell.
        """
        chain = fleet.chain_at(fix.vehicle, time_s)
        fleet.extend(chain)
        anchor = graph.anchor(chain, time_s, fleet.track(chain))
        variance_m2 = fix.sigma_m**2 + self._settings.sigma_floor_m**2
        position_m = np.array([fix.north_m, fix.east_m])
        innovation_m = position_m - graph.position(anchor)
        spread_m2 = graph.covariance([anchor]) + variance_m2 * np.eye(2)
        if innovation_m @ np.linalg.solve(spread_m2, innovation_m) > self._settings.gate_chi_square:
            return "fixes_rejected"
        graph.add_absolute(anchor, position_m, variance_m2 * np.eye(2))
        graph.update()
        self._used[fix.vehicle] = time_s, fix
        return "fixes_used"


def _agree(fix: Fix, other: Fix, apart_s: float) -> bool:
    """Return whether a vehicle may have been at both."""
    apart_m = np.hypot(fix.north_m - other.north_m, fix.east_m - other.east_m)
    return bool(apart_m <= 3.0 * (fix.sigma_m + other.sigma_m) + _SWIFT_MPS * apart_s)
