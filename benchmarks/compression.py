"""What each profile's map is worth, beside its peers: fidelity, loss, cost, honesty, the limit.

    python -m benchmarks.compression --per-site 3 --seed 1 --json compression.json [--quick]

RMSE against the true surface on a 1 m grid inside the hull of the soundings, wherever a method has
a depth, relative to FITC with squared exponential kernel, 150 points and jitter decoding on the
same window without loss (= 1.00). Loss: independent frames, mean square over seeded draws. Windows
named `-smooth` are noise-limited and stand apart. Real windows join when FATHOMLINK_DATA is set.
"""

import argparse
import dataclasses
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from threadpoolctl import threadpool_limits

from benchmarks import compression_gpytorch
from benchmarks.compression_bound import bounds_m2
from benchmarks.compression_peers import (
    FRAMES,
    Coded,
    Decode,
    cosine,
    farthest_points,
    fitc,
    octree,
    timed,
)
from benchmarks.compression_windows import Window, windows
from firmware.compression import compress, compress_steps, packets_from
from firmware.compression.binning import SoundingBins
from firmware.compression.kernels import Kernel
from firmware.compression.packing import submap_header
from firmware.compression.settings import CompressionSettings
from firmware.geometry import Array
from firmware.leader.reconstruction import ReconstructionSettings, reconstruct_packets
from firmware.submaps import BinnedSoundings, GriddedSubmap
from protocol.codec import decode as decode_frame
from protocol.codec import encode as encode_frame
from protocol.errors import EstimationError
from protocol.packets import SIZE_BYTES, Fragment, Profile

LOSSES = (0.0, 0.1, 0.14, 0.2)
DRAWS = 8
OURS: dict[str, tuple[str, CompressionSettings]] = {
    "paper": ("paper", CompressionSettings()),
    "paper without parity": ("paper", CompressionSettings(parity=False)),
    "dense": ("dense", CompressionSettings()),
    "lattice": ("lattice", CompressionSettings()),
    "auto, at most 10 frames": ("auto", CompressionSettings()),
    "lattice, 5 frames": ("lattice", CompressionSettings(frames=5)),
    "lattice, 3 frames": ("lattice", CompressionSettings(frames=3)),
    "lattice, 2 frames": ("lattice", CompressionSettings(frames=2)),
    "dense, 5 frames": ("dense", CompressionSettings(frames=5)),
    "lattice, 10 x 62 B": ("lattice", CompressionSettings(small_frames=True)),
}
TARGETS = {
    "paper": (0.75, 0.92, 0.96, 1.05),
    "dense": (0.58, 0.66, 0.70, 0.78),
    "lattice": (0.45, 0.47, 0.48, 0.50),
    "lattice, 2 frames": (0.90,),
}


def received(frames: list[bytes], lost: set[int]) -> dict[int, Fragment]:
    """Return the fragments that arrived, by way of the bytes."""
    out: dict[int, Fragment] = {}
    for index, frame in enumerate(frames):
        packet = decode_frame(frame)
        if index not in lost and isinstance(packet, Fragment):
            out[index] = packet
    return out


def grid_of(frames: list[bytes], lost: set[int]) -> GriddedSubmap | None:
    """Return the leader's 1 m grid, or None when the frames give none."""
    try:
        settings = ReconstructionSettings(cell_m=1.0)
        return reconstruct_packets(received(frames, lost), settings, 0.0).grid
    except EstimationError:
        return None


def at_positions(values: Array, grid: GriddedSubmap, position_m: Array) -> Array:
    """Return gridded values at positions (P, 2), NaN where there is none."""
    axes = (
        grid.north0_m + grid.cell_m * np.arange(values.shape[0]),
        grid.east0_m + grid.cell_m * np.arange(values.shape[1]),
    )
    return np.asarray(RegularGridInterpolator(axes, values, bounds_error=False)(position_m))


def ours(profile: str, settings: CompressionSettings) -> Callable[[Window], Coded]:
    """Return a coder of ours that goes all the way through frames."""

    def code(window: Window) -> Coded:
        def work() -> tuple[Decode, int]:
            compressed = compress(window.bins, settings, profile)
            packets = packets_from(compressed, window.track, submap_header())
            frames = [encode_frame(packet) for packet in packets]

            def decode(lost: set[int]) -> Array:
                grid = grid_of(frames, lost)
                if grid is None:
                    return np.full(len(window.grid_m), np.nan)
                return at_positions(grid.depth_m, grid, window.grid_m)

            return decode, sum(map(len, frames))

        return timed(work)

    return code


def remembered(decode: Decode) -> Decode:
    """Return a decoder that does each set of losses once."""
    known: dict[frozenset[int], Array] = {}

    def look_up(lost: set[int]) -> Array:
        key = frozenset(lost)
        if key not in known:
            known[key] = decode(lost)
        return known[key]

    return look_up


def rmse_m(coded: Coded, window: Window, loss: float, frames: int) -> tuple[float, float, float]:
    """Return RMSE, share of the hull covered without loss, and share of draws without a map."""
    squares, covered, none = [], [], 0
    rng = np.random.default_rng(7)
    for _ in range(DRAWS if loss else 1):
        lost = set(np.flatnonzero(rng.random(frames) < loss).tolist())
        error_m = coded.decode(lost) - window.true_m
        good = np.isfinite(error_m)
        if not good.any():
            none += 1
            continue
        squares.append(float(np.mean(error_m[good] ** 2)))
        covered.append(float(good.mean()))
    if not squares:
        return float("nan"), 0.0, 1.0
    draws = DRAWS if loss else 1
    return float(np.sqrt(np.mean(squares))), float(np.mean(covered)), none / draws


def methods(gpytorch: bool) -> dict[str, Callable[[Window], Coded]]:
    """Return every coder by name; the reference first."""
    out: dict[str, Callable[[Window], Coded]] = {
        "FITC SE, jitter": fitc,
        "FITC SE, sigma^2 again": lambda window: fitc(window, noise=True),
        "FITC exponential": lambda window: fitc(window, Kernel.EXPONENTIAL),
        "octree": octree,
        "DCT, fixed rate": cosine,
        "farthest points + GP": farthest_points,
    }
    if gpytorch:
        out["GPyTorch SGPR, cells"] = lambda w: compression_gpytorch.sgpr(w, all_soundings=False)
    for name, (profile, settings) in OURS.items():
        out[name] = ours(profile, settings)
    return out


def frames_of(name: str, size_bytes: int) -> int:
    """Return in how many frames a coder's bytes travel: those of a peer in ten."""
    if name not in OURS:
        return FRAMES
    is_small = OURS[name][1].small_frames
    profile = Profile.SUBMAP_LATTICE_SMALL if is_small else Profile.SUBMAP_LATTICE
    return size_bytes // SIZE_BYTES[profile]


def fidelity(chosen: list[Window], gpytorch: bool) -> dict[str, dict[str, dict[str, object]]]:
    """Return RMSE in m, coverage, CPU and distance to the bound for each window and method."""
    table: dict[str, dict[str, dict[str, object]]] = {}
    coders = methods(gpytorch)
    for window in chosen:
        rows: dict[str, dict[str, object]] = {}
        bound = bounds_m2(window)
        for name, code in coders.items():
            coded = code(window)
            coded = dataclasses.replace(coded, decode=remembered(coded.decode))
            frames = frames_of(name, coded.size_bytes)
            found = [rmse_m(coded, window, loss, frames) for loss in LOSSES]
            coding_m2 = np.interp(np.log2(8.0 * coded.size_bytes), *bound)
            rows[name] = {
                "rmse_m": [value[0] for value in found],
                "covered": found[0][1],
                "no_map": [value[2] for value in found],
                "cpu_s": coded.cpu_s,
                "bytes": coded.size_bytes,
                "above_bound_db": 10.0 * float(np.log10(found[0][0] ** 2 / coding_m2)),
            }
        table[window.name] = rows
        reference = rows["FITC SE, jitter"]["rmse_m"][0]  # type: ignore[index]
        print(f"  {window.name}: FITC {reference:.3f} m", flush=True)
    return table


def print_table(table: dict[str, dict[str, dict[str, object]]], title: str) -> None:
    """Print medians and worst of the ratios to the reference."""
    if not table:
        return
    print(f"\n{title}: RMSE over FITC's, median (worst) of {len(table)} windows")
    print(
        f"  {'method':24}{'bytes':>6} {'no loss':>12} {'10 %':>12} {'14 %':>12} {'20 %':>12}"
        f"{'no map':>8}{'hull':>6}{'dB':>6}{'CPU s':>8}"
    )
    rows = list(table.values())
    for name in rows[0]:
        base = np.array([row["FITC SE, jitter"]["rmse_m"] for row in rows], dtype=float)[:, :1]
        ratio = np.array([row[name]["rmse_m"] for row in rows], dtype=float) / base
        cells = []
        for column in ratio.T:
            good = column[np.isfinite(column)]
            text = f"{np.median(good):.2f} ({good.max():.2f})" if good.size else "-"
            cells.append(f"{text:>13}")
        values = [
            np.median([np.max(np.asarray(row[name][key], dtype=float)) for row in rows])
            for key in ("bytes", "no_map", "covered", "above_bound_db", "cpu_s")
        ]
        print(
            f"  {name:24}{values[0]:6.0f}{''.join(cells)}{values[1]:8.2f}{values[2]:6.2f}"
            f"{values[3]:6.1f}{values[4]:8.2f}"
        )
        if name in TARGETS:
            goals = "".join(f"{f'<= {goal:.2f}':>13}" for goal in TARGETS[name])
            print(f"  {'  target':24}{'':6}{goals}")


def honesty(chosen: list[Window]) -> dict[str, dict[str, float]]:
    """Print and return coverage of soundings held out, and the share that the 0.1 cut keeps."""
    print("\nHonesty and cost, median (worst) per profile")
    out: dict[str, dict[str, float]] = {}
    for profile in ("paper", "dense", "lattice"):
        inside, kept, grid_ms, longest_ms = [], [], [], []
        for window in chosen:
            held = np.random.default_rng(3).random(len(window.time_s)) < 0.1
            bins = _binned(window, ~held)
            longest_ms.append(_longest_step_ms(bins, profile))
            compressed = compress(bins, None, profile)
            packets = packets_from(compressed, window.track, submap_header())
            frames = [encode_frame(packet) for packet in packets]
            arrived = received(frames, set())
            started_s = time.process_time()
            everything = ReconstructionSettings(cell_m=0.7, max_variance_m2=1e9)
            whole = reconstruct_packets(arrived, everything, 0.0).grid
            grid_ms.append(1e3 * (time.process_time() - started_s) * 22_500 / whole.depth_m.size)
            grid = reconstruct_packets(arrived, ReconstructionSettings(cell_m=0.7), 0.0).grid
            good = np.isfinite(grid.depth_m).sum() / np.isfinite(whole.depth_m).sum()
            kept.append(float(good))
            test = window.soundings_ned_m[held]
            depth_m = at_positions(grid.depth_m, grid, test[:, :2])
            sigma_m = np.sqrt(at_positions(grid.variance_m2, grid, test[:, :2]))
            usable = np.isfinite(depth_m)
            within = np.abs(test[usable, 2] - depth_m[usable]) <= 1.96 * sigma_m[usable]
            inside.append(float(within.mean()))
        out[profile] = {
            "held_out_inside_95": float(np.median(inside)),
            "held_out_lowest": min(inside),
            "held_out_highest": max(inside),
            "kept_by_cut": float(np.median(kept)),
            "kept_least": min(kept),
            "grid_22500_ms": float(np.median(grid_ms)),
            "longest_step_ms": float(np.median(longest_ms)),
            "longest_step_worst_ms": max(longest_ms),
        }
        row = out[profile]
        print(
            f"  {profile:8} held-out soundings in 95 %: {100 * row['held_out_inside_95']:.1f} % "
            f"({100 * min(inside):.1f}-{100 * max(inside):.1f}); kept by the cut "
            f"{100 * row['kept_by_cut']:.1f} % ({100 * min(kept):.1f}); 22,500 cells "
            f"{row['grid_22500_ms']:.0f} ms; longest step {row['longest_step_ms']:.0f} ms "
            f"({row['longest_step_worst_ms']:.0f}), CPU"
        )
    return out


def _binned(window: Window, chosen: NDArray[np.bool_]) -> BinnedSoundings:
    bins = SoundingBins()
    bins.add(window.soundings_ned_m[chosen], window.time_s[chosen])
    return bins.result()


def _longest_step_ms(bins: BinnedSoundings, profile: str) -> float:
    steps = compress_steps(bins, None, profile)
    longest_s = 0.0
    while True:
        started_s = time.process_time()
        if next(steps, None) is None:
            return 1e3 * longest_s
        longest_s = max(longest_s, time.process_time() - started_s)


def anytime(chosen: list[Window]) -> dict[str, list[list[float]]]:
    """Print and return RMSE after a quarter of the budget, all of it and ten times it, in m.

    By profile, a row a window.
    """
    full = CompressionSettings()
    out: dict[str, list[list[float]]] = {}
    for profile, budget in (("paper", full.iterations), ("dense", full.dense_iterations)):
        coders = [
            ours(profile, CompressionSettings(iterations=n, dense_iterations=n))
            for n in (budget // 4, budget, 10 * budget)
        ]
        out[profile] = [
            [rmse_m(code(window), window, 0.0, 10)[0] for code in coders] for window in chosen
        ]
        quarter, whole, tenfold = np.array(out[profile]).T
        print(
            f"Anytime, {profile}: a quarter of the budget {_ratios(quarter / whole)} x the whole; "
            f"the whole {_ratios(whole / tenfold)} x ten times it"
        )
    return out


def _ratios(values: Array) -> str:
    return f"{np.median(values):.3f} ({values.max():.3f})"


def memory() -> dict[str, float]:
    """Print and return the growth of peak memory, each in a process of its own."""
    out = {}
    for profile in ("paper", "dense", "lattice"):
        for count in (30_720, 3_000_000):
            command = [sys.executable, "-m", "benchmarks.compression_memory", str(count), profile]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            out[f"{profile} {count}"] = float(done.stdout)
    print("Peak memory above the imports, MiB: " + ", ".join(f"{k}: {v}" for k, v in out.items()))
    return out


def against_gpytorch(window: Window) -> dict[str, float]:
    """Print and return CPU of GPyTorch on all soundings and on the cells over that of ours."""
    every = compression_gpytorch.sgpr(window, all_soundings=True)
    cells = compression_gpytorch.sgpr(window, all_soundings=False)
    out = {
        "gpytorch_all_cpu_s": every.cpu_s,
        "gpytorch_all_rmse_m": rmse_m(every, window, 0.0, 10)[0],
        "gpytorch_cells_cpu_s": cells.cpu_s,
        "gpytorch_cells_rmse_m": rmse_m(cells, window, 0.0, 10)[0],
    }
    for profile in ("paper", "dense", "lattice"):
        coded = ours(profile, CompressionSettings())(window)
        out[f"{profile}_cpu_s"] = coded.cpu_s
        out[f"{profile}_rmse_m"] = rmse_m(coded, window, 0.0, 10)[0]
    print(f"GPyTorch SGPR, 100 Adam iterations, {window.name}: " + json.dumps(out, indent=1))
    return out


def main() -> None:
    """Run what the arguments ask for; print tables, write the JSON."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.compression", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--per-site", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--quick", action="store_true", help="fidelity only, one window a site")
    arguments = parser.parse_args()
    gpytorch = compression_gpytorch.available() and not arguments.quick
    chosen = list(windows(1 if arguments.quick else arguments.per_site, arguments.seed))
    table = fidelity(chosen, gpytorch)
    names = {window.name: window.smooth for window in chosen}
    print_table({n: r for n, r in table.items() if not names[n]}, "Relief")
    print_table({n: r for n, r in table.items() if names[n]}, "Smooth, noise-limited")
    result: dict[str, object] = {"fidelity": table}
    if not arguments.quick:
        rough = [window for window in chosen if not window.smooth]
        result["honesty"] = honesty(rough)
        result["anytime"] = anytime(rough)
        result["memory_mib"] = memory()
        if gpytorch:
            result["gpytorch"] = against_gpytorch(rough[1])
        else:
            print("GPyTorch is not installed (pip install fathomlink[bench]); not compared")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    with threadpool_limits(1):
        main()
