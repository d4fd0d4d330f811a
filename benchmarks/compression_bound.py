"""The least error that so many bits allow: rate and distortion of a field seen through noise.

The sea floor is not the coder's source; soundings of it are. With S the variance of a cosine
coefficient and n that of the soundings' noise in it, they tell S^2 / (S + n) of it and leave
S n / (S + n) unknown whatever is sent; only what they tell is coded, by reverse water-filling
(Dobrushin and Tsybakov, 1962).

S is fitted to the true surface on nodes every half metre, and n to the law that made the noise. A
spectrum fitted to the soundings cannot give a bound: where the field lies below the noise it is
a guess, and a guess above the truth, over ten thousand coefficients, is a bound above what was
achieved. The logarithm of the squared coefficients is smoothed, as that of a steep spectrum is
straight and its mean over a ring is not its middle.

What is assumed: a Gaussian field, stationary over the window and sounded evenly; of all fields of
that spectrum it is the hardest. Relief with boulders in one corner is easier, and so is one window
of a field of which it holds few waves: some hundred coefficients that matter scatter by half a
decibel. A coder may then lie below this bound. (Tiles with spectra of their own gave a higher one.)
"""

import numpy as np
from scipy.fft import dctn
from scipy.ndimage import gaussian_filter

from benchmarks.compression_windows import Window, noise_variance_m2
from firmware.compression.field import fitted_trend
from firmware.compression.lattice_frame import lattice_frame
from firmware.geometry import Array

_STEP_M = 0.5
_SIGMA = 2.0  # coefficients that the fitted spectrum is smooth over
_LOG_MEAN = 1.2704  # E ln of a squared Gaussian lies so far below the ln of its variance
_LOWEST = 1e-12


def bounds_m2(window: Window) -> tuple[Array, Array]:
    """Return log2 of the bits and the least mean square error, m^2, that they allow."""
    frame = lattice_frame(window.bins, _STEP_M)
    row, column = np.indices(frame.shape).reshape(2, -1)
    nodes = np.column_stack([row, column]).astype(np.float64)
    trend_m = fitted_trend(window.bins, frame).depth_m(nodes, frame)
    relief_m = (window.depth_of(frame.positions_of(nodes)) - trend_m).reshape(frame.shape)
    share = len(window.grid_m) / (frame.step_m**2 * row.size)  # of the frame that is sounded
    noise_m2 = _noise_of_nodes_m2(window, frame.step_m)
    spectrum = _fitted_spectrum(relief_m)
    known = spectrum**2 / (spectrum + noise_m2)
    unknown_m2 = float(np.mean(spectrum - known))
    levels = np.geomspace(float(known.max()) * 0.5, 1e-12, 120)
    bits = np.array([0.5 * share * np.log2(np.maximum(known / at, 1.0)).sum() for at in levels])
    coding_m2 = np.array([np.minimum(known, at).mean() for at in levels])
    return np.log2(np.maximum(bits, 1e-9)), unknown_m2 + coding_m2


def _noise_of_nodes_m2(window: Window, step_m: float) -> float:
    """Return the noise of a node if all that the soundings tell were spread evenly over nodes."""
    told = float(np.sum(1.0 / noise_variance_m2(window.soundings_ned_m)))
    return len(window.grid_m) / (step_m**2 * told)


def _fitted_spectrum(relief_m: Array) -> Array:
    """Return the variance of the cosine coefficients of relief (rows, columns), smooth."""
    power = dctn(relief_m, norm="ortho") ** 2
    log_power = np.log(np.maximum(power, _LOWEST))
    return np.asarray(np.exp(gaussian_filter(log_power, _SIGMA, mode="reflect") + _LOG_MEAN))
