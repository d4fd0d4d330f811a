"""A follower's clock that is behind: found from ranges, where it is asked for."""

from dataclasses import replace

import numpy as np
import pytest

from firmware.geometry import Array
from firmware.leader.composition import CompositionSettings
from firmware.leader.graph_settings import GraphSettings
from firmware.leader.ledger import RangeRecord
from firmware.leader.pose_graph import PoseGraph
from firmware.leader.range_judge import RangeSettings
from firmware.leader.range_windows import RangeWindows
from firmware.submaps import Track
from tests.protocol.strategies import paper_packet

END_S = 1800.0
ASKED = GraphSettings(bias_sigma_mps=0.02, clock_offset_sigma_ms=20.0, clock_drift_sigma_ppm=5.0)
LATE_MS, LATE_PPM = 12.0, 2.0


def track(vehicle: int) -> Track:
    """Return a circle of 150 m, the second vehicle's beside the first's and the other way round."""
    time_s = np.arange(0.0, END_S + 1.0)
    angle = (1 - 2 * vehicle) * time_s / 75.0
    north_m, east_m = 150.0 * np.cos(angle), 150.0 * np.sin(angle) + 400.0 * vehicle
    return Track(time_s=time_s, north_m=north_m, east_m=east_m, yaw_rad=angle)


def late_m(time_s: float) -> float:
    return 1500.0 * (1e-3 * LATE_MS + 1e-6 * LATE_PPM * time_s)


def ranged(settings: GraphSettings) -> PoseGraph:
    """Return the graph of both vehicles after ranges every 16 s, as their frames bring them."""
    graph, tracks = PoseGraph(settings), [track(0), track(1)]
    for vehicle in (0, 1):
        start_m = tracks[vehicle].position_at(0.0)
        graph.add_chain(vehicle, 0.0, start_m, start_m)
        graph.extend(vehicle, tracks[vehicle])
    ranging, header = RangeWindows(RangeSettings()), replace(paper_packet().header, tx_second=0)
    for sent_s in range(16, int(END_S) - 16, 16):
        ranging.hold(1, header, _arrival_s(sent_s, tracks), 10.0)
        ranging.use(1, tracks[1], 0, tracks[0], graph)
    graph.update()
    return graph


def _arrival_s(sent_s: float, tracks: list[Track]) -> float:
    way_m: Array = tracks[1].position_at(sent_s) - tracks[0].position_at(sent_s)
    return float(sent_s + (np.hypot(*way_m) + late_m(sent_s)) / 1500.0)


def test_clock_that_is_behind_is_found() -> None:
    graph = ranged(ASKED)
    for time_s in (100.0, 900.0, 1700.0):
        assert graph.clock(1, time_s)[0] == pytest.approx(late_m(time_s), abs=5.0)
    assert graph.clock(1, 100.0)[1] < 3.0  # of 30 m before
    assert graph.clock(0, 900.0) == (0.0, 0.0)
    miss_m = graph.trajectory(1).position_m[-1] - track(1).position_at(END_S)
    assert np.hypot(*miss_m) < 5.0


def test_clock_survives_composition() -> None:
    graph = ranged(ASKED)
    before = graph.clock(1, 900.0)
    graph.compose(END_S, CompositionSettings())
    assert graph.clock(1, 900.0) == pytest.approx(before, abs=1.0)


def test_no_clock_is_estimated_unless_asked_for() -> None:
    graph = ranged(GraphSettings(bias_sigma_mps=0.02))
    assert graph.clock(1, 900.0) == (0.0, 0.0)
    records = [graph.record(number) for number in range(graph.records)]
    clocks = {record.clock for record in records if isinstance(record, RangeRecord)}
    assert clocks == {None}
