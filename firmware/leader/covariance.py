"""An honest covariance of a refined shift, from the residuals it leaves."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from firmware.geometry import Array
from firmware.leader.alignment import Aligned, NoiseModel
from firmware.leader.design import Design, curvature, design_of, solve

_LEAST_TOLD_PER_M2 = 1e-6  # of a shift, which a kilometre's sigma has as well
_TOLD_BY_BOTH = 0.25  # of slopes, without which the grids do not show the same relief


@dataclass(frozen=True, slots=True, kw_only=True)
class Refined:
    """The optimum near one candidate.

    covariance_m2 (2, 2) is of the shift (2,), a kilometre along a direction without information;
    walk_m2 is to be added to each axis for the random walk of dead reckoning while the overlap was
    measured. variance_m2 is the predicted mean variance of a cell's difference. centre_m (2,) is
    the overlap's middle on the reference.
    """

    shift_m: Array
    covariance_m2: Array
    walk_m2: float
    variance_m2: float
    overlap_cells: int
    centre_m: Array
    reference_time_s: float
    query_time_s: float


def measure(field: Aligned, noise: NoiseModel) -> Refined:
    """Return the fit at its optimum with the sandwich covariance."""
    design = design_of(field, noise)
    residual = field.difference_m - solve(field, design) @ design.columns
    misfit = float(np.mean(residual**2 / field.variance_m2))
    walk_s = sum(span.length_s / 12.0 for span in field.spans)
    return Refined(
        shift_m=field.shift_m,
        covariance_m2=_sandwich(field, design, residual, max(misfit, 1.0), noise),
        walk_m2=noise.walk_m2_per_s * walk_s,
        variance_m2=float(field.variance_m2.mean()),
        overlap_cells=field.cells,
        centre_m=field.centre_m,
        reference_time_s=field.spans[0].mean_s,
        query_time_s=field.spans[1].mean_s,
    )


def _sandwich(
    field: Aligned, design: Design, residual: Array, misfit: float, noise: NoiseModel
) -> Array:
    """Return H^-1 (B + P) H^-1 of the shift, (2, 2).

    H is the curvature with the priors; in it noise alone makes no information, and a direction
    counts only for what it tells once all other unknowns are free. B is the covariance of the score
    under residuals correlated as they are seen to be, and at least as the model says; of H^-1 the
    shift's rows are enough to lay about it.
    """
    p, found = len(design.columns), curvature(field, design) + design.information
    noisy = (design.columns / field.variance_m2) @ design.columns.T + design.information
    values, vectors = np.linalg.eigh(_of_shift_alone(found))
    steep = np.diag(vectors.T @ _of_shift_alone(noisy) @ vectors)
    usable = values > np.maximum(_TOLD_BY_BOTH * steep, _LEAST_TOLD_PER_M2)
    rotated = np.eye(p)
    rotated[:2, :2] = vectors.T
    kept = rotated[np.concatenate([usable, np.ones(p - 2, dtype=bool)])]
    inverse = np.linalg.inv(kept @ found @ kept.T)
    gain = inverse[: usable.sum()] @ kept
    scores_m2 = _score_covariance(field, gain @ design.columns, residual, misfit, noise)
    spread = 1e6 * np.eye(2)  # a kilometre: nothing is known in that direction
    spread[np.ix_(usable, usable)] = scores_m2 + gain @ design.information @ gain.T
    result = vectors @ spread @ vectors.T
    return np.asarray(0.5 * (result + result.T))


def _of_shift_alone(information: Array) -> Array:
    """Return what information (p, p) says of the shift, (2, 2), whatever the other unknowns are."""
    crossed = information[:2, 2:]
    told = information[:2, :2] - crossed @ np.linalg.solve(information[2:, 2:], crossed.T)
    return np.asarray(0.5 * (told + told.T))


def _score_covariance(
    field: Aligned,
    columns: Array,
    residual: Array,
    misfit: float,
    noise: NoiseModel,
) -> Array:
    """Return sum_ij u_i C(i - j) u_j' (K, K), where u = weight * column and C is seen in r."""
    shape = field.both.shape
    size = tuple(fft.next_fast_len(2 * n, real=True) for n in shape)
    sigma = np.sqrt(field.variance_m2)
    stack = np.zeros((2 + len(columns), *shape))
    stack[:, field.both] = np.vstack([np.ones(sigma.size), residual / sigma, columns / sigma])
    spectrum = fft.rfft2(stack, s=size)
    pairs = fft.irfft2(np.abs(spectrum[0]) ** 2, s=size)
    seen = fft.irfft2(np.abs(spectrum[1]) ** 2, s=size) / np.maximum(pairs, 1.0)
    lag = [fft.fftfreq(n, 1.0 / n) * field.cell_m for n in size]
    distance = np.hypot(lag[0][:, None], lag[1][None, :])
    taper = np.maximum(1.0 - distance / (4.0 * noise.correlation_m), 0.0)
    model = np.exp(-0.5 * (distance / noise.correlation_m) ** 2) * noise.correlated_share * misfit
    model[0, 0] = misfit
    floor = np.maximum(fft.rfft2(np.where(pairs > 0.5, seen, 0.0) * taper).real, 0.0)
    power = np.maximum(floor, fft.rfft2(model).real)
    return _quadratic(spectrum[2:], power, size)


def _quadratic(spectrum: NDArray[np.complex128], power: Array, size: tuple[int, ...]) -> Array:
    """Return Parseval's sum over both halves of the spectrum of u power u', (K, K)."""
    double = np.full(spectrum.shape[2], 2.0)
    double[0] = 1.0
    if size[1] % 2 == 0:
        double[-1] = 1.0
    flat = spectrum.reshape(spectrum.shape[0], power.size)
    weight = (power * double).ravel() / (size[0] * size[1])
    return np.asarray(((flat * weight) @ flat.conj().T).real)
