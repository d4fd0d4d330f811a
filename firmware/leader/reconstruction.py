"""Sub-maps rebuilt on a grid from the pseudo points that arrived.

Source: paper, section 4.2: Gaussian process regression (Eq. 5, 6) inside the outer edges of the
points' Delaunay triangulation; depths with a variance above 0.1 are dropped. That is the map's own
variance, without sigma^2 of the soundings as far as noise may explain it: otherwise nothing would
be left of a survey from 100 m above the seabed. A lattice carries a single variance, that of the
soundings about it, and none of its depths are dropped.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from firmware.compression.decoder import point_decoder
from firmware.compression.dense import dense_points
from firmware.compression.footprint import inside_footprint
from firmware.compression.kernels import Hyperparameters
from firmware.compression.lattice import LatticeMap, lattice_map
from firmware.compression.mantissa import completed
from firmware.compression.track_code import decode_track
from firmware.geometry import Array
from firmware.leader.gridding import gridded
from firmware.submaps import GriddedSubmap, Track
from protocol.errors import EstimationError, RemoteProtocolError
from protocol.lattice import PROTECTION_BYTES
from protocol.packets import (
    SEAL_BYTES,
    Fragment,
    Profile,
    SubmapFragment,
    SubmapPacket,
    usable_hyperparameters,
    usable_points,
    usable_states,
)
from protocol.settings import Settings, setting
from protocol.timestamps import from_quarters

_MAX_POINTS = 600  # ten frames hold fewer; the decoder's matrices are bounded by it
_ABEAM_STEP_S = 1.0  # two metres of track: the size of a cell
_NEARER_PASS = 1e-3  # of the square of the distance: decides only where a turn looks twice


@dataclass(frozen=True, slots=True, kw_only=True)
class ReconstructionSettings(Settings):
    """The leader's grid, and which of its cells are kept."""

    cell_m: float = setting(
        2.0, "m", "the grid of the matching, own sub-maps too (paper, 6.1)", minimum=0.05
    )
    max_variance_m2: float = setting(
        0.1, "m2", "paper, 4.2: above it depths are dropped", minimum=0.0
    )
    max_noise_m2: float = setting(
        1.0,
        "m2",
        "of soundings at 100 to 200 m of depth; what exceeds it is relief that no fit could follow",
        minimum=0.0,
    )
    max_cells: int = setting(
        1_000_000, "cells", "25 MB; a swath at 1 m has 22,500", minimum=100, maximum=10_000_000
    )
    sealed: bool = setting(
        False, "", "the last 12 bytes of `dense` and `lattice` bodies were their seal's"
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Reconstruction:
    """A sub-map as the leader has it: the grid, and the states that arrived."""

    grid: GriddedSubmap
    track: Track
    recovered_points: int = 0


def reconstruct_packets(
    fragments: Mapping[int, Fragment],
    settings: ReconstructionSettings,
    near_s: float,
) -> Reconstruction:
    """Return the sub-map of the fragments that arrived; near_s is about when it was measured.

    Raises
    ------
    EstimationError
        When the fragments hold nothing a map can be made of.
    """
    if not fragments:
        raise EstimationError("no fragment arrived; nothing can be rebuilt")
    packets = [p for _, p in sorted(fragments.items()) if isinstance(p, SubmapPacket)]
    if not packets:
        return _from_bodies(
            {i: p for i, p in fragments.items() if isinstance(p, SubmapFragment)}, settings, near_s
        )
    parts = {packet.header.fragment: packet.points_ned_m for packet in packets}
    told = [p.hyperparameters for p in packets]
    hyperparameters = next(filter(usable_hyperparameters, told), told[0])
    points_ned_m, recovered = completed(parts, hyperparameters[3])
    track = track_of_packets(packets, near_s)
    grid = reconstruct_points(points_ned_m, hyperparameters, track, settings)
    return Reconstruction(grid=grid, track=track, recovered_points=recovered)


def states_of_fragment(fragment: SubmapFragment) -> Array:
    """Return the states (T, 3) north, east, yaw that a single fragment carries, one a second.

    Raises
    ------
    EstimationError
        When the body holds no track.
    """
    try:
        track, _ = decode_track(fragment.body[PROTECTION_BYTES:], 0.0)
    except RemoteProtocolError as error:
        raise EstimationError(str(error)) from error
    return np.column_stack([track.north_m, track.east_m, track.yaw_rad])


def _from_bodies(
    fragments: Mapping[int, SubmapFragment], settings: ReconstructionSettings, near_s: float
) -> Reconstruction:
    """Return the sub-map of opaque fragments; each carries the whole track by itself."""
    first = next(iter(fragments.values()))
    first_s = from_quarters(first.header.time_quarters, near_s)
    try:
        track, taken = decode_track(first.body[PROTECTION_BYTES:], first_s)
        seal_bytes = SEAL_BYTES if settings.sealed else 0
        bodies = {i: f.body[: len(f.body) - seal_bytes] for i, f in fragments.items()}
        if first.header.profile.plain is Profile.SUBMAP_DENSE:
            points_ned_m, hyper = dense_points(bodies, taken, first.header.fragment_count)
            grid = reconstruct_points(points_ned_m, hyper, track, settings)
            return Reconstruction(grid=grid, track=track)
        found = lattice_map(bodies, taken, first.header.fragment_count)
    except RemoteProtocolError as error:
        raise EstimationError(str(error)) from error
    return Reconstruction(grid=lattice_grid(found, track, settings), track=track)


def lattice_grid(
    found: LatticeMap, track: Track, settings: ReconstructionSettings
) -> GriddedSubmap:
    """Return a lattice map on the leader's grid, inside the footprint that came with it."""
    corners = np.array(
        [[0.0, 0.0], [0.0, found.frame.columns], [found.frame.rows, 0.0], list(found.frame.shape)]
    )
    north_m, east_m = _axes(found.frame.positions_of(corners), settings)
    row, column = np.nonzero(np.ones((north_m.size, east_m.size), dtype=bool))
    position_m = np.column_stack([north_m[row], east_m[column]])
    wanted = inside_footprint(found.mask, found.frame, position_m)
    depth_m = np.full((north_m.size, east_m.size), np.nan)
    depth_m[row[wanted], column[wanted]] = found.depth_m(position_m[wanted])
    good = np.isfinite(depth_m)
    return GriddedSubmap(
        north0_m=float(north_m[0]),
        east0_m=float(east_m[0]),
        cell_m=settings.cell_m,
        depth_m=depth_m,
        variance_m2=np.where(good, found.variance_m2, np.nan),
        time_s=times_of_cells(track, north_m, east_m, good),
        reconstructed=True,
    )


def track_of_packets(packets: list[SubmapPacket], near_s: float) -> Track:
    """Return the usable states of the packets' slices, by time."""
    rows = []
    for packet in packets:
        good = usable_states(packet.trajectory)
        first_s = from_quarters(packet.header.time_quarters, near_s)
        times_s = first_s + np.arange(len(good), dtype=np.float64)
        rows.append(np.column_stack([times_s, packet.trajectory])[good])
    states = np.concatenate(rows) if rows else np.empty((0, 4))
    states = states[np.argsort(states[:, 0], kind="stable")]
    return Track(
        time_s=states[:, 0], north_m=states[:, 1], east_m=states[:, 2], yaw_rad=states[:, 3]
    )


def reconstruct_points(
    points_ned_m: NDArray[np.float32] | Array,
    hyperparameters: NDArray[np.float32] | Array,
    track: Track,
    settings: ReconstructionSettings,
) -> GriddedSubmap:
    """Return the grid inside the hull of the points (M, 3); whatever the numbers, it is bounded.

    Raises
    ------
    EstimationError
        When fewer than three points are usable, or they lie on one line.
    """
    points = np.asarray(points_ned_m, dtype=np.float64)[:_MAX_POINTS]
    points = points[usable_points(points)]
    if len(points) < 3:
        raise EstimationError(f"{len(points)} usable points; a hull needs three")
    hyper = Hyperparameters.from_wire(
        np.asarray(hyperparameters, dtype=np.float64), float(np.median(points[:, 2]))
    )
    decoder = point_decoder(points, hyper)
    north_m, east_m = _axes(points[:, :2], settings)
    inside = _inside(points[:, :2], north_m, east_m)
    depth_m, variance_m2 = gridded(decoder, north_m, east_m, inside)
    noise_m2 = min(hyper.sigma2_m2, settings.max_noise_m2)
    depth_m[variance_m2 - noise_m2 > settings.max_variance_m2] = np.nan
    variance_m2[np.isnan(depth_m)] = np.nan
    return GriddedSubmap(
        north0_m=float(north_m[0]),
        east0_m=float(east_m[0]),
        cell_m=settings.cell_m,
        depth_m=depth_m,
        variance_m2=variance_m2,
        time_s=times_of_cells(track, north_m, east_m, np.isfinite(depth_m)),
        reconstructed=True,
    )


def _axes(position_m: Array, settings: ReconstructionSettings) -> tuple[Array, Array]:
    """Return the grid's north and east, on multiples of the cell, cut about the points' middle."""
    cell_m = settings.cell_m
    low, high = position_m.min(axis=0), position_m.max(axis=0)
    sides = np.floor(high / cell_m) - np.ceil(low / cell_m) + 1
    if max(sides) > np.sqrt(settings.max_cells):
        reach_m = 0.5 * cell_m * (np.sqrt(settings.max_cells) - 2.0)
        middle = np.median(position_m, axis=0)
        low, high = np.maximum(low, middle - reach_m), np.minimum(high, middle + reach_m)
    first = np.ceil(low / cell_m).astype(np.int64)
    last = np.maximum(np.floor(high / cell_m).astype(np.int64), first)
    return (
        cell_m * np.arange(first[0], last[0] + 1, dtype=np.float64),
        cell_m * np.arange(first[1], last[1] + 1, dtype=np.float64),
    )


def _inside(position_m: Array, north_m: Array, east_m: Array) -> NDArray[np.bool_]:
    """Return (R, C) which cells lie in the convex hull: the outline of the triangulation."""
    middle = position_m.mean(axis=0)
    try:
        hull = ConvexHull(position_m - middle)
    except QhullError as error:
        raise EstimationError("the points lie on one line; a map needs an area") from error
    inside = np.ones((north_m.size, east_m.size), dtype=bool)
    for by_north, by_east, offset in hull.equations:
        along = by_north * (north_m - middle[0])
        across = by_east * (east_m - middle[1]) + offset
        inside &= along[:, None] <= 1e-9 - across[None, :]
    return inside


def times_of_cells(track: Track, north_m: Array, east_m: Array, wanted: NDArray[np.bool_]) -> Array:
    """Return (R, C) when each wanted cell was abeam, as the sonar looks; NaN elsewhere.

    Abeam is by the heading: the track itself may drift aside. Where a turn sees a cell twice, the
    nearer pass counts.
    """
    time_s = np.full(wanted.shape, np.nan)
    if not track.time_s.size or not wanted.any():
        return time_s
    steps = int(np.ceil((track.time_s[-1] - track.time_s[0]) / _ABEAM_STEP_S)) + 1
    times_s = np.linspace(track.time_s[0], track.time_s[-1], steps)
    yaw_rad = np.interp(times_s, track.time_s, np.unwrap(track.yaw_rad))
    least_m2 = np.full(wanted.shape, np.inf)
    for here_m, yaw, at_s in zip(track.position_at(times_s), yaw_rad, times_s, strict=True):
        north, east = (north_m - here_m[0])[:, None], (east_m - here_m[1])[None, :]
        ahead_m = np.cos(yaw) * north + np.sin(yaw) * east
        abeam_m2 = ahead_m**2 + _NEARER_PASS * (north**2 + east**2)
        better = abeam_m2 < least_m2
        np.copyto(least_m2, abeam_m2, where=better)
        np.copyto(time_s, at_s, where=better)
    time_s[~wanted] = np.nan
    return time_s
