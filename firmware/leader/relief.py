"""How much of a sub-map's relief stands above the noise: the information a match can carry.

On a seabed with spectrum S and noise with spectrum W, a match at the right place is told from
unrelated seabed by half the sum of log(S / W) over the waves whose S exceeds W. Position errors
within a sub-map act on a wave of number k like noise of (sigma k)^2 S.
"""

import numpy as np
from scipy import fft, ndimage

from firmware.geometry import Array
from firmware.leader.screening import Layer

_BAND = 3  # waves averaged each way: enough that noise alone never looks like relief


def information_per_cell(
    layer: Layer,
    noise_m2: float,
    shared_m2: float,
    correlation_m: float,
    position_sigma_m: float,
) -> float:
    """Return the log evidence per cell that the layer's relief offers to a perfect match.

    noise_m2 is the variance of a cell's difference, of which shared_m2 is correlated over
    correlation_m. The spectrum is that of the tapered depths less their own noise.
    """
    cell_m = layer.grid.cell_m
    flat = _detrended(layer)
    rows, cols = flat.shape
    taper = np.outer(np.hanning(rows + 2)[1:-1], np.hanning(cols + 2)[1:-1]) * layer.known
    energy = float(np.sum(taper**2))
    if energy < 16.0:
        return 0.0
    power = np.abs(fft.rfft2(flat * taper)) ** 2 / energy
    power = ndimage.uniform_filter(power, _BAND, mode="nearest")
    own_m2 = float(np.nanmean(layer.grid.variance_m2))
    relief = np.maximum(power - own_m2, 0.0)
    wave = 2.0 * np.pi * np.hypot(fft.fftfreq(rows, cell_m)[:, None], fft.rfftfreq(cols, cell_m))
    area = 2.0 * np.pi * (correlation_m / cell_m) ** 2
    noise = noise_m2 - shared_m2 + shared_m2 * area * np.exp(-0.5 * (wave * correlation_m) ** 2)
    noise = noise + (position_sigma_m * wave) ** 2 * relief
    gain = 0.5 * np.log(np.maximum(relief / np.maximum(noise, 1e-12), 1.0))
    gain[0, 0] = 0.0
    total = 2.0 * gain.sum() - gain[:, 0].sum()  # half of the plane is stored
    return float(total / (rows * cols))


def _detrended(layer: Layer) -> Array:
    """Return the depths less their plane, zero where unknown."""
    i, j = np.nonzero(layer.known > 0)
    depth = layer.grid.depth_m[i, j]
    design = np.column_stack([np.ones(i.size), i - i.mean(), j - j.mean()])
    flat = np.zeros(layer.known.shape)
    normal = design.T @ design + 1e-9 * np.eye(3)
    flat[i, j] = depth - design @ np.linalg.solve(normal, design.T @ depth)
    return flat
