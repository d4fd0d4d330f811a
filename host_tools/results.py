"""What a simulated mission hands to the evaluation."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from firmware.geometry import Array
from host_tools.mapping import DepthMap
from host_tools.scenario import ScenarioSettings
from host_tools.simulator.placement import Site
from host_tools.simulator.vehicle import TrueTrack
from protocol.acoustics import Delivery
from protocol.vehicles import name_of

STAGES = ("detected", "gated", "consistent")
Counters = Mapping[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleResult:
    """One vehicle on the mission's 1 Hz grid (T,) of `truth.time_s`, in NED.

    dead_reckoning_m, live_m and final_m are (T, 2) north, east; yaw_rad (T,) is the measured
    heading. Covariances are (T, 2, 2), NaN where unknown, or None. Live is what the vehicle itself
    believed at that moment, final the leader's smoothed estimate at the end.
    """

    vehicle: int
    truth: TrueTrack
    dead_reckoning_m: Array
    live_m: Array
    final_m: Array
    yaw_rad: Array
    live_covariance_m2: Array | None = None
    final_covariance_m2: Array | None = None

    @property
    def name(self) -> str:
        """The name in files: leader, follower_1, ..."""
        return name_of(self.vehicle)


@dataclass(frozen=True, slots=True, kw_only=True)
class ClosureResult:
    """One detected loop closure: `to` minus `from`, and how far it came.

    from_time_s and to_time_s are the times of the states that it links. stage is the last one
    passed of `STAGES`. axis_deg is the direction from north in which a one-axis closure holds.
    """

    t_s: float
    from_vehicle: int
    from_submap: int
    from_time_s: float
    to_vehicle: int
    to_submap: int
    to_time_s: float
    measured_north_m: float
    measured_east_m: float
    sigma_north_m: float
    sigma_east_m: float
    residual: float
    stage: str
    active_at_end: bool
    axis_deg: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SoundingPatch:
    """Soundings, or cells of a reconstructed sub-map, in a vehicle's raw dead reckoning.

    All arrays are (N,). time_s says when each was measured, so that it moves with the trajectory.
    """

    vehicle: int
    north_m: Array
    east_m: Array
    depth_m: Array
    variance_m2: Array
    time_s: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class MissionResult:
    """A whole mission, ready to be judged and written.

    truth_map was fed, sounding by sounding, by the simulated vehicles. patches is read once.
    counters are grouped by their owner (leader, follower_1, water ...). quantities and
    remarks are what the estimator knows of the vehicles together, in numbers and in words; remarks
    on the terrain come first.
    """

    scenario: ScenarioSettings
    site: Site
    seed: int
    profile: str
    baseline: str
    vehicles: Sequence[VehicleResult]
    closures: Sequence[ClosureResult]
    deliveries: Sequence[Delivery]
    patches: Iterable[SoundingPatch]
    truth_map: DepthMap
    counters: Mapping[str, Counters]
    remarks: Sequence[str] = ()
    quantities: Sequence[Mapping[str, object]] = ()
    settings: Mapping[str, object] = field(default_factory=dict)
