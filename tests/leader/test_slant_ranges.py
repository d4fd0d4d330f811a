"""Ranges between vehicles at two depths, through water whose sound speed changes with depth."""

from dataclasses import replace

import numpy as np
import pytest

from firmware.leader.graph_settings import GraphSettings
from firmware.leader.ledger import RangeRecord
from firmware.leader.pose_graph import PoseGraph
from firmware.leader.range_judge import RangeSettings
from firmware.leader.range_windows import RangeWindows
from firmware.sound_speed import SoundProfile
from firmware.soundings import Odometry
from firmware.submaps import Track
from protocol.acoustics import Position, Water, WaterSettings
from protocol.codec import encode
from tests.leader.vessels import leader_of, line
from tests.protocol.strategies import paper_packet

OUR_DEPTH_M, THEIR_DEPTH_M = 10.0, 130.0
THERMOCLINE = SoundProfile(points=(0.0, 1540.0, 20.0, 1540.0, 60.0, 1480.0))
LEVEL = RangeSettings()
PROFILED = RangeSettings(sound_profile=THERMOCLINE, follower_depth_m=THEIR_DEPTH_M)
FRAME = bytes(256)
END_S = 400
SENT_S = [float(k) for k in range(16, END_S - 16, 16)]
SURE = GraphSettings(odometry_noise=0.005, bias_sigma_mps=1e-4, bias_difference_mps=1e-4)


def way_mps() -> float:
    """Return the speed along the straight way, by summing a million thin layers."""
    edges_m = np.linspace(OUR_DEPTH_M, THEIR_DEPTH_M, 1_000_001)
    middles_m = (edges_m[1:] + edges_m[:-1]) / 2.0
    return float(1.0 / np.mean(1.0 / np.interp(middles_m, (20.0, 60.0), (1540.0, 1480.0))))


def still(north_m: float, east_m: float) -> Track:
    time_s = np.arange(END_S + 1.0)
    return Track(
        time_s=time_s,
        north_m=np.full_like(time_s, north_m),
        east_m=np.full_like(time_s, east_m),
        yaw_rad=np.zeros_like(time_s),
    )


def arrivals_s(apart_m: float, outlier_share: float = 0.0) -> list[float]:
    """Return when frames arrive by the simulated water, the sender far below."""

    def place(node: int, time_s: float) -> Position:  # noqa: ARG001
        return (0.0, 0.0, OUR_DEPTH_M) if node == 0 else (0.0, apart_m, THEIR_DEPTH_M)

    calm = WaterSettings(
        loss=0.0, range_noise_m=0.0, sound_speed_mps=way_mps(), outlier_share=outlier_share
    )
    water = Water(calm, np.random.default_rng(3), place)
    for sent_s in SENT_S:
        water.transmit(1, sent_s, FRAME)
    return [d.t_rx_s for d in water.deliveries_until(np.inf) if d.t_rx_s is not None]


def ranged(
    settings: RangeSettings, apart_m: float, arrived_s: list[float]
) -> tuple[RangeWindows, list[RangeRecord]]:
    """Return what becomes of arrivals between two vehicles that lie still, apart_m across."""
    graph, ranging = PoseGraph(SURE), RangeWindows(settings)
    tracks = [still(0.0, 0.0), still(0.0, apart_m)]
    for vehicle, track in enumerate(tracks):
        start_m = track.position_at(0.0)
        graph.add_chain(vehicle, 0.0, start_m, start_m)
        graph.extend(vehicle, track)
    header = replace(paper_packet().header, tx_second=0)
    for toa_s in arrived_s:
        ranging.hold(1, header, toa_s, OUR_DEPTH_M)
    ranging.use(1, tracks[1], 0, tracks[0], graph)
    records = [graph.record(number) for number in range(graph.records)]
    return ranging, [record for record in records if isinstance(record, RangeRecord)]


def held(settings: RangeSettings, way_m: float, speed_mps: float, depth_m: float) -> RangeWindows:
    """Return what became of one frame that travelled for way_m at a speed."""
    ranging = RangeWindows(settings)
    header = replace(paper_packet().header, tx_second=8)
    ranging.hold(1, header, 8.0 + way_m / speed_mps, depth_m)
    return ranging


@pytest.mark.parametrize("apart_m", [60.0, 400.0])
def test_range_through_a_thermocline_is_right_with_profile_and_depth(apart_m: float) -> None:
    _, records = ranged(PROFILED, apart_m, arrivals_s(apart_m))
    assert len(records) == len(SENT_S)
    assert [r.range_m for r in records] == pytest.approx([apart_m] * len(records), abs=1e-3)


def test_mean_speed_is_wrong_by_metres_down_a_thermocline() -> None:
    by_mean = replace(PROFILED, sound_profile=SoundProfile())
    right = held(PROFILED, 800.0, way_mps(), OUR_DEPTH_M)._held[0]
    wrong = held(by_mean, 800.0, way_mps(), OUR_DEPTH_M)._held[0]
    assert right.range_m == pytest.approx(800.0, abs=1e-3)
    assert abs(wrong.range_m - 800.0) > 2.0


def test_mean_speed_is_wrong_by_metres_in_a_fast_layer() -> None:
    """Both vehicles swim where sound makes 1540 m/s."""
    level = RangeSettings(sound_profile=THERMOCLINE)
    assert held(level, 800.0, 1540.0, 15.0)._held[0].range_m == pytest.approx(800.0, abs=1e-6)
    assert held(LEVEL, 800.0, 1540.0, 15.0)._held[0].range_m < 780.0


def test_stretched_slant_range_is_unstretched_along_the_slant() -> None:
    ranging, records = ranged(PROFILED, 150.0, arrivals_s(150.0, 0.3))
    assert ranging.counters["ranges_unstretched"] >= 3
    assert [r.range_m for r in records] == pytest.approx([150.0] * len(records), abs=1e-3)


def test_steep_range_counts_less() -> None:
    _, steep = ranged(PROFILED, 60.0, arrivals_s(60.0))
    _, shallow = ranged(PROFILED, 4000.0, arrivals_s(4000.0))
    assert shallow[0].sigma_m == pytest.approx(SURE.range_sigma_m, abs=0.01)
    assert steep[0].sigma_m == pytest.approx(np.hypot(SURE.range_sigma_m, 120.0 / 60.0), abs=0.05)


def test_range_shorter_than_depths_are_apart_is_counted_and_dropped() -> None:
    short = held(PROFILED, 119.0, way_mps(), OUR_DEPTH_M)
    assert not short._held
    assert short.counters == {"ranges_too_steep": 1}
    assert len(held(PROFILED, 121.0, way_mps(), OUR_DEPTH_M)._held) == 1


def test_defaults_give_the_graph_the_very_range_that_was_heard() -> None:
    for depth_m in (0.0, 0.1, 500.0):
        (one,) = held(LEVEL, 421.7, 1503.0, depth_m)._held
        assert one.range_m == (8.0 + 421.7 / 1503.0 - 8.0) * 1500.0
        assert one.depth_difference_m == 0.0
    arrived_s = [sent_s + 400.3 / 1500.0 for sent_s in SENT_S]
    _, records = ranged(LEVEL, 400.0, arrived_s)
    heard_m = [(toa_s - sent_s) * 1500.0 for sent_s, toa_s in zip(SENT_S, arrived_s, strict=True)]
    assert sorted(record.range_m for record in records) == sorted(heard_m)


def test_leader_ranges_from_the_depth_that_its_odometry_tells() -> None:
    leader = leader_of(line(0.0, 0.0), follower_depth_m=40.0)
    for time_s, depth_m in ((0.25, 12.0), (0.5, 15.0)):
        leader.receive_odometry(
            Odometry(
                time_s=time_s,
                velocity_north_mps=0.0,
                velocity_east_mps=0.0,
                yaw_rad=0.0,
                depth_m=depth_m,
            )
        )
    packet = paper_packet()
    header = replace(packet.header, vehicle=1, tx_second=8)
    leader.receive_frame(encode(replace(packet, header=header)), 8.4, 10.5)
    assert [one.depth_difference_m for one in leader._ranging._held] == [25.0]
