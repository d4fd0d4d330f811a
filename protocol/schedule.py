"""Who may transmit when: whole seconds of the shared clock, fixed slots, half-duplex by design."""

import math
from dataclasses import dataclass

from protocol.errors import ConfigError
from protocol.settings import Settings, setting
from protocol.vehicles import LEADER

CLOCK_TOLERANCE_S = 1e-6
"""A slot that began this short a while ago still counts as now; far below any bit."""

_PAST_S = 1e-3  # after a slot's beginning, its next one is looked for


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
        if vehicle == LEADER:
            return self.next_leader_slot_s(now_s)
        return self.next_follower_slot_s(now_s, vehicle)

    def frames_per_submap(self, submap_s: float) -> int:
        """Return how many frames one follower may send while a sub-map is measured."""
        settings = self.settings
        slots = int(submap_s // (settings.follower_slot_s * settings.followers))
        return slots * settings.frames_per_slot


class Turns:
    """One vehicle's slots as they come, and how many of them it missed."""

    def __init__(self, slots: Slots, vehicle: int, start_s: float) -> None:
        settings = slots.settings
        self.missed = 0
        self._slots, self._vehicle = slots, vehicle
        is_leader = vehicle == LEADER
        self._frames = 1 if is_leader else settings.frames_per_slot
        turn_s = settings.follower_slot_s * settings.followers
        self._apart_s = settings.leader_period_s if is_leader else turn_s
        self._next_s, self._left = slots.next_slot_s(vehicle, start_s), self._frames

    def due_s(self, now_s: float) -> float | None:
        """Return the slot that begins now, once for each frame that it holds, or else None."""
        if self._is_ahead(now_s):
            return None
        slot_s = self._slots.next_slot_s(self._vehicle, now_s)
        is_late = slot_s > now_s + CLOCK_TOLERANCE_S
        self.missed += is_late
        self._left -= 1
        if is_late or self._left <= 0:
            self.skip(now_s)
        return None if is_late else slot_s

    def skip(self, now_s: float) -> None:
        """Leave what is left of a slot that begins now: there is nothing to send."""
        self._next_s = self._slots.next_slot_s(self._vehicle, now_s + _PAST_S)
        self._left = self._frames

    def _is_ahead(self, now_s: float) -> bool:
        """Return whether the next slot, found before, has yet to come.

        One that lies farther ahead than slots lie apart was found before the clock was set back.
        """
        ahead_s = self._next_s - now_s
        return CLOCK_TOLERANCE_S < ahead_s <= self._apart_s + CLOCK_TOLERANCE_S


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
