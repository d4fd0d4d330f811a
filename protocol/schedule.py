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
    frames_per_slot: int = setting(
        1, "frames", "two where a Micro-Modem packs them at rate 3 or 4", minimum=1, maximum=8
    )
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

    def is_between(self, vehicle: int, next_slot_s: float, now_s: float) -> bool:
        """Return whether a vehicle's next slot, told before, has yet to come.

        One that lies farther ahead than slots lie apart was told before the clock was set back.
        """
        settings = self.settings
        turn_s = settings.follower_slot_s * settings.followers
        apart_s = settings.leader_period_s if vehicle == 0 else turn_s
        return CLOCK_TOLERANCE_S < next_slot_s - now_s <= apart_s + CLOCK_TOLERANCE_S

    def frames_per_submap(self, submap_s: float) -> int:
        """Return how many frames one follower may send while a sub-map is measured."""
        settings = self.settings
        slots = int(submap_s // (settings.follower_slot_s * settings.followers))
        return slots * settings.frames_per_slot


def _next_in_raster(now_s: float, period_s: float, offset_s: float) -> float:
    turns = math.ceil((now_s - CLOCK_TOLERANCE_S - offset_s) / period_s)
    return offset_s + period_s * turns


@dataclass(frozen=True, slots=True, kw_only=True)
class Air:
    """What the guard times follow from: sizes, rate and speed of sound."""

    frame_bytes: int = 256
    answer_bytes: int = 22
    rate_bps: float = 1000.0
    sound_speed_mps: float = 1500.0

    @property
    def frame_s(self) -> float:
        """Airtime of a follower's frame."""
        return 8.0 * self.frame_bytes / self.rate_bps

    @property
    def answer_s(self) -> float:
        """Airtime of the leader's answer."""
        return 8.0 * self.answer_bytes / self.rate_bps


def conflict_free_reach_m(settings: SlotSettings, air: Air) -> float:
    """Return the distance up to which these slots cannot collide, whatever the geometry.

    Within it a follower's frame has passed the leader before the leader answers and before the next
    follower's frame, and the answer has passed all followers before any of them transmits.
    """
    slot_s = settings.follower_slot_s
    starts_s = (
        offset_s + turn * settings.leader_period_s
        for offset_s in settings.leader_offsets_s
        for turn in range(slot_s)  # after slot_s periods the two rasters repeat
    )
    guards_s = [slot_s - air.frame_s]
    for phase_s in {start_s % slot_s for start_s in starts_s}:
        guards_s += [phase_s - air.frame_s, slot_s - phase_s - air.answer_s]
    return max(0.0, min(guards_s)) * air.sound_speed_mps


def planned_slots(followers: int, reach_m: float, air: Air) -> SlotSettings:
    """Return the shortest slots of whole seconds that cannot collide within a distance.

    The leader answers in two of every five slots, as in the paper, after the frame has passed.
    """
    travel_s = reach_m / air.sound_speed_mps
    phase_s = math.ceil(air.frame_s + travel_s)
    slot_s = math.ceil(phase_s + air.answer_s + travel_s)
    return SlotSettings(
        followers=followers,
        follower_slot_s=slot_s,
        leader_period_s=5 * slot_s,
        leader_offsets_s=(phase_s, phase_s + 2 * slot_s),
    )
