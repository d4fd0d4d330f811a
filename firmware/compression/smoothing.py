"""Cells freed of noise before points are fitted to them.

A few hundred points fitted to noisy cells follow the noise where they can. Fitted to the field's
posterior mean (`firmware.compression.field`) they do not, and far fewer cells are needed.
"""

import dataclasses
from collections.abc import Generator

import numpy as np

from firmware.compression.binning import coarsened
from firmware.compression.field import fitted_field_steps, fitted_trend
from firmware.compression.lattice_frame import lattice_frame
from firmware.submaps import BinnedSoundings

_CHUNK = 2048  # cells read at once: 1 MB of interpolation


def smoothed_steps(bins: BinnedSoundings, step_m: float) -> Generator[None, None, BinnedSoundings]:
    """Estimate the field on nodes every step_m; the value is the cells with its depths.

    Cells spread so far that their lattice would be coarser than that stay as measured, and so do
    those so few that the field between them is less known than they are.
    """
    cells = coarsened(bins, step_m)
    frame = lattice_frame(cells, step_m)
    if frame.step_m > 1.5 * step_m:
        return bins
    field = yield from fitted_field_steps(cells, frame, fitted_trend(cells, frame))
    if field.unknown_m2 > field.noise_m2:
        return bins
    depth_m = np.empty_like(bins.depth_m)
    for start in range(0, depth_m.size, _CHUNK):
        part = slice(start, start + _CHUNK)
        depth_m[part] = field.depth_m(np.column_stack([bins.north_m[part], bins.east_m[part]]))
        yield
    return dataclasses.replace(bins, depth_m=depth_m)
