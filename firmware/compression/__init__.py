"""Forty seconds of soundings in ten frames: binning, the fit, its packets."""

import dataclasses
from collections.abc import Iterator
from typing import overload

from firmware.compression.choice import chosen_frames
from firmware.compression.dense import dense_code_steps
from firmware.compression.lattice import lattice_code_steps
from firmware.compression.packing import filled_bytes, packets_from
from firmware.compression.points import compress_point_steps, report_of, unfitted, usable
from firmware.compression.results import (
    CompressedCode,
    CompressedPoints,
    FitReport,
    fragment_points,
)
from firmware.compression.settings import CompressionSettings
from firmware.compression.steps import Steps, Watched
from firmware.compression.track_code import USUAL_TRACK_BYTES
from firmware.submaps import BinnedSoundings
from protocol.lattice import PROTECTION_BYTES
from protocol.packets import Profile

Compressed = CompressedPoints | CompressedCode

__all__ = [
    "Compressed",
    "CompressedCode",
    "CompressedPoints",
    "FitReport",
    "compress",
    "compress_steps",
    "fragment_points",
    "packets_from",
]


def compress_steps(
    bins: BinnedSoundings,
    settings: CompressionSettings | None = None,
    profile: str = "paper",
) -> Iterator[Compressed]:
    """Yield the best compressed sub-map so far after each small step; the last is the result.

    The first comes at once, as cells in packets of the paper's profile, so that there is always
    something to send; profile is `paper`, `dense`, `lattice`, or `auto`: `lattice` in as few of
    the settings' frames as do about as well (`firmware.compression.choice`).
    """
    settings = settings or CompressionSettings()
    if profile in {"lattice", "auto"}:
        return _lattice_steps(bins, settings, sparing=profile == "auto")
    if profile == "dense":
        return _dense_steps(bins, settings)
    return compress_point_steps(bins, settings)


@overload
def compress(
    bins: BinnedSoundings, settings: CompressionSettings | None = None
) -> CompressedPoints: ...


@overload
def compress(
    bins: BinnedSoundings, settings: CompressionSettings | None, profile: str
) -> Compressed: ...


def compress(
    bins: BinnedSoundings,
    settings: CompressionSettings | None = None,
    profile: str = "paper",
) -> Compressed:
    """Return the compressed sub-map, fitted to the end of its budget."""
    *_, best = compress_steps(bins, settings, profile)
    return best


def _lattice_steps(
    bins: BinnedSoundings, settings: CompressionSettings, *, sparing: bool
) -> Iterator[Compressed]:
    bins = usable(bins)
    first = unfitted(bins, settings)
    profile = Profile.SUBMAP_LATTICE_SMALL if settings.small_frames else Profile.SUBMAP_LATTICE
    size = filled_bytes(profile, settings)
    fit = Steps(lattice_code_steps(bins, settings.lattice_step_m, settings.frames * size))
    for _ in fit:
        yield first
    if sparing:
        columns = size - PROTECTION_BYTES - USUAL_TRACK_BYTES
        frames = chosen_frames(fit.value, columns, settings.frames, settings)
        settings = dataclasses.replace(settings, frames=frames)
    yield CompressedCode(
        profile=profile,
        fragment_count=settings.frames,
        code=fit.value,
        settings=settings,
        report=FitReport(evaluations=1, ended="converged"),
    )


def _dense_steps(bins: BinnedSoundings, settings: CompressionSettings) -> Iterator[Compressed]:
    bins = usable(bins)
    best: Compressed = unfitted(bins, settings)
    yield best
    fit = Watched(dense_code_steps(bins, settings, filled_bytes(Profile.SUBMAP_DENSE, settings)))
    for step in fit:
        if step is not None:
            code, fitted = step
            best = CompressedCode(
                profile=Profile.SUBMAP_DENSE,
                fragment_count=settings.frames,
                code=code,
                settings=settings,
                report=report_of(fitted),
            )
        yield best
    yield dataclasses.replace(best, report=dataclasses.replace(best.report, ended=fit.ended))
