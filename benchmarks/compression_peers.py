"""What compression is measured against: octree, fixed-rate DCT, farthest points, FITC, GPyTorch."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dctn, idctn
from scipy.interpolate import griddata
from scipy.ndimage import map_coordinates

from benchmarks.compression_windows import Window
from firmware.compression.binning import coarsened
from firmware.compression.calibration import calibrated
from firmware.compression.decoder import point_decoder
from firmware.compression.fit import dealt_evenly, fit_frame
from firmware.compression.fitc_fit import fitc_steps
from firmware.compression.initial import Outline, dealt_fragments
from firmware.compression.kernels import Hyperparameters, Kernel
from firmware.compression.settings import CompressionSettings
from firmware.geometry import Array
from host_tools.octree import leaf_count, octree_submap

FRAMES = 10
DCT_BYTES = 2400
REFERENCE_EVALUATIONS = 100

Decode = Callable[[set[int]], Array]
"""Depth (P,) at the window's grid, NaN where there is none, for a set of lost frames."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Coded:
    """A compressed window: its decoder, the bytes it takes, the CPU seconds it took."""

    decode: Decode
    size_bytes: int
    cpu_s: float


def timed(work: Callable[[], tuple[Decode, int]]) -> Coded:
    """Return what work makes, with the CPU time of this process."""
    start_s = time.process_time()
    decode, size_bytes = work()
    return Coded(decode=decode, size_bytes=size_bytes, cpu_s=time.process_time() - start_s)


def points_decoder(
    window: Window, points_ned_m: Array, hyper: Hyperparameters, fragment: NDArray[np.intp]
) -> Decode:
    """Return a decoder from the points of the fragments that arrived, inside their hull."""

    def decode(lost: set[int]) -> Array:
        kept = points_ned_m[~np.isin(fragment, list(lost))]
        depth_m = np.full(len(window.grid_m), np.nan)
        if len(kept) >= 3:
            depth_m, _ = point_decoder(kept, hyper).predict(window.grid_m)
            depth_m[Outline.of(kept[:, :2]).outside(window.grid_m)] = np.nan
        return depth_m

    return decode


def fitc(window: Window, kernel: Kernel = Kernel.SQUARED_EXPONENTIAL, noise: bool = False) -> Coded:
    """Return FITC with 150 points; noise re-applies sigma^2 at the leader (Eq. 5)."""
    settings = CompressionSettings(
        method="fitc", iterations=REFERENCE_EVALUATIONS, kernel=kernel.name.lower()
    )

    def work() -> tuple[Decode, int]:
        frame = fit_frame(coarsened(window.bins, settings.fit_cell_m), settings.max_fit_rows)
        steps = fitc_steps(frame, 150, settings, dealt_evenly(FRAMES, settings))
        best = [step for step in steps if step is not None][-1]
        hyper = Hyperparameters(
            b_per_m=best.b_per_m,
            c_m2=best.c_m2,
            sigma2_m2=best.sigma2_m2,
            mean_depth_m=frame.mean_depth_m,
            kernel=best.kernel,
            noise_applied=noise,
        )
        points = np.column_stack(
            [best.position_m + frame.origin_m, best.depth_m + frame.mean_depth_m]
        )
        return points_decoder(window, points, hyper, best.fragment), 1816

    return timed(work)


def farthest_points(window: Window, count: int = 150) -> Coded:
    """Return cells chosen farthest from each other, a GP whose length scale fits them."""

    def work() -> tuple[Decode, int]:
        cells = coarsened(window.bins, 2.0)
        position_m = np.column_stack([cells.north_m, cells.east_m])
        chosen = [int(np.argmin(position_m.sum(axis=1)))]
        nearest_m = np.full(len(position_m), np.inf)
        for _ in range(count - 1):
            nearest_m = np.minimum(
                nearest_m, np.linalg.norm(position_m - position_m[chosen[-1]], axis=1)
            )
            chosen.append(int(np.argmax(nearest_m)))
        points = np.column_stack([position_m[chosen], cells.depth_m[chosen]])
        best: tuple[float, Hyperparameters | None] = (np.inf, None)
        for length_m in (6.0, 9.0, 14.0, 20.0, 30.0):
            hyper = Hyperparameters(
                b_per_m=1.0 / length_m,
                c_m2=1.0,
                sigma2_m2=0.0,
                mean_depth_m=float(cells.depth_m.mean()),
                kernel=Kernel.MATERN32,
            )
            hyper, rmse_m = calibrated(points, hyper, cells)
            best = min(best, (rmse_m, hyper), key=lambda pair: pair[0])
        assert best[1] is not None
        fragment = dealt_fragments(points[:, :2], FRAMES)
        return points_decoder(window, points, best[1], fragment), 1816

    return timed(work)


def octree(window: Window) -> Coded:
    """Return the paper's baseline: 5 bytes a leaf, and nothing once any frame is lost."""

    def work() -> tuple[Decode, int]:
        chunks = octree_submap(window.bins)
        data = b"".join(chunks)
        head = np.frombuffer(data[:12], dtype="<f4").astype(np.float64)
        words = np.zeros((leaf_count(chunks), 8), dtype=np.uint8)
        words[:, :5] = np.frombuffer(data[16:], dtype=np.uint8).reshape(-1, 5)
        leaf = words.view("<u8").ravel()
        row, column, level, steps = (
            ((leaf >> shift) & mask).astype(np.float64)
            for shift, mask in ((0, 255), (8, 255), (16, 7), (19, (1 << 21) - 1))
        )
        index = (window.grid_m - head[:2]) // 2.0

        def decode(lost: set[int]) -> Array:
            depth_m = np.full(len(window.grid_m), np.nan)
            if lost & set(range(len(chunks))):
                return depth_m
            for r, c, size, step in zip(row, column, 2.0**level, steps, strict=True):
                inside = (index[:, 0] // size == r // size) & (index[:, 1] // size == c // size)
                depth_m[inside] = head[2] + 0.001 * step
            return depth_m

        return decode, len(data)

    return timed(work)


def cosine(window: Window) -> Coded:
    """Return a fixed-rate DCT of the filled grid: its lowest coefficients, 8 bits each."""

    def work() -> tuple[Decode, int]:
        low = window.grid_m.min(axis=0)
        shape = tuple((window.grid_m.max(axis=0) - low).astype(int) + 1)
        axes = [low[i] + np.arange(shape[i]) for i in range(2)]
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        cells = np.column_stack([window.bins.north_m, window.bins.east_m])
        filled = griddata(cells, window.bins.depth_m, nodes)
        gaps = np.isnan(filled)
        filled[gaps] = griddata(cells, window.bins.depth_m, nodes[gaps], method="nearest")
        mean_m = float(filled.mean())
        full = dctn(filled.reshape(shape) - mean_m, norm="ortho")
        radius = np.hypot(*np.meshgrid(*(np.arange(n) / n for n in shape), indexing="ij"))
        order = np.argsort(radius.ravel(), kind="stable")[:DCT_BYTES]
        kept = full.ravel()[order]
        blocks = np.array_split(np.arange(DCT_BYTES), 60)
        for block in blocks:
            step = max(float(np.abs(kept[block]).max()), 1e-9) / 127.0
            kept[block] = step * np.round(kept[block] / step)

        def decode(lost: set[int]) -> Array:
            values = np.where(np.isin(np.arange(DCT_BYTES) % FRAMES, list(lost)), 0.0, kept)
            coefficients = np.zeros(full.size)
            coefficients[order] = values
            surface_m = idctn(coefficients.reshape(shape), norm="ortho") + mean_m
            where = (window.grid_m - low).T
            return np.asarray(map_coordinates(surface_m, where, order=1, mode="nearest"))

        return decode, DCT_BYTES + 124

    return timed(work)
