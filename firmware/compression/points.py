"""From cells to the ten packets of the paper's profile: fit, calibrate, deal over fragments."""

import dataclasses
from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

from firmware.compression.binning import coarsened
from firmware.compression.calibration import calibrated
from firmware.compression.fit import (
    FitFrame,
    FittedPoints,
    dealt_evenly,
    fit_frame,
    fit_steps,
    moved_steps,
)
from firmware.compression.fitc_fit import fitc_steps
from firmware.compression.initial import hilbert_order
from firmware.compression.kernels import Hyperparameters, Kernel
from firmware.compression.mantissa import fitting_steps, flagged, with_parity, without_parity
from firmware.compression.results import (
    PAPER_FRAGMENTS,
    PAPER_POINTS,
    CompressedPoints,
    FitReport,
)
from firmware.compression.settings import CompressionSettings
from firmware.compression.smoothing import smoothed_steps
from firmware.compression.steps import Steps, Watched
from firmware.geometry import Array
from firmware.submaps import BinnedSoundings
from protocol.errors import EstimationError
from protocol.packets import DEEPEST_M, FARTHEST_M, HIGHEST_M, Profile

_PACK_EVERY = 50  # evaluations: packing costs as much as five
_FEWEST_CELLS = 3  # a hull needs a triangle


def compress_point_steps(
    bins: BinnedSoundings, settings: CompressionSettings
) -> Generator[CompressedPoints, None, None]:
    """Yield the best compressed sub-map so far, again and again, in steps of a few milliseconds.

    The first comes at once: cells as they are. Each later one is at least as good, by expected
    error on the cells; the last is the result.

    Raises
    ------
    EstimationError
        For fewer than three usable cells, of which no map can be made.
    """
    bins = usable(bins)
    best = unfitted(bins, settings)
    yield best
    expected = settings.method != "fitc"
    targets = bins
    if expected:
        smoothing = Steps(smoothed_steps(bins, settings.fit_cell_m))
        for _ in smoothing:
            yield best
        targets = smoothing.value
        yield best
    cells = coarsened(targets, settings.fit_cell_m)
    count = min(PAPER_FRAGMENTS * PAPER_POINTS, cells.depth_m.size)
    fine = fit_frame(cells, settings.max_fit_rows)
    frame = fine
    if expected:
        coarse = coarsened(targets, settings.placing_cell_m)
        frame = fit_frame(coarse, settings.max_fit_rows, fine)
    steps = fit_steps if expected else fitc_steps
    fit = Watched(steps(frame, count, settings, dealt_evenly(PAPER_FRAGMENTS, settings)))
    waiting: FittedPoints | None = None
    packed_at = 0
    for step in fit:
        waiting = step or waiting
        if step is not None and (not packed_at or step.evaluations >= packed_at + _PACK_EVERY):
            packed_at, waiting = step.evaluations, None
            best = yield from _pack_steps(step, fine, bins, best, settings)
        yield best
    if waiting is not None:
        best = yield from _pack_steps(waiting, fine, bins, best, settings)
    yield dataclasses.replace(best, report=dataclasses.replace(best.report, ended=fit.ended))


def usable(bins: BinnedSoundings) -> BinnedSoundings:
    """Return the cells that a packet can carry: finite and within any survey's bounds."""
    good = np.isfinite(bins.north_m) & np.isfinite(bins.east_m) & np.isfinite(bins.depth_m)
    good &= np.isfinite(bins.variance_m2) & (bins.count > 0)
    with np.errstate(invalid="ignore"):
        good &= (np.abs(bins.north_m) <= FARTHEST_M) & (np.abs(bins.east_m) <= FARTHEST_M)
        good &= (bins.depth_m >= HIGHEST_M) & (bins.depth_m <= DEEPEST_M)
    if good.all():
        return bins
    return BinnedSoundings(
        cell_m=bins.cell_m,
        north_m=bins.north_m[good],
        east_m=bins.east_m[good],
        depth_m=bins.depth_m[good],
        variance_m2=bins.variance_m2[good],
        count=bins.count[good],
        time_s=bins.time_s[good],
    )


def unfitted(bins: BinnedSoundings, settings: CompressionSettings) -> CompressedPoints:
    """Return cells along a Hilbert curve as they are: what can be sent before any fit.

    Raises
    ------
    EstimationError
        For fewer than three cells, of which no map can be made.
    """
    if bins.depth_m.size < _FEWEST_CELLS:
        raise EstimationError(
            f"{bins.depth_m.size} usable cells of soundings; a sub-map needs {_FEWEST_CELLS}"
        )
    cells = coarsened(bins, settings.fit_cell_m)
    count = min(PAPER_FRAGMENTS * PAPER_POINTS, cells.depth_m.size)
    position_m = np.column_stack([cells.north_m, cells.east_m])
    order = hilbert_order(position_m)
    chosen = order[np.linspace(0, len(order) - 1, count).round().astype(int)]
    span_m = np.maximum(np.ptp(position_m, axis=0), 1.0)
    hyper = Hyperparameters(
        b_per_m=float(0.5 / np.sqrt(span_m[0] * span_m[1] / count)),
        c_m2=max(float(cells.depth_m.var()), 1e-4),
        sigma2_m2=max(float(np.median(cells.variance_m2 * cells.count)), 1e-6),
        mean_depth_m=float(cells.depth_m.mean()),
        kernel=Kernel.MATERN32,
    )
    points = np.column_stack([position_m[chosen], cells.depth_m[chosen]])
    fragment = np.arange(count) % PAPER_FRAGMENTS
    return CompressedPoints(
        profile=Profile.SUBMAP_PAPER,
        fragment_count=PAPER_FRAGMENTS,
        points_ned_m=dealt(points, fragment, PAPER_FRAGMENTS, PAPER_POINTS),
        hyperparameters=np.append(hyper.to_wire()[:3], flagged(hyper.mean_depth_m, None)),
        report=FitReport(),
    )


def _pack_steps(
    fitted: FittedPoints,
    frame: FitFrame,
    bins: BinnedSoundings,
    before: CompressedPoints,
    settings: CompressionSettings,
) -> Generator[CompressedPoints, None, CompressedPoints]:
    """Round, calibrate and deal a fit, yielding what was best before; the value is the new best."""
    points = _absolute(fitted, frame)
    steps = None
    if settings.method != "fitc" and settings.parity and len(points) == len(before.points_ned_m):
        steps = fitting_steps(points, frame.mean_depth_m)
    mean_depth_m = float(flagged(frame.mean_depth_m, steps))
    if steps is not None:
        rounded_m = without_parity(points, steps)[:, :2] - frame.origin_m
        moving = Steps(moved_steps(fitted, rounded_m, frame))
        for _ in moving:
            yield before
        fitted = moving.value
        yield before
        points = without_parity(_absolute(fitted, frame), steps)
    hyper = Hyperparameters(
        b_per_m=fitted.b_per_m,
        c_m2=fitted.c_m2,
        sigma2_m2=fitted.sigma2_m2,
        mean_depth_m=mean_depth_m,
        kernel=fitted.kernel,
        noise_applied=settings.noise_applied,
    )
    hyper, _ = calibrated(points, hyper, bins)
    yield before
    wired = dealt(points, fitted.fragment, PAPER_FRAGMENTS, PAPER_POINTS)
    if steps is not None:
        wired = with_parity(wired.astype(np.float64), steps)
    hyperparameters = hyper.to_wire()
    hyperparameters[3] = flagged(frame.mean_depth_m, steps)
    return CompressedPoints(
        profile=Profile.SUBMAP_PAPER,
        fragment_count=PAPER_FRAGMENTS,
        points_ned_m=wired,
        hyperparameters=hyperparameters,
        report=report_of(fitted),
    )


def report_of(fitted: FittedPoints) -> FitReport:
    """Return how the fit stands while it goes on."""
    return FitReport(
        evaluations=fitted.evaluations,
        failed_factorisations=fitted.failed_factorisations,
        ended="running",
    )


def _absolute(fitted: FittedPoints, frame: FitFrame) -> Array:
    return np.column_stack(
        [fitted.position_m + frame.origin_m, fitted.depth_m + frame.mean_depth_m]
    )


def dealt(
    points_ned_m: Array, fragment: NDArray[np.intp], fragments: int, each: int
) -> NDArray[np.float32]:
    """Return the points (F x each, 3) in the order of their fragments, NaN where one is short."""
    out = np.full((fragments, each, 3), np.nan, dtype=np.float32)
    for index in range(fragments):
        mine = points_ned_m[fragment == index][:each]
        out[index, : len(mine)] = mine
    return out.reshape(-1, 3)
