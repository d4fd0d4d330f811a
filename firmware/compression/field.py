"""The seabed as a Gaussian field in cosine transform: best estimate and spectrum from the cells.

On a rectangle the two-dimensional cosine transform nearly diagonalises a stationary field. With
coefficients a ~ N(0, lambda(k)) and cells y = S z + noise, z = C' a, the posterior mean solves

    (1 / lambda + C S' W S C') a = C S' W y

by conjugate gradients, preconditioned by lambda. lambda itself is found from the same soundings by
expectation maximisation, smooth in frequency. Gaps, ragged edges and outer-beam noise are in S and
W; nothing needs to be filled in beforehand.
"""

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dctn, idctn
from scipy.ndimage import gaussian_filter
from scipy.sparse import csr_array

from firmware.compression.lattice_frame import LatticeFrame, interpolation
from firmware.geometry import Array
from firmware.submaps import BinnedSoundings

_ROUNDS = 10  # of expectation maximisation; more gains under 2 % of the error
_CG_STEPS = 30  # per round, warm-started
_CG_TOLERANCE = 1e-8  # of the right side's norm, squared; looser stops before fine detail
_STRIDE = 1.8  # over-relaxation; plain steps take three times as many rounds on smooth bottoms
_RADII = 14  # rings of the isotropic part of the spectrum


@dataclass(frozen=True, slots=True, kw_only=True)
class Field:
    """The estimate: coefficients (rows, columns) in m, orthonormal, about the trend."""

    frame: LatticeFrame
    trend: "Trend"
    coefficients_m: Array
    spectrum_m2: Array
    noise_m2: float  # of the mean of a cell, typical

    def depth_m(self, position_m: Array) -> Array:
        """Return the depth at positions (N, 2)."""
        trend_m = self.trend.depth_m(self.frame.nodes_of(position_m), self.frame)
        nodes_m = surface_m(self.coefficients_m).ravel()
        out: Array = interpolation(self.frame, position_m) @ nodes_m + trend_m
        return out


@dataclass(frozen=True, slots=True, kw_only=True)
class Trend:
    """A quadratic surface in the frame, in whole steps as on the wire.

    terms are the coefficients of 1, u, v, u^2, u v, v^2 with u and v from -1 to 1 over the frame,
    in steps of 2^scale cm.
    """

    terms: tuple[int, ...]
    scale: int

    def depth_m(self, nodes: Array, frame: LatticeFrame) -> Array:
        """Return the surface at fractional rows and columns (N, 2)."""
        out: Array = _quadratic(nodes, frame) @ (0.01 * 2.0**self.scale * np.array(self.terms))
        return out


def fitted_trend(bins: BinnedSoundings, frame: LatticeFrame) -> Trend:
    """Return the trend nearest to the cells; steps grow until all terms but the first fit 8 bits.

    What a quadratic takes away, the cosines need not bend at the frame's edges for.
    """
    nodes = frame.nodes_of(np.column_stack([bins.north_m, bins.east_m]))
    design = _quadratic(nodes, frame)
    ridge = 1e-3 * len(nodes) * np.diag([0.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    exact = np.linalg.solve(design.T @ design + ridge + 1e-9 * np.eye(6), design.T @ bins.depth_m)
    scale = 0
    while np.abs(exact[1:]).max() > 0.01 * 2.0**scale * 127.0:
        scale += 1
    steps = np.round(exact / (0.01 * 2.0**scale)).astype(int)
    return Trend(terms=tuple(int(step) for step in steps), scale=scale)


def _quadratic(nodes: Array, frame: LatticeFrame) -> Array:
    half = 0.5 * np.maximum(np.array(frame.shape) - 1.0, 1.0)
    u, v = ((nodes - half) / half).T
    return np.column_stack([np.ones_like(u), u, v, u * u, u * v, v * v])


def fitted_field_steps(
    bins: BinnedSoundings, frame: LatticeFrame, trend: "Trend"
) -> Generator[None, None, Field]:
    """Estimate field and spectrum in small steps; the generator's value is the `Field`."""
    position_m = np.column_stack([bins.north_m, bins.east_m])
    read = interpolation(frame, position_m)
    spread = read.T.tocsr()
    yield
    variance_m2 = _noise_of_means(bins)
    weight = 1.0 / variance_m2
    depth_m = bins.depth_m - trend.depth_m(frame.nodes_of(position_m), frame)
    radius = wavenumbers(frame)
    ring = _rings(radius)
    variance = max(float(np.var(depth_m)), 1e-6)
    prior = _normalised(1.0 / (1.0 + (radius * 60.0) ** 3), variance)
    covered = np.count_nonzero(np.diff(spread.indptr))
    share = min(covered / (frame.rows * frame.columns), 1.0)
    seen = weight.sum() / covered
    coefficients = np.zeros(frame.shape)
    for _ in range(_ROUNDS):
        coefficients = yield from _posterior(
            read, spread, weight, depth_m, prior, coefficients, frame
        )
        energy = coefficients**2 + (1.0 - share) * prior + share * prior / (1.0 + prior * seen)
        prior = prior * (_smooth(energy, ring) / prior) ** _STRIDE
        yield
    return Field(
        frame=frame,
        trend=trend,
        coefficients_m=coefficients,
        spectrum_m2=prior,
        noise_m2=float(np.median(variance_m2)),
    )


def wavenumbers(frame: LatticeFrame) -> Array:
    """Return the radial wavenumber of each coefficient in cycles per metre, (rows, columns)."""
    along = np.arange(frame.rows) / (2.0 * frame.rows * frame.step_m)
    across = np.arange(frame.columns) / (2.0 * frame.columns * frame.step_m)
    out: Array = np.hypot(along[:, None], across[None, :])
    return out


def surface_m(coefficients_m: Array) -> Array:
    """Return node depths about the mean from coefficients, both (rows, columns)."""
    return np.asarray(idctn(coefficients_m, norm="ortho"))


def _noise_of_means(bins: BinnedSoundings) -> Array:
    """Return the variance of each cell's mean; a cell's own spread is pooled with its like.

    Two or three soundings say little of their own spread, so cells sounded equally densely, that
    is by the same beams, share theirs.
    """
    order = np.argsort(bins.count, kind="stable")
    single = bins.variance_m2 * bins.count
    pooled = np.empty_like(single)
    for part in np.array_split(order, 8):
        if part.size:
            pooled[part] = np.average(
                single[part], weights=np.maximum(bins.count[part] - 1.0, 1e-3)
            )
    return np.maximum(np.maximum(pooled, 0.25 * single) / bins.count, 1e-8)


def _posterior(
    read: csr_array,
    spread: csr_array,
    weight: Array,
    depth_m: Array,
    prior: Array,
    start: Array,
    frame: LatticeFrame,
) -> Generator[None, None, Array]:
    """Return the posterior mean of the coefficients by conjugate gradients on a / sqrt(prior)."""
    root = np.sqrt(prior)

    def gathered(values: Array) -> Array:
        nodes = spread @ (weight * values)
        return root * dctn(nodes.reshape(frame.shape), norm="ortho")

    def times(x: Array) -> Array:
        return x + gathered(read @ idctn(root * x, norm="ortho").ravel())

    right = gathered(depth_m)
    x = start / root
    residual = right - times(x)
    direction, squared = residual.copy(), float(np.vdot(residual, residual))
    enough = _CG_TOLERANCE * float(np.vdot(right, right))
    for step in range(_CG_STEPS):
        if squared <= enough:
            break
        image = times(direction)
        length = squared / float(np.vdot(direction, image))
        x += length * direction
        residual -= length * image
        before, squared = squared, float(np.vdot(residual, residual))
        direction = residual + (squared / before) * direction
        if step % 4 == 3:
            yield
    return root * x


def _rings(radius: Array) -> NDArray[np.intp]:
    smallest = float(radius[radius > 0].min())
    edges = np.geomspace(smallest, float(radius.max()) * 1.001, _RADII)
    return np.asarray(np.digitize(radius, edges), dtype=np.intp)


def _smooth(energy: Array, ring: NDArray[np.intp]) -> Array:
    """Return a spectrum smooth in frequency: rings, and what stands out of them locally."""
    count = np.bincount(ring.ravel(), minlength=_RADII + 1)
    total = np.bincount(ring.ravel(), energy.ravel(), _RADII + 1)
    level = total / np.maximum(count, 1)
    isotropic = level[ring]
    local = gaussian_filter(energy / np.maximum(isotropic, 1e-12), 2.0, mode="reflect")
    return np.asarray(np.maximum(isotropic * np.clip(local, 0.1, 30.0), 1e-9))


def _normalised(shape: Array, variance_m2: float) -> Array:
    return np.asarray(np.maximum(shape / shape.sum() * variance_m2 * shape.size, 1e-9))
