"""Absolute positions: GNSS at the surface, USBL from a ship or about a follower. Judged, then used.

A fix waits until its vehicle's dead reckoning is known at its time. It is gated by the estimate's
own covariance: an impossible one is counted and dropped. Where refused fixes agree with the
estimate on the way between them, it is the estimate that is doubted.
"""

from collections import Counter, deque
from dataclasses import dataclass

import numpy as np

from firmware.geometry import Array, offset_covariance
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
    held: int = setting(64, "fixes", "of vehicles whose track is late; the oldest go", minimum=1)
    longest_wait_s: float = setting(900.0, "s", "as long as a follower keeps a frame", minimum=10.0)


class Fixes:
    """Fixes in by `hold`, factors out by `use`; bounded, everything dropped is counted."""

    def __init__(self, settings: FixSettings) -> None:
        self.counters: Counter[str] = Counter()
        self._settings = settings
        self._held: deque[tuple[float, Fix]] = deque(maxlen=settings.held)
        self._refused: dict[int, tuple[float, Fix]] = {}  # by chain, the first since one was used

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
        fleet.extend(chain)
        anchor = graph.anchor(chain, time_s, fleet.track(chain))
        position_m, covariance_m2 = _position(fix), self._covariance(fix)
        innovation_m = position_m - graph.position(anchor)
        if not self._is_possible(innovation_m, graph.covariance([anchor]) + covariance_m2):
            if np.hypot(*innovation_m) <= self._settings.sigma_limit_m:
                self._doubt(time_s, fix, chain, fleet, graph)
            return "fixes_rejected"
        graph.add_absolute(anchor, position_m, covariance_m2)
        graph.update()
        self._refused.pop(chain, None)
        return "fixes_used"

    def _doubt(self, time_s: float, fix: Fix, chain: int, fleet: Fleet, graph: PoseGraph) -> None:
        """Doubt the estimate between two refused fixes that tell of the way there what it does.

        Doubt grows while they go on so. A fix that is wrong by itself tells of another way; so does
        a receiver that is stuck, as soon as the vehicle went farther than both may err.
        """
        first_s, first = self._refused.setdefault(chain, (time_s, fix))
        ends = [graph.anchor(chain, at_s, fleet.track(chain)) for at_s in (first_s, time_s)]
        way_m, told_m = graph.offset(*ends), _position(fix) - _position(first)
        spread_m2 = offset_covariance(graph.covariance(ends))
        spread_m2 += self._covariance(first) + self._covariance(fix)
        is_alike = self._is_possible(told_m - way_m, spread_m2)
        if is_alike and self._is_possible(way_m, spread_m2):
            return
        self._refused[chain] = time_s, fix
        if is_alike:
            graph.lose(chain, *sorted((first_s, time_s)))
            graph.update()
            self.counters["fixes_that_cast_doubt"] += 1

    def _is_possible(self, miss_m: Array, spread_m2: Array) -> bool:
        return bool(miss_m @ np.linalg.solve(spread_m2, miss_m) <= self._settings.gate_chi_square)

    def _covariance(self, fix: Fix) -> Array:
        return (fix.sigma_m**2 + self._settings.sigma_floor_m**2) * np.eye(2)


def _position(fix: Fix) -> Array:
    return np.array([fix.north_m, fix.east_m])
