"""A finished mission's nodes as the values that the evaluation reads."""

from collections.abc import Iterator, Sequence

import numpy as np

from firmware.geometry import Array
from firmware.leader.closures import Closure
from firmware.leader.core import LeaderCore
from host_tools.mapping import DepthMap
from host_tools.mission_settings import MissionSettings
from host_tools.nodes import BeliefLog, FollowerNode, LeaderNode
from host_tools.patches import patch_of_grid
from host_tools.results import ClosureResult, MissionResult, SoundingPatch, VehicleResult
from host_tools.simulator.placement import Site, Window
from host_tools.simulator.vehicle import SimulatedVehicle
from protocol.acoustics import Delivery
from protocol.errors import EstimationError
from protocol.settings import flatten

# Covariances are asked for this often: they change slowly and cost a solve each.
COVARIANCE_STEP = 20
COVARIANCES_AT_ONCE = 16


def mission_result(
    settings: MissionSettings,
    site: Site,
    seed: int,
    baseline: str,
    vehicles: Sequence[SimulatedVehicle],
    leader: LeaderNode,
    followers: Sequence[FollowerNode],
    deliveries: Sequence[Delivery],
    truth_map: DepthMap,
) -> MissionResult:
    """Return what a mission came to, as the leader sees it at the end."""
    logs = [leader.log, *(node.log for node in followers)]
    return MissionResult(
        scenario=settings.scenario,
        site=site,
        seed=seed,
        profile=settings.follower.profile,
        baseline=baseline,
        vehicles=[
            vehicle_result(vehicle, log, leader.core)
            for vehicle, log in zip(vehicles, logs, strict=True)
        ],
        closures=[closure_result(closure) for closure in leader.core.closures],
        deliveries=deliveries,
        patches=sheet_patches(leader.core, site.window),
        truth_map=truth_map,
        counters={
            "leader": leader.core.status(),
            **{f"follower_{node.core.vehicle}": node.core.status() for node in followers},
        },
        settings={key: value for key, value, *_ in flatten(settings)},
    )


def vehicle_result(vehicle: SimulatedVehicle, log: BeliefLog, leader: LeaderCore) -> VehicleResult:
    """Return one vehicle's tracks on the mission's 1 Hz grid.

    Where the leader never heard of a vehicle, its dead reckoning is all that is known of it.
    """
    truth, columns = vehicle.true_track(), log.columns()
    reckoned_m = columns["reckoned_m"]
    final_m, covariance_m2 = reckoned_m, None
    if vehicle.index in leader.vehicles():
        final_m = leader.trajectory(vehicle.index).correct(truth.time_s, reckoned_m)
        covariance_m2 = final_covariances(vehicle.index, truth.time_s, leader)
    return VehicleResult(
        vehicle=vehicle.index,
        truth=truth,
        dead_reckoning_m=reckoned_m,
        live_m=columns["live_m"],
        final_m=final_m,
        yaw_rad=columns["yaw_rad"],
        live_covariance_m2=columns["live_covariance_m2"],
        final_covariance_m2=covariance_m2,
    )


def final_covariances(vehicle: int, time_s: Array, leader: LeaderCore) -> Array:
    """Return the covariance (T, 2, 2) of a vehicle's final estimate, NaN between samples."""
    covariances_m2 = np.full((len(time_s), 2, 2), np.nan)
    track = leader.track(vehicle)
    rows, anchors = [], []
    for row in range(0, len(time_s), COVARIANCE_STEP):
        try:
            anchors.append(leader.graph.anchor(vehicle, float(time_s[row]), track))
        except EstimationError:
            continue  # later than the leader's last news of the vehicle
        rows.append(row)
    for k in range(0, len(rows), COVARIANCES_AT_ONCE):
        joint_m2 = leader.graph.covariance(anchors[k : k + COVARIANCES_AT_ONCE])
        for i, row in enumerate(rows[k : k + COVARIANCES_AT_ONCE]):
            covariances_m2[row] = joint_m2[2 * i : 2 * i + 2, 2 * i : 2 * i + 2]
    return covariances_m2


def closure_result(closure: Closure) -> ClosureResult:
    """Return a closure of the leader as a line of the results."""
    sigmas_m = np.sqrt(np.diag(closure.covariance_m2))
    return ClosureResult(
        t_s=closure.time_s,
        from_vehicle=closure.origin.vehicle,
        from_submap=closure.origin.submap,
        from_time_s=closure.origin_anchor.time_s,
        to_vehicle=closure.target.vehicle,
        to_submap=closure.target.submap,
        to_time_s=closure.target_anchor.time_s,
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
    for sheet in leader.atlas:
        yield patch_of_grid(sheet.id.vehicle, sheet.grid, window)
