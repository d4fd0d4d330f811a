"""GSF logs of real surveys as the soundings that `fathomlink compress` takes.

GSF keeps each beam's depth, across-track and along-track distance, corrected for attitude and
refraction; they are turned by the ping's heading, from true north, into a metric projection. Read
with gsfu, an optional dependency: `pip install fathomlink[replay]`.
"""

import argparse
import datetime
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rasterio.warp import transform

from firmware.geometry import Array
from host_tools.commands import Command, check_apart
from protocol.errors import ConfigError

IGNORED_BEAM = 0x01  # bit 0 of a beam's flags, and of a ping's
GEOGRAPHIC = "EPSG:4326"
_STEP_DEG = 1e-3  # of latitude, a hundred metres


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayedLine:
    """One survey line: soundings (N,) and the track (T,) in NED from the first ping.

    time_s counts from the first ping. origin_north_m and origin_east_m are that ping's position in
    the projection `crs`. rejected counts beams that the log itself flags, or that hold no number.
    """

    north_m: Array
    east_m: Array
    depth_m: Array
    time_s: Array
    track_time_s: Array
    track_north_m: Array
    track_east_m: Array
    track_yaw_rad: Array
    crs: str
    origin_north_m: float
    origin_east_m: float
    rejected: int

    def save(self, path: Path) -> None:
        """Write the arrays as the .npz that `fathomlink compress` reads."""
        names = ("north_m", "east_m", "depth_m", "time_s")
        tracks = ("track_time_s", "track_north_m", "track_east_m", "track_yaw_rad")
        try:
            with path.open("wb") as stream:
                np.savez_compressed(stream, **{n: getattr(self, n) for n in (*names, *tracks)})
        except OSError as error:
            raise ConfigError(f"cannot write {path}: {error.strerror}") from error


def read_gsf(path: Path) -> ReplayedLine:
    """Return the line of a GSF file.

    Raises
    ------
    ConfigError
        When gsfu is not installed, or the file is not GSF or holds no usable ping.
    """
    pings = _pings(path)
    if not pings:
        raise ConfigError(f"{path} holds no GSF swath bathymetry ping with a position")
    longitude = [float(ping["Longitude_deg"]) for ping in pings]
    latitude = [float(ping["Latitude_deg"]) for ping in pings]
    crs = utm_of(longitude[0], latitude[0])
    east, north = transform(GEOGRAPHIC, crs, longitude, latitude)[:2]
    track_m = np.stack([north, east], axis=1)
    began_s = ping_s(pings[0])
    times_s = np.array([ping_s(ping) - began_s for ping in pings])
    heading_rad = np.radians([float(ping["Heading_deg"]) for ping in pings])
    yaw_rad = (heading_rad + true_north_rad(crs, longitude, latitude)) % (2.0 * np.pi)
    parts, sizes = [], []
    for ping, position_m, ping_yaw_rad in zip(pings, track_m - track_m[0], yaw_rad, strict=True):
        soundings_m, beams = _soundings(ping, position_m, float(ping_yaw_rad))
        parts.append(soundings_m)
        sizes.append((len(soundings_m), beams))
    points_m = np.concatenate(parts)
    kept = [size for size, _ in sizes]
    return ReplayedLine(
        north_m=points_m[:, 0],
        east_m=points_m[:, 1],
        depth_m=points_m[:, 2],
        time_s=np.repeat(times_s, kept),
        track_time_s=times_s,
        track_north_m=track_m[:, 0] - track_m[0, 0],
        track_east_m=track_m[:, 1] - track_m[0, 1],
        track_yaw_rad=yaw_rad,
        crs=crs,
        origin_north_m=float(track_m[0, 0]),
        origin_east_m=float(track_m[0, 1]),
        rejected=sum(beams for _, beams in sizes) - sum(kept),
    )


def utm_of(longitude_deg: float, latitude_deg: float) -> str:
    """Return the UTM zone of a position as an EPSG code."""
    zone = min(60, int((longitude_deg + 180.0) // 6.0) + 1)
    return f"EPSG:{(32600 if latitude_deg >= 0.0 else 32700) + zone}"


def true_north_rad(
    crs: str, longitude_deg: Sequence[float], latitude_deg: Sequence[float]
) -> Array:
    """Return the bearings (T,) of true north from the grid's north, positive to the east."""
    farther_deg = [degrees + _STEP_DEG for degrees in latitude_deg]
    east_m, north_m = np.subtract(
        transform(GEOGRAPHIC, crs, longitude_deg, farther_deg)[:2],
        transform(GEOGRAPHIC, crs, longitude_deg, latitude_deg)[:2],
    )
    bearings_rad: Array = np.arctan2(east_m, north_m)
    return bearings_rad


def _pings(path: Path) -> list[dict[str, Any]]:
    try:
        from GSFU.gsfu import gsf  # noqa: PLC0415  optional
    except ImportError as error:
        raise ConfigError("reading GSF needs gsfu: pip install fathomlink[replay]") from error
    if not path.is_file():
        raise ConfigError(f"{path} is not a file; give a GSF log")
    reader = gsf(str(path))
    try:
        records = [ping for _, _, ping in reader.iter_records("SWATH_BATHYMETRY_PING")]
    except Exception as error:  # the reader's own errors share no base with ours
        raise ConfigError(f"{path} cannot be read as GSF: {error}") from error
    finally:
        reader.closeFile()
    return [ping for ping in records if _is_usable(ping)]


def _is_usable(ping: dict[str, Any]) -> bool:
    columns = [ping["Beams"].get(name) for name in ("Depth_m", "AcrossTrack_m")]
    if any(column is None for column in columns) or ping["PingFlags"] & IGNORED_BEAM:
        return False
    position = (float(ping["Longitude_deg"]), float(ping["Latitude_deg"]))
    heading = float(ping["Heading_deg"])
    on_earth = abs(position[0]) <= 180.0 and abs(position[1]) < 85.0
    return on_earth and math.isfinite(heading) and 0.0 <= heading <= 360.0


def _soundings(ping: dict[str, Any], position_m: Array, yaw_rad: float) -> tuple[Array, int]:
    """Return the usable soundings (N, 3) of a ping and how many beams it has."""
    beams = ping["Beams"]
    depth_m = np.asarray(beams["Depth_m"], dtype=np.float64)
    across_m = np.asarray(beams["AcrossTrack_m"], dtype=np.float64)
    along = beams.get("AlongTrack_m")
    along_m = np.zeros_like(depth_m) if along is None else np.asarray(along, dtype=np.float64)
    good = np.isfinite(depth_m) & np.isfinite(across_m) & np.isfinite(along_m) & (depth_m > 0.0)
    flags = beams.get("BeamFlags")
    if flags is not None:
        good &= (np.asarray(flags) & IGNORED_BEAM) == 0
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    north_m = position_m[0] + along_m * c - across_m * s
    east_m = position_m[1] + along_m * s + across_m * c
    return np.stack([north_m, east_m, depth_m], axis=1)[good], depth_m.size


def ping_s(ping: dict[str, Any]) -> float:
    """Return when a ping was sent, in seconds since 1970; a log tells UTC."""
    moment = datetime.datetime.fromisoformat(str(ping["PingTime"]))
    return (moment if moment.tzinfo else moment.replace(tzinfo=datetime.UTC)).timestamp()


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", type=Path, metavar="FILE.gsf", help="a GSF log")
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="SOUNDINGS.npz",
        help="soundings that compress reads",
    )


def _run(arguments: argparse.Namespace) -> None:
    check_apart(arguments.log, arguments.out)
    line = read_gsf(arguments.log)
    line.save(arguments.out)
    print(
        f"{line.depth_m.size} soundings of {line.track_time_s.size} pings in "
        f"{line.track_time_s[-1]:.0f} s, {line.rejected} beams rejected; NED from "
        f"{line.origin_north_m:.1f} N, {line.origin_east_m:.1f} E of {line.crs}"
    )


COMMAND = Command(
    name="replay", help="turn a GSF log into soundings", configure=_configure, run=_run
)
