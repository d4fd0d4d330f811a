"""The configuration of a follower: one frozen tree that gathers the settings of its parts."""

from dataclasses import dataclass

from firmware.compression.settings import BinningSettings, CompressionSettings
from firmware.follower.correction import CorrectionSettings
from firmware.soundings import SonarSettings
from firmware.submap_builder import SubmapSettings
from protocol.packets import FRAME_BYTES, SMALL_FRAME_BYTES
from protocol.repeats import RepeatSettings
from protocol.settings import Settings, setting


@dataclass(frozen=True, slots=True, kw_only=True)
class FollowerSettings(Settings):
    """Everything that a follower may be told."""

    profile: str = setting(
        "lattice",
        "",
        "what a sub-map is sent as; `auto` is `lattice` in as few frames as do about as well",
        choices=("paper", "dense", "lattice", "auto"),
    )
    frames_per_submap: int | None = setting(
        None,
        "frames",
        "of `dense` or `lattice`; none: compression.frames, or what the slots allow",
        minimum=1,
        maximum=15,
    )
    repeats: RepeatSettings = setting(RepeatSettings, "", "lost fragments sent again")
    sonar: SonarSettings = setting(SonarSettings, "", "the multibeam sonar")
    submaps: SubmapSettings = setting(SubmapSettings, "", "what a sub-map is")
    binning: BinningSettings = setting(BinningSettings, "", "how soundings are thinned")
    compression: CompressionSettings = setting(CompressionSettings, "", "the fit")
    correction: CorrectionSettings = setting(CorrectionSettings, "", "use of the answers")
    steps_per_tick: int = setting(
        4, "steps", "of the fit between two pings; one of `paper` then ends within 16 s", minimum=1
    )
    track_s: float = setting(
        600.0, "s", "of own track kept to place answers on, which are two minutes old", minimum=60.0
    )

    @property
    def frame_bytes(self) -> int:
        """The size of the frames that sub-maps are sent in."""
        may_be_small = self.profile in {"lattice", "auto"}
        is_small = may_be_small and self.compression.small_frames
        return SMALL_FRAME_BYTES if is_small else FRAME_BYTES
