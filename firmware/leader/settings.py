"""The configuration of a leader: one frozen tree that gathers the settings of its parts."""

import dataclasses
from dataclasses import dataclass

from firmware.compression.settings import BinningSettings
from firmware.leader.closure_settings import ClosureSettings
from firmware.leader.composition import CompositionSettings
from firmware.leader.coverage import CoverageSettings
from firmware.leader.fixes import FixSettings
from firmware.leader.fleet import FleetSettings
from firmware.leader.graph_settings import GraphSettings
from firmware.leader.judgement import JudgementSettings
from firmware.leader.manoeuvre import ManoeuvreSettings
from firmware.leader.matches import MatchingSettings
from firmware.leader.range_judge import RangeSettings
from firmware.leader.reconstruction import ReconstructionSettings
from firmware.soundings import SonarSettings
from firmware.submap_builder import SubmapSettings
from protocol.packets import MAX_FRAGMENTS
from protocol.reassembly import ReassemblySettings
from protocol.schedule import Slots
from protocol.settings import Settings, setting


@dataclass(frozen=True, slots=True, kw_only=True)
class LeaderSettings(Settings):
    """Everything that a leader may be told."""

    sonar: SonarSettings = setting(SonarSettings, "", "the multibeam sonar")
    submaps: SubmapSettings = setting(SubmapSettings, "", "what a sub-map is")
    binning: BinningSettings = setting(BinningSettings, "", "how soundings are thinned")
    reassembly: ReassemblySettings = setting(ReassemblySettings, "", "fragments to sub-maps")
    reconstruction: ReconstructionSettings = setting(ReconstructionSettings, "", "frames to grids")
    matching: MatchingSettings = setting(MatchingSettings, "", "terrain matching")
    closures: ClosureSettings = setting(ClosureSettings, "", "loop closures")
    judgement: JudgementSettings = setting(JudgementSettings, "", "which closures to believe")
    sheets_between_audits: int = setting(
        10, "sub-maps", "an audit of all closures every two minutes or so", minimum=1
    )
    ranges: RangeSettings = setting(RangeSettings, "", "one-way travel times")
    graph: GraphSettings = setting(GraphSettings, "", "the pose graph")
    composition: CompositionSettings = setting(CompositionSettings, "", "the graph's past")
    coverage: CoverageSettings = setting(
        CoverageSettings, "", "which old sub-maps are still matched with"
    )
    manoeuvre: ManoeuvreSettings = setting(ManoeuvreSettings, "", "which manoeuvres are proposed")
    fixes: FixSettings = setting(FixSettings, "", "GNSS and USBL")
    fleet: FleetSettings = setting(FleetSettings, "", "the followers' trajectories")
    answers: str = setting(
        "paper",
        "",
        "22 bytes; or `extended`, 42 bytes with variances, own position and what to repeat",
        choices=("paper", "extended"),
    )
    atlas_submaps: int = setting(
        20_000,
        "sub-maps",
        "a day of two vehicles is 6,480; on the shelf 8 kB each",
        minimum=4,
        maximum=100_000,
    )
    hop_s: float = setting(
        20.0, "s", "own sub-maps overlap by half: closures come earlier", minimum=4.0, maximum=40.0
    )


def reassembly_of(settings: LeaderSettings, slots: Slots) -> ReassemblySettings:
    """Return the reassembly's settings as the slots of the air require.

    Many followers need room, and take long to send a sub-map; where they have air for repeats, it
    waits for those.
    """
    told, air = settings.reassembly, slots.settings
    sending_s = float(MAX_FRAGMENTS * air.follower_slot_s * air.followers)
    sized = dataclasses.replace(
        told,
        slots=max(told.slots, 2 * air.followers),  # a current and an overtaken sub-map each
        oldest_s=max(told.oldest_s, min(sending_s, settings.fleet.oldest_state_s)),
    )
    if settings.answers != "extended":
        return sized
    room = slots.frames_per_submap(settings.submaps.duration_s)
    return dataclasses.replace(sized, fragments_with_repeats=max(room - 1, 0))
