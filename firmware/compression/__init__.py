"""Forty seconds of soundings in ten frames: binning, the fit, its packets."""

from collections.abc import Iterator

from firmware.compression.packing import packets_from
from firmware.compression.points import compress_point_steps
from firmware.compression.results import CompressedPoints, FitReport, fragment_points
from firmware.compression.settings import CompressionSettings
from firmware.submaps import BinnedSoundings

Compressed = CompressedPoints

__all__ = [
    "Compressed",
    "CompressedPoints",
    "FitReport",
    "compress",
    "compress_steps",
    "fragment_points",
    "packets_from",
]


def compress_steps(
    bins: BinnedSoundings, settings: CompressionSettings | None = None
) -> Iterator[Compressed]:
    """Yield the best compressed sub-map so far after each small step; the last is the result."""
    return compress_point_steps(bins, settings or CompressionSettings())


def compress(bins: BinnedSoundings, settings: CompressionSettings | None = None) -> Compressed:
    """Return the compressed sub-map, fitted to the end of its budget."""
    *_, best = compress_steps(bins, settings)
    return best
