"""Absolute positions: GNSS at the surface, USBL from a ship or about a follower. Judged, then used.

A fix waits until its vehicle's dead reckoning is known at its time. It is gated by the estimate's
own covariance: an impossible one is counted and dropped, and so is one right after another unless
it is much surer.
"""

from collections import Counter, deque
from dataclasses import dataclass

import numpy as np

from firmware.leader.fleet import Fleet
from firmware.leader.pose_graph import PoseGraph
from firmware.soundings import Fix
from protocol.errors import EstimationError
from protocol.settings import Settings, setting


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

    def __init__(self, settings: FixSettings) -> None:
        self.counters: Counter[str] = Counter()
        self._settings = settings
        self._held: deque[tuple[float, Fix]] = deque(maxlen=settings.held)
        self._used: dict[int, tuple[float, float]] = {}  # time and sigma of each chain's last

    def hold(self, time_s: float, fix: Fix) -> None:
        """Keep a fix until it can be used."""
        sane = np.isfinite([fix.north_m, fix.east_m]).all()
        if not sane or not 0.0 < fix.sigma_m <= self._settings.sigma_limit_m:
            self.counters["fixes_bad"] += 1
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

    def _entered(self, time_s: float, fix: Fix, fleet: Fleet, graph: PoseGraph) -> str:
        chain = fleet.chain_at(fix.vehicle, time_s)
        last_s, last_sigma_m = self._used.get(chain, (-np.inf, np.inf))
        if abs(time_s - last_s) < self._settings.apart_s and fix.sigma_m > last_sigma_m / 2.0:
            return "fixes_alike"
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
        self._used[chain] = time_s, fix.sigma_m
        return "fixes_used"
