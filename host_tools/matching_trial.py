"""Section 6.1 rerun: closures between compressed and original sub-maps (Figure 8).

A pair is two straight sub-maps of 40 s that meet near the middle; the second is off by a drawn
error of dead reckoning, which the match has to find. Positions within a sub-map are exact, as they
were in the paper, whose sub-maps were positioned by satellite.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from firmware.compression import compress, packets_from
from firmware.compression.binning import SoundingBins
from firmware.compression.packing import submap_header
from firmware.compression.settings import BinningSettings, CompressionSettings
from firmware.geometry import Array
from firmware.leader.matches import MatchingSettings
from firmware.leader.matching import match
from firmware.leader.own_grid import grid_of
from firmware.leader.reconstruction import ReconstructionSettings, reconstruct_packets
from firmware.submaps import BinnedSoundings, GriddedSubmap, Track
from host_tools.evaluation import VALID_CLOSURE_M
from host_tools.octree import decode_octree, leaf_count, octree_submap
from host_tools.scenario import ScenarioSettings
from host_tools.simulator.multibeam import Multibeam, Poses
from host_tools.simulator.placement import Site
from protocol.errors import EstimationError
from protocol.packets import Fragment
from protocol.settings import replace

SUBMAP_S = 40.0
CELL_M = 2.0
LOSSES = (0.0, 0.1, 0.14)
PAIRS = 200
PAPER_NODES = 200
# Closures detected and share of valid ones where the paper prints them (6.1, Figure 8).
PAPER_FIGURES = {
    ("pseudo points", 0.0): "120, 49.17 %",
    ("pseudo points", 0.1): "46.43 %",
    ("pseudo points", 0.14): "49.09 %",
    ("octree", 0.0): "119, 49 valid",
}
# Eq. 12 over some 15 minutes of two vehicles whose mean drift is alike.
ERROR_SIGMA_M = 30.0
MEETING_M = 60.0
# The paper's gates alone: the least E below 0.02, N_T, and nothing on what else would fit.
PAPER_GATES = {
    "residual_noise_ratio": 0.0,
    "absolute_depth": True,
    "false_mass_limit": 1.0,
    "evidence_limit": 0.0,
    "sigma_limit_m": 1e9,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class TrialCase:
    """How one way of sending did at one loss: closures detected, and valid ones among them."""

    method: str
    loss: float
    pairs: int
    detected: int
    valid: int

    @property
    def valid_share(self) -> float:
        """Valid ones among the detected."""
        return self.valid / self.detected if self.detected else float("nan")


@dataclass(frozen=True, slots=True, kw_only=True)
class TrialResult:
    """Figure 8: (a) the cases, (b) leaves of the octrees against the paper's 200 nodes."""

    cases: Sequence[TrialCase]
    octree_leaves: Sequence[int]

    @property
    def share_over_200(self) -> float:
        """Share of the octrees that exceed 200 nodes."""
        return float(np.mean([leaves > PAPER_NODES for leaves in self.octree_leaves]))


def trial_lines(result: TrialResult) -> list[str]:
    """Return the trial as the lines of a table, the paper's figures beside."""
    lines = [f"{'sent as, gates':<30} {'loss':>5} {'detected':>9} {'valid':>6} {'share':>7}  paper"]
    for case in result.cases:
        paper = PAPER_FIGURES.get((case.method.split(",")[0], case.loss), "")
        lines.append(
            f"{case.method:<30} {case.loss:5.0%} {case.detected:4d}/{case.pairs:<4d} "
            f"{case.valid:6d} {case.valid_share:7.1%}  {paper}"
        )
    lines.append(f"octrees with more than 200 nodes: {result.share_over_200:.0%} (paper: 63 %)")
    return lines


@dataclass(frozen=True, slots=True, kw_only=True)
class _Pair:
    """Two sub-maps; error_m (2,) was added to the second one's positions."""

    first: BinnedSoundings
    track: Track
    second: GriddedSubmap
    error_m: Array


def run_trial(
    scenario: ScenarioSettings,
    site: Site,
    seed: int,
    *,
    pairs: int = PAIRS,
    losses: Sequence[float] = LOSSES,
    progress: Callable[[int], object] | None = None,
) -> TrialResult:
    """Return Figure 8's numbers over the pairs, by our gates and by the paper's alone."""
    rng = np.random.default_rng([seed, 0xF18])
    ours, paper = MatchingSettings(), replace(MatchingSettings(), PAPER_GATES)
    counts: dict[tuple[str, float], list[int]] = {}
    leaves = []
    for number, pair in enumerate(_pairs(scenario, site, rng, pairs)):
        packets = packets_from(
            compress(pair.first, CompressionSettings()), pair.track, submap_header()
        )
        chunks = octree_submap(pair.first)
        leaves.append(leaf_count(chunks))
        for loss in losses:
            rebuilt = _rebuilt(packets, loss, rng)
            tree = _tree(chunks, pair.track, loss, rng)
            for method, grid, settings in (
                ("pseudo points", rebuilt, ours),
                ("pseudo points, paper's gates", rebuilt, paper),
                ("octree", tree, ours),
                ("octree, paper's gates", tree, paper),
            ):
                count = counts.setdefault((method, loss), [0, 0])
                error_m = None if grid is None else _match_error(pair, grid, settings)
                count[0] += error_m is not None
                count[1] += error_m is not None and error_m <= VALID_CLOSURE_M
        if progress is not None:
            progress(number + 1)
    return TrialResult(
        cases=[
            TrialCase(method=method, loss=loss, pairs=pairs, detected=detected, valid=valid)
            for (method, loss), (detected, valid) in counts.items()
        ],
        octree_leaves=leaves,
    )


def _pairs(
    scenario: ScenarioSettings, site: Site, rng: np.random.Generator, count: int
) -> Iterator[_Pair]:
    sonar = Multibeam(scenario, site.seabed, 0.0, rng)
    box = site.tracks
    made = 0
    while made < count:
        middle_m = np.array(
            [rng.uniform(box.south_m, box.north_m), rng.uniform(box.west_m, box.east_m)]
        )
        apart_m = MEETING_M * math.sqrt(rng.random())
        bearing = rng.uniform(0.0, 2.0 * np.pi)
        other_m = middle_m + apart_m * np.array([math.cos(bearing), math.sin(bearing)])
        first, track = _submap(scenario, sonar, middle_m, rng.uniform(0.0, 2.0 * np.pi))
        second, _ = _submap(scenario, sonar, other_m, rng.uniform(0.0, 2.0 * np.pi))
        error_m = rng.normal(0.0, ERROR_SIGMA_M, 2)
        if min(first.depth_m.size, second.depth_m.size) < 500:
            continue  # over no-data: nothing to compress
        made += 1
        grid = grid_of(_moved(second, error_m), CELL_M)
        yield _Pair(first=first, track=track, second=grid, error_m=error_m)


def _submap(
    scenario: ScenarioSettings, sonar: Multibeam, middle_m: Array, yaw_rad: float
) -> tuple[BinnedSoundings, Track]:
    time_s = np.arange(0.0, SUBMAP_S, 1.0 / scenario.ping_hz)
    along_m = scenario.speed_mps * (time_s - SUBMAP_S / 2.0)
    zero = np.zeros_like(time_s)
    poses = Poses(
        north_m=middle_m[0] + along_m * math.cos(yaw_rad),
        east_m=middle_m[1] + along_m * math.sin(yaw_rad),
        depth_m=zero + scenario.vehicle_depth_m,
        roll_rad=zero,
        pitch_rad=zero,
        yaw_rad=zero + yaw_rad,
    )
    ranges_m, _ = sonar.measure(poses)
    bins = SoundingBins(BinningSettings())
    for k in range(len(time_s)):
        one = slice(k, k + 1)
        bins.add(sonar.soundings(poses.part(one), ranges_m[one]), time_s[k])
    whole = np.isclose(time_s % 1.0, 0.0)
    track = Track(
        time_s=time_s[whole],
        north_m=poses.north_m[whole],
        east_m=poses.east_m[whole],
        yaw_rad=poses.yaw_rad[whole],
    )
    return bins.result(), track


def _moved(bins: BinnedSoundings, by_m: Array) -> BinnedSoundings:
    return dataclasses.replace(bins, north_m=bins.north_m + by_m[0], east_m=bins.east_m + by_m[1])


def _rebuilt(
    packets: Sequence[Fragment], loss: float, rng: np.random.Generator
) -> GriddedSubmap | None:
    """Return the sub-map of the packets that survive, None if nothing can be made of them."""
    arrived = {k: packet for k, packet in enumerate(packets) if rng.random() >= loss}
    try:
        return reconstruct_packets(arrived, ReconstructionSettings(cell_m=CELL_M), 0.0).grid
    except EstimationError:
        return None


def _tree(
    chunks: Sequence[bytes], track: Track, loss: float, rng: np.random.Generator
) -> GriddedSubmap | None:
    """Return the sub-map of an octree, None when any packet of it is lost."""
    lost = rng.random(len(chunks)) < loss
    return None if lost.any() or not chunks else decode_octree(chunks, track)


def _match_error(pair: _Pair, grid: GriddedSubmap, settings: MatchingSettings) -> float | None:
    """Return how far a detected closure is off, or None when none is detected."""
    outcome = match(grid, pair.second, np.zeros(2), np.eye(2) * ERROR_SIGMA_M**2, settings)
    if outcome.match is None:
        return None
    error_m = outcome.match.shift_m + pair.error_m
    if outcome.match.axis_deg is not None:
        axis_rad = math.radians(outcome.match.axis_deg)
        return float(abs(error_m @ [math.cos(axis_rad), math.sin(axis_rad)]))
    return float(np.hypot(*error_m))
