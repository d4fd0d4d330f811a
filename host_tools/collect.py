"""A finished mission's nodes as the values that the evaluation reads."""

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from firmware.geometry import Array
from firmware.journaled import bare
from firmware.leader.closure_log import Verdict
from firmware.leader.core import LeaderCore
from firmware.leader.observability import Quantity
from firmware.leader.trajectory import Trajectory
from host_tools.mapping import DepthMap
from host_tools.mission_settings import MissionSettings
from host_tools.nodes import FollowerNode, LeaderNode
from host_tools.patches import patch_of_grid
from host_tools.results import (
    ClosureResult,
    Counters,
    MissionResult,
    SoundingPatch,
    VehicleResult,
)
from host_tools.simulator.placement import Site, Window
from host_tools.simulator.vehicle import SimulatedVehicle
from protocol.acoustics import Delivery
from protocol.errors import EstimationError
from protocol.settings import flatten
from protocol.vehicles import name_of

# Covariances are asked for this often: they change slowly and cost a solve each.
COVARIANCE_STEP = 20
COVARIANCES_AT_ONCE = 16


@dataclass(frozen=True, slots=True, kw_only=True)
class Mission:
    """What a mission was, wherever its nodes ran: its settings, its vehicles, and the truth."""

    settings: MissionSettings
    site: Site
    seed: int
    vehicles: Sequence[SimulatedVehicle]
    deliveries: Sequence[Delivery]
    truth_map: DepthMap
    baseline: str = "none"


@dataclass(frozen=True, slots=True, kw_only=True)
class LeaderRecord:
    """What the leader holds at the end: trajectories by vehicle, closures, and its sheets.

    covariances_m2 are (T, 2, 2) on the mission's 1 Hz grid. patches is read once. quantities are
    what is known of the vehicles together, remarks the same in words.
    """

    trajectories: Mapping[int, Trajectory]
    covariances_m2: Mapping[int, Array]
    closures: Sequence[ClosureResult]
    patches: Iterable[SoundingPatch]
    quantities: Sequence[Mapping[str, object]] = ()
    remarks: Sequence[str] = ()


def leader_record(leader: LeaderCore, time_s: Array, window: Window) -> LeaderRecord:
    """Return what a leader holds."""
    vehicles = leader.vehicles()
    seen, proposal = leader.outlook.observe(leader.reckoned.time_s), leader.outlook.propose()
    return LeaderRecord(
        trajectories={vehicle: leader.trajectory(vehicle) for vehicle in vehicles},
        covariances_m2={v: final_covariances(v, time_s, leader) for v in vehicles},
        closures=[closure_result(verdict) for verdict in leader.verdicts()],
        patches=sheet_patches(leader, window),
        quantities=[] if seen is None else [as_row(q) for q in seen.quantities],
        remarks=[
            *([] if seen is None else seen.lines()),
            *map(str, [proposal] if proposal else []),
            *seabed_remarks(leader.status()),
        ],
    )


def as_row(quantity: Quantity) -> dict[str, object]:
    """Return a quantity as plain data."""
    return {**dataclasses.asdict(quantity), "is_undetermined": quantity.is_undetermined}


def seabed_remarks(counters: Counters) -> list[str]:
    """Return how often the seabed had nothing to hold on to, where it was often."""
    flat = counters.get("match_featureless", 0.0)
    vague = counters.get("match_ambiguous", 0.0) + counters.get("match_loose", 0.0)
    found = sum(n for name, n in counters.items() if name.startswith("closures_believed"))
    if flat + vague <= found:
        return []
    return [
        f"{flat + vague:.0f} overlaps gave no closure for want of relief ({flat:.0f} on flat "
        f"seabed, {vague:.0f} ambiguous), {found:.0f} did: more lines here tell little of position"
    ]


def mission_result(
    mission: Mission, leader: LeaderNode, followers: Sequence[FollowerNode]
) -> MissionResult:
    """Return what a mission in this process came to, as the leader sees it at the end."""
    time_s = mission.vehicles[0].true_track().time_s
    return result_of_record(
        mission,
        [leader.log.columns(), *(node.log.columns() for node in followers)],
        leader_record(bare(leader.core), time_s, mission.site.window),
        {
            "leader": leader.core.status(),
            **{name_of(node.core.vehicle): node.core.status() for node in followers},
        },
    )


def result_of_record(
    mission: Mission,
    beliefs: Sequence[Mapping[str, Array]],
    record: LeaderRecord,
    counters: Mapping[str, Counters],
) -> MissionResult:
    """Return what a mission came to, from each vehicle's beliefs and the leader's record."""
    settings = mission.settings
    return MissionResult(
        scenario=settings.scenario,
        site=mission.site,
        seed=mission.seed,
        profile=settings.follower.profile,
        baseline=mission.baseline,
        vehicles=[
            vehicle_result(vehicle, columns, record)
            for vehicle, columns in zip(mission.vehicles, beliefs, strict=True)
        ],
        closures=record.closures,
        deliveries=mission.deliveries,
        patches=record.patches,
        truth_map=mission.truth_map,
        counters=counters,
        quantities=record.quantities,
        remarks=[*mission.site.remarks, *record.remarks],
        settings={key: value for key, value, *_ in flatten(settings)},
    )


def vehicle_result(
    vehicle: SimulatedVehicle, columns: Mapping[str, Array], record: LeaderRecord
) -> VehicleResult:
    """Return one vehicle's tracks on the mission's 1 Hz grid.

    Where the leader never heard of a vehicle, its dead reckoning is all that is known of it.
    """
    truth, reckoned_m = vehicle.true_track(), columns["reckoned_m"]
    final_m = reckoned_m
    if vehicle.index in record.trajectories:
        final_m = record.trajectories[vehicle.index].correct(truth.time_s, reckoned_m)
    return VehicleResult(
        vehicle=vehicle.index,
        truth=truth,
        dead_reckoning_m=reckoned_m,
        live_m=columns["live_m"],
        final_m=final_m,
        yaw_rad=columns["yaw_rad"],
        live_covariance_m2=columns["live_covariance_m2"],
        final_covariance_m2=record.covariances_m2.get(vehicle.index),
    )


def final_covariances(vehicle: int, time_s: Array, leader: LeaderCore) -> Array:
    """Return the covariance (T, 2, 2) of a vehicle's final estimate, NaN between samples."""
    covariances_m2 = np.full((len(time_s), 2, 2), np.nan)
    rows, anchors = [], []
    for row in range(0, len(time_s), COVARIANCE_STEP):
        try:
            anchors.append(leader.anchor(vehicle, float(time_s[row])))
        except EstimationError:
            continue  # later than the leader's last news of the vehicle
        rows.append(row)
    for k in range(0, len(rows), COVARIANCES_AT_ONCE):
        joint_m2 = leader.graph.covariance(anchors[k : k + COVARIANCES_AT_ONCE])
        for i, row in enumerate(rows[k : k + COVARIANCES_AT_ONCE]):
            covariances_m2[row] = joint_m2[2 * i : 2 * i + 2, 2 * i : 2 * i + 2]
    return covariances_m2


def closure_result(closure: Verdict) -> ClosureResult:
    """Return a closure of the leader as a line of the results."""
    sigmas_m = np.sqrt(np.diag(closure.covariance_m2))
    return ClosureResult(
        t_s=closure.time_s,
        from_vehicle=closure.origin.vehicle,
        from_submap=closure.origin.submap,
        from_time_s=closure.origin_time_s,
        to_vehicle=closure.target.vehicle,
        to_submap=closure.target.submap,
        to_time_s=closure.target_time_s,
        measured_north_m=float(closure.offset_m[0]),
        measured_east_m=float(closure.offset_m[1]),
        sigma_north_m=float(sigmas_m[0]),
        sigma_east_m=float(sigmas_m[1]),
        residual=closure.residual,
        stage=closure.stage.value,
        active_at_end=closure.active,
        axis_deg=closure.axis_deg,
    )


def sheet_patches(leader: LeaderCore, window: Window) -> Iterator[SoundingPatch]:
    """Yield every sub-map that the leader holds as a patch of the map."""
    for vehicle, grid in leader.atlas.grids():
        yield patch_of_grid(vehicle, grid, window)
