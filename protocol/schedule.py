"""Who may transmit when: whole seconds of the shared clock, fixed slots, half-duplex by design."""

import math
from dataclasses import dataclass

from protocol.errors import ConfigError
from protocol.settings import Settings, setting

CLOCK_TOLERANCE_S = 1e-6
"""A slot that began this short a while ago still counts as now; far below any bit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SlotSettings(Settings):
    """The raster of the air; the defaults are the paper's 0.25 Hz and 0.1 Hz."""

    followers: int = setting(1, "vehicles", "the paper's system", minimum=1, maximum=14)
    follower_slot_s: int = setting(4, "s", "0.25 Hz, section 4.1 of the paper", minimum=1)
    leader_period_s: int = setting(20, "s", "two answers in it are 0.1 Hz", minimum=1)
    leader_offsets_s: tuple[int, ...] = setting(
        (3, 11), "s", "3 s after a follower's slot begins, its frame has passed within 1.4 km"
    )

    def __post_init__(self) -> None:
        # super() does not survive the new class that slots=True makes
        Settings.__post_init__(self)
        bad = [s for s in self.leader_offsets_s if not 0 <= s < self.leader_period_s]
        if bad or not self.leader_offsets_s:
            raise ConfigError(
                f"leader_offsets_s is {self.leader_offsets_s}; give seconds from 0 to"
                f" {self.leader_period_s - 1}"
            )


class Slots:
    """Answers when a vehicle's next slot begins; holds no state."""

    def __init__(self, settings: SlotSettings) -> None:
        self.settings = settings

    def next_follower_slot_s(self, now_s: float, follower: int = 1) -> float:
        """Return the first slot of a follower (from 1) that begins now or later."""
        settings = self.settings
        if not 1 <= follower <= settings.followers:
            raise ConfigError(f"follower {follower} has no slot; there are {settings.followers}")
        period_s = settings.follower_slot_s * settings.followers
        offset_s = settings.follower_slot_s * (follower - 1)
        return _next_in_raster(now_s, period_s, offset_s)

    def next_leader_slot_s(self, now_s: float) -> float:
        """Return the first of the leader's slots that begins now or later."""
        settings = self.settings
        return min(
            _next_in_raster(now_s, settings.leader_period_s, offset_s)
            for offset_s in settings.leader_offsets_s
        )

    def next_slot_s(self, vehicle: int, now_s: float) -> float:
        """Return the next slot of the leader (vehicle 0) or of a follower (1 and up)."""
        if vehicle == 0:
            return self.next_leader_slot_s(now_s)
        return self.next_follower_slot_s(now_s, vehicle)

    def frames_per_submap(self, submap_s: float) -> int:
        """Return how many slots one follower has while a sub-map is measured."""
        return int(submap_s // (self.settings.follower_slot_s * self.settings.followers))


def _next_in_raster(now_s: float, period_s: float, offset_s: float) -> float:
    turns = math.ceil((now_s - CLOCK_TOLERANCE_S - offset_s) / period_s)
    return offset_s + period_s * turns


def reach_m(
    slot_s: float, frame_bytes: int, rate_bps: float, sound_speed_mps: float = 1500.0
) -> float:
    """Return the distance within which a frame has passed entirely before its slot ends."""
    return (slot_s - 8.0 * frame_bytes / rate_bps) * sound_speed_mps
