"""Matching of sub-map pairs as a mission makes them: found, valid, honest, how fast.

    python -m benchmarks.matching --pairs 200 --seed 1 [--relief rough,ridge] [--prior 2,10,30,60]

Pairs lie as in the survey: parallel strips 100 m apart (39 m of overlap) and crossings, soundings
with 0.15 m and 0.3 % of the slant range of noise, dead reckoning with Eq. 12's random walk and
a rate that is left after the removal of drift. Real terrains join when FATHOMLINK_DATA is set.

Valid is within 5 m of the truth, along its axis for a one-axis closure. RMS error and NEES (2 is
honest, 1 along an axis) are of valid closures only.
"""

import argparse
import os
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import fft, ndimage

from firmware.compression import compress, fragment_points
from firmware.compression.settings import CompressionSettings
from firmware.geometry import Array
from firmware.leader.matches import Match, MatchingSettings, MatchOutcome
from firmware.leader.matching import match
from firmware.leader.reconstruction import ReconstructionSettings, reconstruct_points
from firmware.submaps import BinnedSoundings, GriddedSubmap, Track

CELL_M = 2.0
SPEED_MPS = 2.06
DURATION_S = 40.0
TERRAINS = {
    "massbay": "massbay_west_5m.tif",
    "medes": "medes_islands_10m.tif",
    "portsmouth": "portsmouth_ripples_50cm.bag",
    "shelf": "flat_shelf_2m.bag",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Seabed:
    """Depth (R, C) on a square lattice; NaN where there is no data."""

    depth_m: Array
    cell_m: float

    def at(self, north_m: Array, east_m: Array) -> Array:
        """Return the bilinear depth."""
        return ndimage.map_coordinates(
            self.depth_m, [north_m / self.cell_m, east_m / self.cell_m], order=1, cval=np.nan
        )

    @property
    def size_m(self) -> tuple[float, float]:
        """Return the extent to north and east."""
        return self.depth_m.shape[0] * self.cell_m, self.depth_m.shape[1] * self.cell_m


def synthetic(kind: str, rng: np.random.Generator) -> Seabed:
    """Return 1.2 x 1.2 km of relief of a named kind."""
    n, cell = 600, 2.0
    wave = np.hypot(*np.meshgrid(fft.fftfreq(n, cell), fft.fftfreq(n, cell), indexing="ij"))
    wave[0, 0] = np.inf
    field = fft.ifft2(fft.fft2(rng.standard_normal((n, n))) * wave**-1.75).real
    field *= 1.0 / np.sqrt(np.mean((field - ndimage.uniform_filter(field, 100)) ** 2))
    north, east = np.meshgrid(np.arange(n) * cell, np.arange(n) * cell, indexing="ij")
    if kind == "rough":
        depth = 0.8 * field
    elif kind == "gentle":
        depth = 0.25 * field
    elif kind == "flat":
        depth = 0.01 * field
    elif kind == "ridge":
        depth = 0.02 * field + np.interp(east, np.arange(n) * cell, 1.0 * field[0])
    else:
        depth = 0.1 * field + 0.4 * np.sin(2.0 * np.pi * (north + 0.2 * east) / 12.0)
    return Seabed(depth_m=40.0 + depth, cell_m=cell)


def terrain(name: str) -> Seabed:
    """Return a real terrain, moved so that the mean depth is that of a 40 m altitude."""
    import rasterio  # noqa: PLC0415  only where the data is there

    with rasterio.open(Path(os.environ["FATHOMLINK_DATA"]) / "terrain" / TERRAINS[name]) as data:
        elevation = data.read(1, masked=True).filled(np.nan).astype(np.float64)[::-1]
        cell = float(data.res[0])
    depth = -elevation
    return Seabed(depth_m=depth - np.nanmean(depth) + 40.0, cell_m=cell)


def survey(
    seabed: Seabed,
    centre_m: Array,
    heading_rad: float,
    rng: np.random.Generator,
    drift_sigma_mps: float,
) -> tuple[GriddedSubmap, Track]:
    """Return the gridded sub-map of a straight line, and by how far dead reckoning errs in it."""
    times = np.arange(0.0, DURATION_S, 0.25)
    forward = np.array([np.cos(heading_rad), np.sin(heading_rad)])
    starboard = np.array([-np.sin(heading_rad), np.cos(heading_rad)])
    truth = centre_m + forward * ((times - DURATION_S / 2.0) * SPEED_MPS)[:, None]
    local = _depth_near(seabed, centre_m)
    angles = np.radians(np.linspace(-60.0, 60.0, 192))
    yaw = np.radians(0.1) * rng.standard_normal(times.size)
    altitude = np.full((times.size, 192), 40.0)
    for _ in range(3):
        across = altitude * np.tan(angles)
        north = truth[:, :1] + starboard[0] * across
        east = truth[:, 1:] + starboard[1] * across
        altitude = np.nan_to_num(seabed.at(north, east) - (local - 40.0), nan=40.0)
        altitude = np.clip(altitude, 15.0, 150.0)
    slant = altitude / np.cos(angles)
    sigma = np.hypot(0.15, 0.003 * slant)
    depth = seabed.at(north, east) + sigma * rng.standard_normal(slant.shape)
    walk = np.cumsum(rng.normal(0.0, 0.2 * 0.5, (times.size, 2)), axis=0)
    walk += np.outer(times, rng.normal(0.0, drift_sigma_mps, 2))
    walk -= walk[times.size // 2]
    across = altitude * np.tan(angles)
    believed = truth + walk
    turned = np.stack([starboard[0] - forward[0] * yaw, starboard[1] - forward[1] * yaw])
    north = believed[:, :1] + turned[0][:, None] * across
    east = believed[:, 1:] + turned[1][:, None] * across
    grid = _grid(north, east, depth, np.broadcast_to(times[:, None], depth.shape), sigma)
    return grid, Track(time_s=times, north_m=walk[:, 0], east_m=walk[:, 1], yaw_rad=yaw)


def _depth_near(seabed: Seabed, centre_m: Array) -> float:
    offsets = np.linspace(-60.0, 60.0, 13)
    north, east = np.meshgrid(centre_m[0] + offsets, centre_m[1] + offsets, indexing="ij")
    return float(np.nanmean(seabed.at(north, east)))


def _grid(north: Array, east: Array, depth: Array, times: Array, sigma: Array) -> GriddedSubmap:
    known = np.isfinite(depth)
    row = np.round(north[known] / CELL_M).astype(int)
    col = np.round(east[known] / CELL_M).astype(int)
    row0, col0 = row.min(), col.min()
    shape = (row.max() - row0 + 1, col.max() - col0 + 1)
    index = (row - row0) * shape[1] + col - col0

    def total(values: Array | None) -> Array:
        return np.bincount(index, values, shape[0] * shape[1]).reshape(shape).astype(np.float64)

    count = total(None)
    safe = np.where(count > 0, count, np.nan)
    mean_variance = total(sigma[known] ** 2) / safe
    return GriddedSubmap(
        north0_m=float(row0 * CELL_M),
        east0_m=float(col0 * CELL_M),
        cell_m=CELL_M,
        depth_m=total(depth[known]) / safe,
        variance_m2=mean_variance / safe,
        time_s=total(times[known]) / safe,
    )


def rebuilt(
    grid: GriddedSubmap, rng: np.random.Generator, loss: float, method: str
) -> GriddedSubmap:
    """Return the sub-map as the leader has it after the acoustic link and its losses."""
    row, col = np.nonzero(np.isfinite(grid.depth_m))
    variance = grid.variance_m2[row, col]
    bins = BinnedSoundings(
        cell_m=grid.cell_m,
        north_m=np.asarray(grid.north0_m + grid.cell_m * row, dtype=np.float64),
        east_m=np.asarray(grid.east0_m + grid.cell_m * col, dtype=np.float64),
        depth_m=grid.depth_m[row, col],
        variance_m2=variance,
        count=np.maximum(np.round(0.03 / variance), 1.0),
        time_s=grid.time_s[row, col],
    )
    compressed = compress(bins, CompressionSettings(method=method))
    arrived = rng.random(compressed.fragment_count) >= loss
    points = fragment_points(compressed)[arrived].reshape(-1, 3)
    seconds = np.floor(bins.time_s)
    track_s = np.unique(seconds)
    track = Track(
        time_s=track_s,
        north_m=np.array([bins.north_m[seconds == s].mean() for s in track_s]),
        east_m=np.array([bins.east_m[seconds == s].mean() for s in track_s]),
        yaw_rad=np.zeros(track_s.size),
    )
    settings = ReconstructionSettings(cell_m=grid.cell_m)
    return reconstruct_points(points, compressed.hyperparameters, track, settings)


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """Two sub-maps, and by how far dead reckoning errs in reference and query."""

    reference: GriddedSubmap
    query: GriddedSubmap
    reconstructed: GriddedSubmap
    walks: tuple[Track, Track]

    def error_m(self, found: Match) -> Array:
        """Return how far a match is from the shift between the times that it links, (2,)."""
        times_s = found.reference_time_s, found.query_time_s
        astray_m = [walk.position_at(at_s) for walk, at_s in zip(self.walks, times_s, strict=True)]
        return np.asarray(found.shift_m - (astray_m[0] - astray_m[1]))


def make_pair(
    seabed: Seabed, rng: np.random.Generator, drift_sigma_mps: float, loss: float, method: str
) -> Pair:
    """Return two overlapping sub-maps, right at mid-time; parallel or crossing by a coin."""
    for _ in range(1000):
        centre = rng.uniform(160.0, np.array(seabed.size_m) - 160.0)
        heading = rng.choice([0.0, 0.5, 1.0, 1.5]) * np.pi
        across = np.array([-np.sin(heading), np.cos(heading)])
        along = np.array([np.cos(heading), np.sin(heading)])
        if rng.random() < 0.5:
            other, other_heading = centre + 100.0 * across + rng.uniform(-30, 30) * along, heading
            other_heading += np.pi
        else:
            other = centre + rng.uniform(-40, 40) * across + rng.uniform(-40, 40) * along
            other_heading = heading + np.pi / 2.0
        if _covered(seabed, centre) and _covered(seabed, other):
            break
    reference, reference_walk = survey(seabed, centre, heading, rng, drift_sigma_mps)
    query, query_walk = survey(seabed, other, other_heading, rng, drift_sigma_mps)
    return Pair(
        reference=reference,
        query=query,
        reconstructed=rebuilt(query, rng, loss, method),
        walks=(reference_walk, query_walk),
    )


def _covered(seabed: Seabed, centre: Array) -> bool:
    offsets = np.linspace(-60.0, 60.0, 9)
    north, east = np.meshgrid(centre[0] + offsets, centre[1] + offsets, indexing="ij")
    depth = seabed.at(north, east)
    return bool(np.isfinite(depth).mean() > 0.9 and np.nanmin(depth) > np.nanmean(depth) - 25.0)


def report(label: str, results: list[tuple[MatchOutcome, Array, float]]) -> str:
    """Return one line: found, valid, error and NEES of the valid, one-axis, time, reasons."""
    full = [(o.match, e) for o, e, _ in results if o.match and o.match.axis_deg is None]
    single = [(o.match, e) for o, e, _ in results if o.match and o.match.axis_deg is not None]
    errors = [float(np.hypot(*e)) for _, e in full]
    valid = [(m, e) for m, e in full if np.hypot(*e) < 5.0]
    nees = [float(e @ np.linalg.solve(m.covariance_m2, e)) for m, e in valid]
    axis_errors = []
    for m, e in single:
        axis_rad = np.radians(m.axis_deg or 0.0)
        axis = np.array([np.cos(axis_rad), np.sin(axis_rad)])
        axis_errors.append(
            (abs(axis @ e), float((axis @ e) ** 2 / (axis @ m.covariance_m2 @ axis)))
        )
    good_axis = [n for a, n in axis_errors if a < 5.0]
    reasons = Counter(o.reason.name for o, _, _ in results if o.reason)
    line = f"{label:34s} found {len(full):3d} valid {len(valid):3d}"
    rms_m = np.sqrt(np.mean([e**2 for e in errors if e < 5])) if valid else np.nan
    line += f", of these RMS {rms_m:5.2f} m"
    line += f" NEES {np.mean(nees) if nees else np.nan:5.2f}"
    line += f" med {np.median(nees) if nees else np.nan:4.2f}"
    line += f" | axis {len(single):3d} valid {len(good_axis):3d}"
    line += f", of these NEES {np.mean(good_axis) if good_axis else np.nan:5.2f}"
    line += f" | {1e3 * np.median([t for _, _, t in results]):5.1f} ms | "
    return line + " ".join(f"{k}:{v}" for k, v in sorted(reasons.items()))


def run(
    label: str,
    pairs: int,
    seed: int,
    priors_m: list[float],
    settings: MatchingSettings,
    loss: float,
    method: str,
) -> None:
    """Print a line per prior, for own sub-maps and for reconstructed ones."""
    rng = np.random.default_rng(seed)
    beds = [terrain(label)] if label in TERRAINS else [synthetic(label, rng) for _ in range(5)]
    made = [make_pair(beds[i % len(beds)], rng, 0.02, loss, method) for i in range(pairs)]
    for prior_m in priors_m:
        for kind in ("own", "rebuilt"):
            results = []
            for pair in made:
                offset = rng.normal(0.0, prior_m, 2)
                query = pair.query if kind == "own" else pair.reconstructed
                started = time.perf_counter()
                outcome = match(pair.reference, query, offset, np.eye(2) * prior_m**2, settings)
                took = time.perf_counter() - started
                error = pair.error_m(outcome.match) if outcome.match else np.zeros(2)
                results.append((outcome, error, took))
            print(report(f"{label} {kind} prior {prior_m:g} m", results), flush=True)


def main() -> None:
    """Run the kinds of relief asked for."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.matching", description=__doc__)
    parser.add_argument("--pairs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--relief", default="rough,gentle,ridge,ripples,flat," + ",".join(TERRAINS))
    parser.add_argument("--prior", default="2,10,30,60")
    parser.add_argument("--loss", type=float, default=0.14)
    parser.add_argument("--method", default="expected", choices=["expected", "fitc"])
    arguments = parser.parse_args()
    priors_m = [float(p) for p in arguments.prior.split(",")]
    for kind in arguments.relief.split(","):
        if kind in TERRAINS and "FATHOMLINK_DATA" not in os.environ:
            print(f"{kind}: skipped, FATHOMLINK_DATA is not set")
            continue
        run(
            kind,
            arguments.pairs,
            arguments.seed,
            priors_m,
            MatchingSettings(),
            arguments.loss,
            arguments.method,
        )


if __name__ == "__main__":
    main()
