"""How much of a sub-map's relief stands above the noise: the information a match can carry.

On a seabed with spectrum S and noise with spectrum W, a match at the right place is told from
unrelated seabed by half the sum of log(S / W) over the waves whose S exceeds W. Position errors
within a sub-map act on a wave of number k like noise of (sigma k)^2 S.
"""

from dataclasses import dataclass

import numpy as np
from scipy import fft, ndimage

from firmware.geometry import Array
from firmware.leader.screening import Layer

_BAND = 3  # waves averaged each way: enough that noise alone never looks like relief
_BAND_RAD = 0.2  # a cell, of waves that count as equally long
_RECTIFIED = 0.4  # of the noise: what is left of it where no power is taken for negative, and more
_SMOOTHINGS = np.array([0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0])
_LEAST_ENERGY = 16.0  # cells under the taper; fewer have no spectrum


@dataclass(frozen=True, slots=True, kw_only=True)
class Spectrum:
    """Power of the relief alone, m^2 per cell, at wave numbers in rad/m; both (R, C / 2 + 1).

    total_cells is R C: the mean of the power over all waves is the variance of the relief.
    """

    power_m2: Array
    wave: Array
    total_cells: int
    cell_m: float

    def mean(self, values: Array) -> float:
        """Return the mean over all waves, of which half are stored."""
        return float((2.0 * values.sum() - values[:, 0].sum()) / self.total_cells)


@dataclass(frozen=True, slots=True, kw_only=True)
class WaveNoise:
    """Noise of a difference: white and correlated variance per cell, and position errors."""

    white_m2: float
    shared_m2: float
    correlation_m: float
    position_sigma_m: float


def spectrum(layer: Layer) -> Spectrum:
    """Return the spectrum of the tapered depths less their plane and the soundings' noise."""
    flat = np.where(layer.known > 0, layer.grid.depth_m - layer.plane_m, 0.0)
    rows, cols = flat.shape
    taper = np.outer(np.hanning(rows + 2)[1:-1], np.hanning(cols + 2)[1:-1]) * layer.known
    energy = float(np.sum(taper**2))
    cell_m = layer.grid.cell_m
    wave = 2.0 * np.pi * np.hypot(fft.fftfreq(rows, cell_m)[:, None], fft.rfftfreq(cols, cell_m))
    power = np.zeros(wave.shape)
    if energy >= _LEAST_ENERGY:
        power = np.abs(fft.rfft2(flat * taper)) ** 2 / energy
        power = ndimage.uniform_filter(power, _BAND, mode="nearest")
        if not layer.grid.reconstructed:
            power = np.maximum(power - layer.map_m2.sum() / layer.known.sum(), 0.0)
        power[0, 0] = 0.0
    return Spectrum(power_m2=power, wave=wave, total_cells=rows * cols, cell_m=cell_m)


def information_per_cell(relief: Spectrum, noise: WaveNoise, longest_m: float = np.inf) -> float:
    """Return the log evidence per cell that the relief offers to a perfect match.

    Waves longer than `longest_m` are left out.
    """
    length_m, power = noise.correlation_m, relief.power_m2
    area = 2.0 * np.pi * (length_m / relief.cell_m) ** 2
    total = noise.white_m2 + noise.shared_m2 * area * np.exp(-0.5 * (relief.wave * length_m) ** 2)
    total = total + (noise.position_sigma_m * relief.wave) ** 2 * power
    gain = 0.5 * np.log(np.maximum(power / np.maximum(total, 1e-12), 1.0))
    return relief.mean(np.where(relief.wave > 2.0 * np.pi / longest_m, gain, 0.0))


def fine_relief_m2(relief: Spectrum, shortest_m: float) -> float:
    """Return the variance of the relief in waves shorter than `shortest_m`."""
    return relief.mean(np.where(relief.wave > 2.0 * np.pi / shortest_m, relief.power_m2, 0.0))


def smoothing_cells(relief: Spectrum, noise_m2: float) -> float:
    """Return the sigma of a Gaussian, in cells, by which slopes tell most of a shift.

    Of slopes with power P of relief and W of their own noise at wave number k a filter h leaves
    (sum k^2 h P)^2 / sum k^2 h^2 (P + W), where what they are weighed with is noisy and white.
    """
    width = _BAND_RAD / relief.cell_m
    band = np.round(relief.wave / width).astype(np.intp).ravel()
    twice = np.full(relief.wave.shape, 2.0)  # of all waves half are stored
    twice[:, 0] = 1.0
    waves = np.bincount(band, twice.ravel())
    power_m2 = np.bincount(band, (twice * relief.power_m2).ravel()) / np.maximum(waves, 1.0)
    power_m2[power_m2 < _RECTIFIED * noise_m2] = 0.0
    wave = width * np.arange(waves.size)
    kept = np.exp(-0.5 * (_SMOOTHINGS[:, None] * relief.cell_m * wave) ** 2)
    told = (kept @ (waves * wave**2 * power_m2)) ** 2
    told /= np.maximum(kept**2 @ (waves * wave**2 * (power_m2 + noise_m2)), 1e-30)
    return float(_SMOOTHINGS[np.argmax(told)])
