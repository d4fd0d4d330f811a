"""Relief below the terrain's cell: a seeded continuation of the terrain's own spectrum."""

import numpy as np
from scipy import ndimage

from firmware.geometry import Array
from host_tools.simulator.seabed import Seabed

FINEST_CELL_M = 0.5
# Steeper than this a fitted spectrum holds no small relief; flatter than this it is noise.
STEEPEST, FLATTEST = -6.0, -2.0


def roughen(seabed: Seabed, rng: np.random.Generator) -> Seabed:
    """Return the seabed on a finer grid with relief added between the terrain's cells.

    The radial power spectrum of the terrain is fitted by a power law over the octaves that its
    grid resolves well; a random field with that law and only wave numbers beyond the grid's
    Nyquist is added. A grid as fine as 1 m is returned as it is: nothing below it is resolved by
    a sonar at 40 m.
    """
    cell_m = max(seabed.cell_north_m, seabed.cell_east_m)
    factor = int(min(5, cell_m // FINEST_CELL_M))
    if cell_m <= 2.0 * FINEST_CELL_M or factor < 2:
        return seabed
    depth_m = seabed.depth_m.astype(np.float64)
    exponent, level = _power_law(depth_m, seabed.cell_north_m, seabed.cell_east_m)
    fine_n, fine_e = seabed.cell_north_m / factor, seabed.cell_east_m / factor
    rows, columns = ((size - 1) * factor + 1 for size in depth_m.shape)
    north_m = seabed.north0_m + fine_n * np.arange(rows)
    east_m = seabed.east0_m + fine_e * np.arange(columns)
    base_m = seabed.depth_at(*np.meshgrid(north_m, east_m, indexing="ij"))
    relief_m = _field(rows, columns, fine_n, fine_e, 0.5 / cell_m, exponent, level, rng)
    return Seabed(base_m + relief_m, seabed.north0_m, seabed.east0_m, fine_n, fine_e)


def _power_law(depth_m: Array, cell_n: float, cell_e: float) -> tuple[float, float]:
    """Return exponent and level of S(k) = level k**exponent, two-sided, in m2 per (1/m)2."""
    known = np.isfinite(depth_m)
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    filled = depth_m[tuple(nearest)]
    window = np.outer(np.hanning(filled.shape[0]), np.hanning(filled.shape[1]))
    residual = ndimage.gaussian_filter(filled, 20.0) - filled
    power = np.abs(np.fft.fft2(residual * window)) ** 2 * cell_n * cell_e / np.sum(window**2)
    wave = np.hypot(
        np.fft.fftfreq(filled.shape[0], cell_n)[:, None],
        np.fft.fftfreq(filled.shape[1], cell_e)[None, :],
    )
    nyquist = 0.5 / max(cell_n, cell_e)
    band = (wave > nyquist / 4.0) & (wave < nyquist / 1.25) & (power > 0.0)
    if np.count_nonzero(band) < 8:
        return STEEPEST, 0.0
    exponent, _ = np.polyfit(np.log(wave[band]), np.log(power[band]), 1)
    exponent = float(np.clip(exponent, STEEPEST, FLATTEST))
    level = float(np.mean(power[band] / wave[band] ** exponent))
    return exponent, level


def _field(
    rows: int,
    columns: int,
    cell_n: float,
    cell_e: float,
    cut_on: float,
    exponent: float,
    level: float,
    rng: np.random.Generator,
) -> Array:
    """Return a random field (rows, columns) in metres with the law's power beyond cut_on (1/m)."""
    noise = np.fft.rfft2(rng.standard_normal((rows, columns)))
    wave = np.hypot(
        np.fft.fftfreq(rows, cell_n)[:, None], np.fft.rfftfreq(columns, cell_e)[None, :]
    )
    beyond = np.maximum(wave, cut_on) ** exponent
    density = np.where(wave > cut_on, level * beyond, 0.0)
    field: Array = np.fft.irfft2(noise * np.sqrt(density / (cell_n * cell_e)), s=(rows, columns))
    return field
