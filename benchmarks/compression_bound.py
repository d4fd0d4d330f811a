"""The least error that so many bits allow: rate and distortion of a field seen through noise.

The sea floor is not the coder's source; soundings of it are. With S the variance of a cosine
coefficient and n that of a cell's noise, they tell S^2 / (S + n) of it and leave S n / (S + n)
unknown whatever is sent; only what they tell is coded, by reverse water-filling (Dobrushin and
Tsybakov, 1962). S comes from the sub-map itself: the mean power of the estimate by rings of
frequency, freed of the estimator's gain and of noise; beyond the last ring that stands out of the
noise by a power law, to twice the lattice's highest frequency, as true depths are compared at
points and not as means of cells. (The spectrum the estimator ends with will not do: below the noise
its iteration has not settled, and ten thousand coefficients of a tenth of n made a bound above what
was achieved.)

This is the bound of a stationary Gaussian field, the hardest of that spectrum: relief with boulders
in one corner or with crests in phase may be, and is, rebuilt with less.
"""

import numpy as np

from benchmarks.compression_windows import Window
from firmware.compression.expected import run
from firmware.compression.field import Field, fitted_field_steps, fitted_trend, wavenumbers
from firmware.compression.lattice_frame import lattice_frame
from firmware.geometry import Array

_RINGS = 14
_CLEAR = 0.3  # of the noise: a ring below it says little of itself
_TAIL_RINGS = 4  # that give the power law
_FLATTEST = -2.0  # of it: a field whose variance is finite


def bounds_m2(window: Window) -> tuple[Array, Array]:
    """Return log2 of the bits and the least mean square error, m^2, that they allow."""
    frame = lattice_frame(window.bins, 1.0)
    field = run(fitted_field_steps(window.bins, frame, fitted_trend(window.bins, frame)))
    nodes = frame.rows * frame.columns
    share = len(window.grid_m) / nodes  # cells of 1 m2; only these are counted
    noise_m2 = len(window.grid_m) / float(np.sum(1.0 / window.bins.variance_m2))
    spectrum = _extended_spectrum(field, share, noise_m2)
    known = spectrum**2 / (spectrum + noise_m2)
    unknown = float((spectrum - known).sum()) / nodes
    levels = np.geomspace(float(known.max()) * 0.5, 1e-9, 80)
    bits = [0.5 * share * np.log2(np.maximum(known / level, 1.0)).sum() for level in levels]
    coding = np.array([np.minimum(known, level).sum() / nodes for level in levels])
    return np.log2(np.maximum(bits, 1e-9)), unknown + coding


def _extended_spectrum(field: Field, share: float, noise_m2: float) -> Array:
    """Return the variance of the coefficients (2 rows, 2 columns) of a lattice twice as fine.

    They are in the scale of the field's own lattice.
    """
    prior, radius, shape = field.spectrum_m2, wavenumbers(field.frame), field.frame.shape
    edges = np.geomspace(radius[radius > 0].min(), radius.max() * 1.001, _RINGS)
    ring = np.digitize(radius, edges).ravel()
    count = np.maximum(np.bincount(ring, minlength=_RINGS + 1), 1)

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(ring, values.ravel(), _RINGS + 1) / count)

    gain = prior / (prior + noise_m2)
    level, at = mean((field.coefficients_m / gain) ** 2) / share - noise_m2, mean(radius)
    clear = np.flatnonzero((level > _CLEAR * noise_m2) & (at > 0.0))
    log_at, log_level = np.log(at[clear]), np.log(level[clear])
    fitted = np.polyfit(log_at[-_TAIL_RINGS:], log_level[-_TAIL_RINGS:], 1)
    steepness = min(float(fitted[0]), _FLATTEST)
    along, across = (np.arange(2 * n) / (2 * n * field.frame.step_m) for n in shape)
    finer = np.hypot(along[:, None], across[None, :])
    log_finer = np.log(np.maximum(finer, at[clear[0]]))
    beyond = np.maximum(log_finer - log_at[-1], 0.0)
    spectrum = np.exp(np.interp(log_finer, log_at, log_level) + steepness * beyond)
    spectrum[: shape[0], : shape[1]] *= prior / mean(prior)[ring].reshape(shape)
    return np.asarray(spectrum)
