"""What a mission leaves in its folder: the files of the contract."""

import csv
import dataclasses
import json
import re
import resource
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import rasterio

from host_tools.evaluation import (
    evaluate,
)
from host_tools.mapping import DepthMap
from host_tools.registration import TileShifts
from host_tools.report import write_report
from host_tools.report.figures import closures, link, maps
from host_tools.results import MissionResult, SoundingPatch, VehicleResult
from host_tools.scenario import ScenarioSettings, named_scenario
from host_tools.simulate import outcome_lines
from host_tools.simulator.placement import Site, place_survey
from host_tools.simulator.terrain import open_terrain
from host_tools.simulator.vehicle import SimulatedVehicle
from host_tools.writers import (
    body_quaternions,
    forget_mission,
    link_counts,
    prepare_folder,
    write_map,
    write_outputs,
)
from protocol.acoustics import Delivery
from protocol.errors import ConfigError
from protocol.settings import replace
from tests.host_tools.closures import closure


def test_quaternion_of_a_level_body_is_its_heading_in_enu() -> None:
    north, east, starboard_down = body_quaternions(
        np.array([[0.0, 0.0, 0.0], [np.pi / 2, 0.0, 0.0], [np.pi / 2, 0.0, 0.3]])
    )
    half = np.sqrt(0.5)
    np.testing.assert_allclose(np.abs(north), [0, 0, half, half], atol=1e-12)
    np.testing.assert_allclose(np.abs(east), [0, 0, 0, 1], atol=1e-12)
    # heading east, starboard side down: a positive turn about forward, which is east
    assert starboard_down[0] * starboard_down[3] == pytest.approx(np.sin(0.15) * np.cos(0.15))


def sailed(
    scenario: ScenarioSettings, site: Site, index: int, truth_map: DepthMap
) -> tuple[VehicleResult, SoundingPatch]:
    """Return what a vehicle's two minutes leave when its map is as dead reckoning began."""
    soundings: list[np.ndarray] = []

    def keep(points_m: np.ndarray) -> None:
        truth_map.add(points_m)
        soundings.append(points_m)

    simulated = SimulatedVehicle(scenario, site.seabed, index, 1, keep)
    reckoned, yaw = np.zeros((121, 2)), np.zeros(121)
    at = np.array(simulated.true_position(0.0)[:2])
    for odometry, _ in simulated.steps():
        at += np.array([odometry.velocity_north_mps, odometry.velocity_east_mps]) / 4
        if odometry.time_s % 1 == 0:
            reckoned[int(odometry.time_s)], yaw[int(odometry.time_s)] = at, odometry.yaw_rad
    truth = simulated.true_track()
    truth_m = truth.position_m
    points_m = np.concatenate(soundings)
    off_m = (reckoned - truth_m)[0]
    still = np.zeros(len(points_m))
    vehicle = VehicleResult(
        vehicle=index,
        truth=truth,
        dead_reckoning_m=reckoned,
        live_m=0.5 * (reckoned + truth_m),
        final_m=truth_m,
        yaw_rad=yaw,
    )
    patch = SoundingPatch(
        vehicle=index,
        north_m=points_m[:, 0] + off_m[0],
        east_m=points_m[:, 1] + off_m[1],
        depth_m=points_m[:, 2],
        variance_m2=still + 0.02,
        time_s=still,
    )
    return vehicle, patch


def delivery(sent_s: float, *, lost: bool = False) -> Delivery:
    return Delivery(
        source=1,
        destination=0,
        t_tx_s=sent_s,
        t_rx_s=None if lost else sent_s + 0.1,
        t_delivered_s=sent_s + 2.2,
        frame=bytes(256),
        fate="lost" if lost else "delivered",
    )


@pytest.fixture(scope="module")
def mission() -> MissionResult:
    scenario = replace(named_scenario("paper-1"), {"duration_min": 2, "follower_duration_min": 1})
    site = place_survey(open_terrain(None), scenario, 1)
    truth_map = DepthMap(site.window)
    vehicles, patches = zip(
        *(sailed(scenario, site, index, truth_map) for index in range(2)), strict=True
    )
    return MissionResult(
        scenario=scenario,
        site=site,
        seed=1,
        profile="paper",
        baseline="none",
        vehicles=list(vehicles),
        closures=[closure(), closure(stage="consistent", axis_deg=12.5)],
        deliveries=[delivery(4.0 * k, lost=k == 3) for k in range(10)],
        patches=list(patches),
        truth_map=truth_map,
        counters={"leader": {"pings": 481}},
        remarks=["rotation about the range is unobservable"],
    )


def test_outputs_are_those_of_the_contract(mission: MissionResult, tmp_path: Path) -> None:
    write_outputs(mission, evaluate(mission), tmp_path)
    names = {path.name for path in tmp_path.iterdir()}
    tracks = {
        f"{vehicle}_{kind}.tum"
        for vehicle in ("leader", "follower_1")
        for kind in ("truth", "dead_reckoning", "live", "final")
    }
    fixed = {"summary.json", "closures.csv", "air.jsonl", "map.tif", "map_truth.tif"}
    assert names == tracks | fixed
    rows = list(csv.DictReader((tmp_path / "closures.csv").read_text().splitlines()))
    assert rows[0]["true_north_m"] == "102.889"
    assert (rows[0]["axis_deg"], rows[1]["axis_deg"], rows[1]["active_at_end"]) == (
        "",
        "12.50",
        "1",
    )
    air = [json.loads(line) for line in (tmp_path / "air.jsonl").read_text().splitlines()]
    assert len(air) == 10
    assert air[3]["t_rx_s"] is None
    assert len(air[0]["hex"]) == 512
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["link"]["packets_sent"] == 10
    assert summary["link"]["packets_lost"] == 1
    assert summary["link"]["bytes_on_air"] == 2560
    assert summary["vehicles"]["follower_1"]["live"]["share_of_dead_reckoning"] == pytest.approx(
        0.5
    )
    assert summary["terrain"]["stored_as"] == "elevations"
    assert summary["datum"]["shift_m"] == mission.site.datum.depth_shift_m


def test_true_columns_of_closures_follow_from_the_tum_files(
    mission: MissionResult, tmp_path: Path
) -> None:
    write_outputs(mission, evaluate(mission), tmp_path)
    names = {"0": "leader", "1": "follower_1"}
    tracks = {key: np.loadtxt(tmp_path / f"{name}_truth.tum") for key, name in names.items()}

    def at(vehicle: str, time_s: str) -> np.ndarray:
        rows = tracks[vehicle]
        return np.array([np.interp(float(time_s), rows[:, 0], rows[:, axis]) for axis in (2, 1)])

    for row in csv.DictReader((tmp_path / "closures.csv").read_text().splitlines()):
        true_m = at(row["to_vehicle"], row["to_time_s"])
        true_m -= at(row["from_vehicle"], row["from_time_s"])
        stated_m = [float(row["true_north_m"]), float(row["true_east_m"])]
        np.testing.assert_allclose(true_m, stated_m, atol=0.002)


def test_tum_lines_lie_on_one_grid_in_projected_enu(mission: MissionResult, tmp_path: Path) -> None:
    write_outputs(mission, evaluate(mission), tmp_path)
    rows = np.loadtxt(tmp_path / "follower_1_truth.tum")
    np.testing.assert_array_equal(rows[:, 0], np.arange(121.0))
    datum = mission.site.datum
    np.testing.assert_allclose(
        rows[0, 1:4], [datum.origin_east_m + 50, datum.origin_north_m + 50, -10.0], atol=1e-3
    )
    np.testing.assert_allclose(np.linalg.norm(rows[:, 4:], axis=1), 1.0, atol=1e-6)


def test_map_of_true_soundings_lies_on_the_terrain(mission: MissionResult, tmp_path: Path) -> None:
    evaluation = evaluate(mission)
    write_outputs(mission, evaluation, tmp_path)
    terrain = mission.site.raster
    with rasterio.open(tmp_path / "map_truth.tif") as dataset:
        assert dataset.shape == (terrain.rows, terrain.columns)
        assert dataset.transform == terrain.transform
        assert dataset.count == 2
        elevation_m, sigma_m = dataset.read(1, masked=True), dataset.read(2, masked=True)
    difference_m = elevation_m - terrain.read(0, 0, terrain.rows, terrain.columns)
    assert difference_m.count() > 1000
    assert abs(float(np.median(difference_m.compressed()))) < 0.02
    assert float(difference_m.std()) < 0.25
    assert sigma_m.count() == elevation_m.count()
    assert evaluation.registration.mean_m < 1e-2


def test_map_takes_memory_by_the_survey_not_by_the_terrain(
    mission: MissionResult, tmp_path: Path
) -> None:
    wide = dataclasses.replace(mission.site.raster, rows=8000, columns=8000)
    site = dataclasses.replace(mission.site, raster=wide)
    window = site.window
    depth_m = np.full((window.rows, window.columns), 30.0)
    tracemalloc.start()
    write_map(tmp_path / "map.tif", site, depth_m, depth_m)
    assert tracemalloc.get_traced_memory()[1] < 50e6  # bytes; a whole band would have 256e6
    tracemalloc.stop()
    with rasterio.open(tmp_path / "map.tif") as dataset:
        assert dataset.shape == (8000, 8000)
        assert dataset.read(1, masked=True).count() == depth_m.size


def test_a_full_disk_is_an_error_and_leaves_no_summary(
    mission: MissionResult, tmp_path: Path
) -> None:
    evaluation = evaluate(mission)
    write_outputs(mission, evaluation, tmp_path)
    sizes = {path.name: path.stat().st_size for path in tmp_path.iterdir()}
    assert max(sizes, key=lambda name: sizes[name]) == "map.tif"
    (tmp_path / "summary.json").unlink()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (sizes["map.tif"] - 1, limits[1]))
    try:
        with pytest.raises(ConfigError, match=r"cannot write all files to .*: File too large"):
            write_outputs(mission, evaluation, tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not (tmp_path / "summary.json").exists()


def test_report_is_one_file_that_needs_no_other(mission: MissionResult, tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    write_report(mission, evaluate(mission), path)
    page = path.read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == 5
    assert "rotation about the range is unobservable" in page
    assert "http" not in page.replace("http-equiv", "")
    assert not re.search(r"<(script|link)\b", page)


def test_report_tells_live_errors_of_the_survey_where_it_ends_before_the_mission(
    mission: MissionResult, tmp_path: Path
) -> None:
    evaluation = evaluate(mission)
    errors = evaluation.vehicles["follower_1"]
    surveyed = dataclasses.replace(errors.live, mean_m=77.77)
    evaluation = dataclasses.replace(
        evaluation,
        vehicles={
            "leader": dataclasses.replace(errors, live_during_survey=errors.live),
            "follower_1": dataclasses.replace(errors, live_during_survey=surveyed),
        },
    )
    write_report(mission, evaluation, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert 'follower 1, live during its survey</td><td class="n">77.77 m' in page
    assert "leader, live during" not in page


def test_closures_have_a_key_of_their_colours(mission: MissionResult) -> None:
    figure = closures(mission, evaluate(mission))
    (key,) = figure.legends
    assert [text.get_text() for text in key.get_texts()] == [
        "within 5 m of the truth",
        "farther off",
    ]
    assert figure.axes[1].get_xlim() == (-0.5, 3.5)


def test_flat_ground_has_the_colours_of_the_bar(mission: MissionResult) -> None:
    evaluation = evaluate(mission)
    slope_m = np.full_like(evaluation.map_depth_m, 30.0)
    slope_m[: len(slope_m) // 2] += 0.5 * np.arange(slope_m.shape[1])
    figure = maps(mission, dataclasses.replace(evaluation, map_depth_m=slope_m))
    shadow = np.asarray(figure.axes[0].images[1].get_alpha())
    assert np.all(shadow[len(slope_m) // 2 + 1 :] == 0.0)
    assert np.all(shadow[: len(slope_m) // 2 - 1] > 0.0)


def test_panels_of_a_fleet_are_no_wider_than_the_page() -> None:
    deliveries = [dataclasses.replace(delivery(0.0), destination=to) for to in range(5)]
    figure = link(deliveries, 600.0)
    assert figure.get_size_inches().tolist() == pytest.approx([12.0, 10.8])
    assert [axes.get_title() for axes in figure.axes][:2] == [
        "frames at the leader",
        "frames at follower 1",
    ]


@pytest.mark.parametrize(
    ("far_tiles", "said"),
    [(0, "no tile has relief enough to tell"), (3, "all tiles that tell their shift are off by")],
)
def test_a_shift_that_no_tile_tells_is_no_number(
    mission: MissionResult, tmp_path: Path, far_tiles: int, said: str
) -> None:
    nan = float("nan")
    untold = TileShifts(tiles=0, flat_tiles=25, far_tiles=far_tiles, median_m=nan, p95_m=nan)
    evaluation = dataclasses.replace(evaluate(mission), tiles=untold)
    assert said in outcome_lines(evaluation)[-1]
    assert "nan" not in outcome_lines(evaluation)[-1]
    write_report(mission, evaluation, tmp_path / "report.html")
    assert "nan m" not in (tmp_path / "report.html").read_text()


def test_an_earlier_mission_is_removed_by_name_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "processes").mkdir()
    left = ("report.html", "follower_2_live.tum", "processes/leader.log", "processes/leader.json")
    others = ("notes.txt", "follower_2.sqlite", "live.tum", "processes/notes.txt")
    for name in (*left, *others):
        (tmp_path / name).write_text("")
    forget_mission(tmp_path, terrain=tmp_path / "notes.txt")
    assert not any((tmp_path / name).exists() for name in left)
    assert all((tmp_path / name).exists() for name in others)
    (tmp_path / "report.html").mkdir()
    with pytest.raises(ConfigError, match="cannot write to --out"):
        forget_mission(tmp_path, None)


def test_a_terrain_that_the_mission_would_overwrite_is_refused_and_all_stays(
    tmp_path: Path,
) -> None:
    (tmp_path / "processes").mkdir()
    for name in ("report.html", "map.tif"):
        (tmp_path / name).write_text("")
    with pytest.raises(ConfigError, match=r"by this mission's map.tif; give another --out"):
        forget_mission(tmp_path, terrain=tmp_path / "processes" / ".." / "map.tif")
    assert (tmp_path / "report.html").exists()
    assert (tmp_path / "map.tif").exists()


def test_frames_are_counted_once_and_losses_at_each_receiver() -> None:
    packet = [bytes([k]) * 256 for k in (1, 2)]  # two frames that are sent together
    heard = [
        Delivery(
            source=1,
            destination=destination,
            t_tx_s=8.0,
            t_rx_s=8.2,
            t_delivered_s=11.0,
            frame=bytes(256) if fate == "corrupt" else frame,
            fate=fate,
            sent=frame,
        )
        for frame in packet
        for destination, fate in ((0, "delivered"), (2, "corrupt"), (2, "duplicate"), (3, "lost"))
    ]
    answer = dataclasses.replace(delivery(20.0), source=0, frame=bytes(22))
    counts = link_counts([*heard, answer])
    assert (counts["packets_sent"], counts["bytes_on_air"]) == (3, 2 * 256 + 22)
    assert (counts["packets_lost"], counts["receptions_expected"]) == (4, 7)
    assert counts["sources"] == {
        "1": {"packets_sent": 2, "bytes_on_air": 512},
        "0": {"packets_sent": 1, "bytes_on_air": 22},
    }


@pytest.mark.parametrize("mapped", [np.s_[:1], np.s_[:, :1], np.s_[:1, :1]])
def test_a_map_of_one_row_or_column_is_drawn(
    mission: MissionResult, mapped: tuple[slice, ...]
) -> None:
    evaluation = evaluate(mission)
    depth_m = np.full_like(evaluation.map_depth_m, np.nan)
    depth_m[mapped] = 30.0
    figure = maps(mission, dataclasses.replace(evaluation, map_depth_m=depth_m))
    assert figure.axes[0].get_title() == "map of the final estimate, final tracks"


def test_unwritable_output_is_a_clear_error(tmp_path: Path) -> None:
    blocker = tmp_path / "file"
    blocker.write_text("")
    with pytest.raises(ConfigError, match="cannot write to --out"):
        prepare_folder(blocker / "out")
