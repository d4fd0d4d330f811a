"""Everything that `--set` reaches: the scenario, the air, and each vehicle's configuration."""

from collections.abc import Mapping
from dataclasses import dataclass

from firmware.follower.settings import FollowerSettings
from firmware.leader.settings import LeaderSettings
from host_tools.scenario import ScenarioSettings
from protocol.schedule import SlotSettings
from protocol.settings import Settings, replace, setting


@dataclass(frozen=True, slots=True, kw_only=True)
class MissionSettings(Settings):
    """One mission; a short key means the scenario's where several parts have one of that name."""

    scenario: ScenarioSettings = setting(ScenarioSettings, "", "what is surveyed, and its errors")
    slots: SlotSettings = setting(SlotSettings, "", "who may transmit when")
    follower: FollowerSettings = setting(FollowerSettings, "", "each follower's configuration")
    leader: LeaderSettings = setting(LeaderSettings, "", "the leader's configuration")


def changed(settings: MissionSettings, changes: Mapping[str, object]) -> MissionSettings:
    """Return the settings with changes by dotted or short key.

    The leader is told how uncertain the scenario makes the starts.

    Raises ConfigError for a key that is unknown or ambiguous, or a value out of bounds.
    """
    settings = replace(settings, changes, prefer="scenario")
    told_m = max(settings.leader.graph.start_sigma_m, settings.scenario.start_error_m)
    derived = {
        "slots.followers": max(settings.scenario.followers, 1),
        "leader.graph.start_sigma_m": told_m,
    }
    return replace(settings, derived)
