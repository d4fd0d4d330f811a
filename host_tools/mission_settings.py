"""Everything that `--set` reaches: the scenario, the air, and each vehicle's configuration."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from firmware.follower.settings import FollowerSettings
from firmware.leader.settings import LeaderSettings
from host_tools.scenario import ScenarioSettings
from protocol.errors import ConfigError
from protocol.schedule import Air, SlotSettings, planned_slots
from protocol.settings import Settings, replace, setting

_REACH_M = 1000.0  # that suggested slots are clear to


@dataclass(frozen=True, slots=True, kw_only=True)
class MissionSettings(Settings):
    """One mission; a short key means the scenario's where several parts have one of that name."""

    scenario: ScenarioSettings = setting(ScenarioSettings, "", "what is surveyed, and its errors")
    slots: SlotSettings = setting(SlotSettings, "", "who may transmit when")
    follower: FollowerSettings = setting(FollowerSettings, "", "each follower's configuration")
    leader: LeaderSettings = setting(LeaderSettings, "", "the leader's configuration")


def mission_of(scenario: ScenarioSettings, changes: Mapping[str, object]) -> MissionSettings:
    """Return a mission of a scenario with changes, which may say otherwise than what follows.

    The leader is told what the scenario's data sheets say of compass and log, nothing of how these
    really err.

    Raises ConfigError as `changed` does.
    """
    settings = MissionSettings(scenario=scenario)
    sheets = replace(settings, changes, prefer="scenario").scenario
    told = {
        "leader.graph.heading_bias_sigma_deg": sheets.heading_bias_told_deg,
        "leader.graph.log_scale_sigma": sheets.log_scale_told,
    }
    return changed(replace(settings, told), changes)


def changed(settings: MissionSettings, changes: Mapping[str, object]) -> MissionSettings:
    """Return the settings with changes by dotted or short key.

    The leader is told how uncertain the scenario makes the starts, unless that is set, slots how
    many followers it has.
    Nothing is told of compass and log: `mission_of` does.

    Raises ConfigError for a key that is unknown or ambiguous, or a value out of bounds.
    """
    settings = replace(settings, changes, prefer="scenario")
    told_m = max(settings.leader.graph.start_sigma_m, settings.scenario.start_error_m)
    followers = max(settings.scenario.followers, 1)
    if "slots.followers" in changes and settings.slots.followers != followers:
        raise ConfigError(
            f"slots have {settings.slots.followers} followers, the scenario has {followers}; "
            f"give followers={settings.slots.followers}"
        )
    derived: dict[str, object] = {"slots.followers": followers}
    if not any(key.endswith("graph.start_sigma_m") for key in changes):
        derived["leader.graph.start_sigma_m"] = told_m
    return replace(settings, derived)


def check_air(settings: MissionSettings) -> None:
    """Raise ConfigError where a frame sounds for longer than its slot at the water's rate."""
    rate_bps, slots = settings.scenario.water.rate_bps, settings.slots
    air = Air(frame_bytes=settings.follower.frame_bytes, rate_bps=rate_bps)
    if air.frame_s <= slots.follower_slot_s:
        return
    least_bps = math.ceil(8.0 * air.frame_bytes / slots.follower_slot_s)
    planned = planned_slots(slots.followers, _REACH_M, air)
    offsets_s = ",".join(map(str, planned.leader_offsets_s))
    raise ConfigError(
        f"a frame of {air.frame_bytes} bytes sounds for {air.frame_s:.2f} s at rate_bps="
        f"{rate_bps:g}, its slot has {slots.follower_slot_s} s; set rate_bps to {least_bps} or "
        "more, or "
        f"follower_slot_s={planned.follower_slot_s}, leader_period_s={planned.leader_period_s} and "
        f"leader_offsets_s={offsets_s}"
    )
