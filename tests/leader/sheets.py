"""Small sheets of a vehicle that sails north, and its graph."""

import dataclasses

import numpy as np

from firmware.leader.atlas import Sheet, SheetId, sheet_of
from firmware.leader.displacement import Look
from firmware.leader.graph_settings import GraphSettings
from firmware.leader.match_job import MatchJob
from firmware.leader.matches import ANY_PAIR, MatchingSettings
from firmware.leader.pose_graph import PoseGraph
from firmware.submaps import GriddedSubmap, Track

LOOK = Look(
    vehicle=0,
    starboard=np.array([0.0, 1.0]),
    altitude_m=40.0,
    half_width_m=70.0,
    errors=np.zeros(2),
    covariance=np.zeros((2, 2)),
)


def sheet_at(submap: int, time_s: float = 0.0) -> Sheet:
    """Return a flat sheet of three seconds."""
    shape = (4, 4)
    grid = GriddedSubmap(
        north0_m=0.0,
        east0_m=0.0,
        cell_m=2.0,
        depth_m=np.ones(shape),
        variance_m2=np.full(shape, 0.01),
        time_s=np.full(shape, time_s),
    )
    times_s = time_s + np.arange(3.0)
    track = Track(time_s=times_s, north_m=times_s, east_m=np.zeros(3), yaw_rad=np.zeros(3))
    sheet = sheet_of(SheetId(vehicle=0, boot_epoch=0, submap=submap), track, grid)
    assert sheet is not None
    return sheet


def two_sheets() -> tuple[Sheet, Sheet]:
    """Return two sheets, 80 s apart, whose middles lie between the nodes of the graph."""
    first, second = (
        dataclasses.replace(sheet_at(k, time_s), track=_long_track())
        for k, time_s in ((1, 22.0), (2, 102.0))
    )
    return first, second


def northward() -> PoseGraph:
    """Return the graph of one vehicle that sails north for 200 s."""
    graph = PoseGraph(GraphSettings())
    graph.add_chain(0, 0.0, np.zeros(2), np.zeros(2))
    graph.extend(0, _long_track())
    graph.update()
    return graph


def _long_track() -> Track:
    times_s = np.arange(201.0)
    return Track(time_s=times_s, north_m=times_s, east_m=0 * times_s, yaw_rad=0 * times_s)


def job_of(origin: Sheet, target: Sheet, radius_m: float = 20.0) -> MatchJob:
    """Return the match of two sheets whose offset is known to a radius."""
    return MatchJob(
        origin=origin,
        target=target,
        origin_grid=origin.grid,
        target_grid=target.grid,
        origin_drift_mps=np.zeros(2),
        target_drift_mps=np.zeros(2),
        prior_shift_m=np.zeros(2),
        prior_covariance_m2=np.diag([radius_m, radius_m]) ** 2,
        settings=MatchingSettings(),
        sigmas=ANY_PAIR,
        looks=(LOOK, LOOK),
    )
