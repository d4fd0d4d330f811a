"""The files of a simulated mission, as the contract names them."""

import csv
import importlib.metadata
import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rasterio.io import MemoryFile
from rasterio.windows import Window as RasterWindow
from scipy.spatial.transform import Rotation

from firmware.geometry import Array
from host_tools.evaluation import Evaluation, JudgedClosure, as_plain, closure_counts
from host_tools.processes.records import VehicleFiles
from host_tools.results import MissionResult, VehicleResult
from host_tools.simulator.placement import Site
from host_tools.simulator.seabed import Datum
from protocol.acoustics import Delivery
from protocol.errors import ConfigError
from protocol.vehicles import VEHICLES, name_of

NODATA = -9999.0
FILES = ("report.html", "summary.json", "closures.csv", "air.jsonl", "map.tif", "map_truth.tif")
TRACKS = ("truth", "dead_reckoning", "live", "final")
CLOSURE_COLUMNS = (
    "t_s,from_vehicle,from_submap,to_vehicle,to_submap,measured_north_m,measured_east_m,"
    "true_north_m,true_east_m,residual,stage,active_at_end,sigma_north_m,sigma_east_m,axis_deg,"
    "from_time_s,to_time_s"
).split(",")
# From the body (forward, starboard, down) to (forward, left, up), and from NED to ENU.
FLIP = np.diag([1.0, -1.0, -1.0])
ENU_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def prepare_folder(folder: Path) -> Path:
    """Return the folder, made if need be and proved writable.

    Raises
    ------
    ConfigError
        When files cannot be written there.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".writable"
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as error:
        raise ConfigError(f"cannot write to --out {folder}: {error.strerror}") from error
    return folder


def forget_mission(folder: Path, terrain: Path | None) -> None:
    """Remove what an earlier mission left, by the names of the contract.

    Raises
    ------
    ConfigError
        When it cannot be removed, or the terrain has one of these names; then all stays.
    """
    tracks = [f"{name_of(vehicle)}_{track}.tum" for vehicle in range(VEHICLES) for track in TRACKS]
    names = (*FILES, *tracks)
    for name in names:
        if terrain is not None and terrain.resolve() == (folder / name).resolve():
            raise ConfigError(
                f"--terrain {terrain} would be overwritten by this mission's {name}; "
                "give another --out"
            )
    try:
        for name in names:
            (folder / name).unlink(missing_ok=True)
        for vehicle in range(VEHICLES):
            VehicleFiles(folder, vehicle).forget()
    except OSError as error:
        raise ConfigError(f"cannot write to --out {folder}: {error}") from error


def write_outputs(result: MissionResult, evaluation: Evaluation, folder: Path) -> None:
    """Write every file of the contract but report.html; summary.json once the others are whole.

    Raises
    ------
    ConfigError
        When they cannot be written, as to a full disk.
    """
    prepare_folder(folder)
    try:
        _write_all(result, evaluation, folder)
    except OSError as error:
        raise ConfigError(f"cannot write all files to --out {folder}: {error.strerror}") from error


def _write_all(result: MissionResult, evaluation: Evaluation, folder: Path) -> None:
    for vehicle in result.vehicles:
        write_trajectories(vehicle, result.site.datum, folder)
    write_closures(evaluation.closures, folder / "closures.csv")
    write_air(result.deliveries, folder / "air.jsonl")
    site = result.site
    write_map(folder / "map.tif", site, evaluation.map_depth_m, evaluation.map_sigma_m)
    write_map(folder / "map_truth.tif", site, evaluation.truth_depth_m, evaluation.truth_sigma_m)
    summary = json.dumps(summarise(result, evaluation), indent=2)
    (folder / "summary.json").write_text(summary + "\n", encoding="utf-8")


def write_trajectories(vehicle: VehicleResult, datum: Datum, folder: Path) -> None:
    """Write the truth, dead-reckoning, live and final TUM files of one vehicle."""
    truth = vehicle.truth
    true_attitude = np.stack([truth.yaw_rad, truth.pitch_rad, truth.roll_rad], axis=1)
    measured = np.zeros_like(true_attitude)
    measured[:, 0] = vehicle.yaw_rad
    tracks = (
        (truth.position_m, true_attitude),
        (vehicle.dead_reckoning_m, measured),
        (vehicle.live_m, measured),
        (vehicle.final_m, measured),
    )
    for kind, (position_m, attitude_rad) in zip(TRACKS, tracks, strict=True):
        rows = np.column_stack(
            [
                truth.time_s,
                position_m[:, 1] + datum.origin_east_m,
                position_m[:, 0] + datum.origin_north_m,
                -truth.depth_m,
                body_quaternions(attitude_rad),
            ]
        )
        formats = ["%.3f"] * 4 + ["%.9f"] * 4
        np.savetxt(folder / f"{vehicle.name}_{kind}.tum", rows, fmt=formats)


def body_quaternions(yaw_pitch_roll_rad: Array) -> Array:
    """Return quaternions (T, 4) x, y, z, w of the body (forward, left, up) in ENU."""
    rotations = Rotation.from_euler("ZYX", yaw_pitch_roll_rad).as_matrix()
    quaternions: Array = Rotation.from_matrix(ENU_NED @ rotations @ FLIP).as_quat()
    return quaternions


def write_closures(closures: Sequence[JudgedClosure], path: Path) -> None:
    """Write closures.csv; from_time_s and to_time_s say which states of the tracks each links."""
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(CLOSURE_COLUMNS)
        for judged in closures:
            closure = judged.closure
            numbers = (
                closure.measured_north_m,
                closure.measured_east_m,
                judged.true_north_m,
                judged.true_east_m,
            )
            writer.writerow(
                [
                    f"{closure.t_s:.3f}",
                    closure.from_vehicle,
                    closure.from_submap,
                    closure.to_vehicle,
                    closure.to_submap,
                    *(f"{number:.3f}" for number in numbers),
                    f"{closure.residual:.6g}",
                    closure.stage,
                    int(closure.active_at_end),
                    f"{closure.sigma_north_m:.3f}",
                    f"{closure.sigma_east_m:.3f}",
                    "" if closure.axis_deg is None else f"{closure.axis_deg:.2f}",
                    f"{closure.from_time_s:.3f}",
                    f"{closure.to_time_s:.3f}",
                ]
            )


def air_line(delivery: Delivery) -> str:
    """Return the line of air.jsonl for one frame at one receiver."""
    return json.dumps(
        {
            "t_tx_s": delivery.t_tx_s,
            "t_rx_s": delivery.t_rx_s,
            "source": delivery.source,
            "destination": delivery.destination,
            "hex": delivery.frame.hex(),
            "fate": delivery.fate,
        }
    )


def write_air(deliveries: Sequence[Delivery], path: Path) -> None:
    """Write air.jsonl, one line per frame and receiver."""
    with path.open("w", encoding="utf-8") as stream:
        stream.writelines(air_line(delivery) + "\n" for delivery in deliveries)


def write_map(path: Path, site: Site, depth_m: Array, sigma_m: Array) -> None:
    """Write a map on the terrain's whole grid and in its datum: elevation and its deviation.

    GDAL writes to memory, and Python to the disk: GDAL does not tell of a disk that is full.
    """
    raster, window = site.raster, site.window
    elevation_m = site.datum.depth_shift_m - depth_m
    profile = {
        "driver": "GTiff",
        "height": raster.rows,
        "width": raster.columns,
        "count": 2,
        "dtype": "float32",
        "crs": raster.crs_wkt,
        "transform": raster.transform,
        "nodata": NODATA,
        "compress": "deflate",
        "tiled": True,
    }
    at = RasterWindow(window.left_column, window.top_row, window.columns, window.rows)
    with MemoryFile() as memory:
        with memory.open(**profile) as dataset:
            for band, name, layer in ((1, "elevation", elevation_m), (2, "deviation", sigma_m)):
                filled = np.nan_to_num(layer[::-1], nan=NODATA).astype(np.float32)
                dataset.write(filled, band, window=at)  # blocks never written hold no data
                dataset.set_band_description(band, f"{name}_m")
        path.write_bytes(memory.getbuffer())


def summarise(result: MissionResult, evaluation: Evaluation) -> dict[str, object]:
    """Return summary.json as plain values."""
    site = result.site
    datum = site.datum
    return {
        "scenario": result.scenario.name,
        "seed": result.seed,
        "terrain": {
            "name": site.raster.name,
            "path": None if site.raster.path is None else str(site.raster.path),
            "stored_as": "depths" if site.raster.positive_down else "elevations",
            "cell_north_m": site.raster.cell_north_m,
            "cell_east_m": site.raster.cell_east_m,
            "share_of_survey_with_data": site.data_share,
        },
        "profile": result.profile,
        "baseline": result.baseline,
        "loss": result.scenario.water.loss,
        "versions": versions(),
        "datum": {
            "crs": datum.crs_wkt,
            "origin_north_m": datum.origin_north_m,
            "origin_east_m": datum.origin_east_m,
            "shift_m": datum.depth_shift_m,
            "meaning": "depth = shift - elevation; NED is counted from the origin",
            "mean_altitude_m": site.mean_altitude_m,
            "minimum_altitude_m": site.minimum_altitude_m,
        },
        "link": link_counts(result.deliveries),
        "counters": as_plain(result.counters),
        "vehicles": as_plain(evaluation.vehicles),
        "closures": as_plain(closure_counts(evaluation.closures)),
        "map": {
            "registration": as_plain(evaluation.registration),
            "tiles": as_plain(evaluation.tiles),
        },
        "remarks": list(result.remarks),
        "observability": list(result.quantities),
        "settings": as_plain(result.settings),
    }


def link_counts(deliveries: Sequence[Delivery]) -> dict[str, object]:
    """Return frames sent and bytes on the air, in all and by source, and receptions by fate.

    A frame is expected once at each receiver; packets_lost says how often it did not come whole.
    """
    fates = Counter(delivery.fate for delivery in deliveries)
    sent = dict.fromkeys(
        (d.source, d.t_tx_s, d.frame if d.sent is None else d.sent) for d in deliveries
    )
    by_source: dict[str, dict[str, int]] = {}
    for source, _, frame in sent:
        entry = by_source.setdefault(str(source), {"packets_sent": 0, "bytes_on_air": 0})
        entry["packets_sent"] += 1
        entry["bytes_on_air"] += len(frame)
    expected = fates.total() - fates["duplicate"]
    return {
        "packets_sent": len(sent),
        "packets_lost": expected - fates["delivered"],
        "receptions_expected": expected,
        "bytes_on_air": sum(len(frame) for *_, frame in sent),
        "receptions": dict(sorted(fates.items())),
        "sources": by_source,
    }


def versions() -> dict[str, str]:
    """Return the versions of what the numbers depend on."""
    found = {}
    for name in ("fathomlink", "numpy", "scipy", "gtsam", "rasterio"):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed as a package"
    return found
