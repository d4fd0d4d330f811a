"""What the pose graph believes of dead reckoning and of what it is told, before a mission tells."""

from dataclasses import dataclass

import numpy as np

from firmware.leader.wander import reckoned_m2
from protocol.errors import ConfigError
from protocol.settings import Settings, setting

_SOUND_MPS = 1500.0  # turns times into ranges; a prior needs it no better


@dataclass(frozen=True, slots=True, kw_only=True)
class GraphSettings(Settings):
    """What the graph believes of dead reckoning, closures and ranges."""

    node_interval_s: float = setting(
        10.0, "s", "key-frame spacing; dead reckoning adds 0.6 m of noise in it", minimum=1.0
    )
    start_sigma_m: float = setting(
        0.5, "m", "uncertainty of each start in the common datum", minimum=1e-3
    )
    odometry_noise: float = setting(
        0.2, "m/sqrt(s)", "random part of dead reckoning: variance 0.04 a second", minimum=1e-4
    )
    bias_sigma_mps: float = setting(
        0.2, "m/s", "unmeasured current at the start, each axis", minimum=1e-4
    )
    bias_difference_mps: float = setting(
        0.2, "m/s", "vehicles drift in the same water: their biases differ by less", minimum=1e-4
    )
    bias_walk: float = setting(
        0.004, "m/s/sqrt(s)", "lets a current of 0.2 m/s turn within an hour", minimum=1e-7
    )
    walk_factor: float = setting(
        4.0, "1", "by which the walk may well be wrong before the mission tells", minimum=1.01
    )
    walk_interval_s: float = setting(
        300.0, "s", "over which drift is compared to learn it: half a survey line", minimum=60.0
    )
    walk_memory_s: float = setting(3600.0, "s", "of drift that is compared", minimum=600.0)
    walk_apart: float = setting(
        0.175,
        "1",
        "of the walk is each vehicle's own: a current turns for all in it alike",
        minimum=1e-3,
    )
    alike_interval_s: float = setting(
        60.0, "s", "between the records that say so: chains stay loosely coupled", minimum=10.0
    )
    heading_bias_sigma_deg: float = setting(
        0.5, "degree", "mounting error of the attitude reference", minimum=1e-6
    )
    log_scale_sigma: float = setting(0.005, "1", "scale error of the Doppler log", minimum=1e-9)
    range_sigma_m: float = setting(
        1.5,
        "m",
        "noise of a range (1 m, Eq. 13), of the way to its key frames, and bend",
        minimum=1e-3,
    )
    clock_offset_sigma_ms: float = setting(
        0.0, "ms", "of a follower's clock against ours; 0: disciplined, nothing is estimated",
        minimum=0.0, maximum=100.0,
    )  # fmt: skip
    clock_drift_sigma_ppm: float = setting(
        0.0, "ppm", "of its rate, where an offset is estimated: 1 for a fair crystal", minimum=0.0
    )
    closure_floor_m: float = setting(
        0.4, "m", "strain within a sub-map that no match can see", minimum=0.0
    )
    robust_kernel: float = setting(
        3.0, "sigma", "Huber: convex, so that large true innovations cannot stick", minimum=0.1
    )

    def __post_init__(self) -> None:
        # super() does not survive the new class that slots=True makes
        Settings.__post_init__(self)
        if self.alike_interval_s % self.node_interval_s:  # no node would be at such a time
            raise ConfigError(
                f"alike_interval_s is {self.alike_interval_s} s; it must be a multiple of"
                f" node_interval_s, {self.node_interval_s} s"
            )

    @property
    def clock_offset_sigma_m(self) -> float:
        """The sigma of a clock's offset, as a distance at the speed of sound."""
        return _SOUND_MPS * 1e-3 * self.clock_offset_sigma_ms

    @property
    def clock_drift_sigma_m_per_h(self) -> float:
        """The sigma of a clock's rate, as a distance an hour."""
        return _SOUND_MPS * 3600e-6 * self.clock_drift_sigma_ppm

    def start_sigma_at(self, time_s: float) -> float:
        """Return the position's sigma where a chain is first heard of, or begun anew, at a time.

        Starts are known at mission time zero; dead reckoning has run away from them since.
        """
        variance_m2 = reckoned_m2(
            max(time_s, 0.0),
            self.odometry_noise,
            self.bias_walk,
            start_m=self.start_sigma_m,
            drift_mps=self.bias_sigma_mps,
        )
        return float(np.sqrt(variance_m2))
