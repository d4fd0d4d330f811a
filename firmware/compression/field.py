"""The seabed as a Gaussian field in cosine transform: best estimate and spectrum from the cells.

On a rectangle the two-dimensional cosine transform nearly diagonalises a stationary field. With
coefficients a ~ N(0, lambda(k)) and cells y = S z + noise, z = C' a, the posterior mean solves

    (1 / lambda + C S' W S C') a = C S' W y

by conjugate gradients, preconditioned by its diagonal. lambda itself is found from the same
soundings by its marginal likelihood: rings of frequency, and what stands out of them where it
surely does. Gaps, ragged edges and outer-beam noise are in S and W; nothing needs to be filled in
beforehand.
"""

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dctn, idctn
from scipy.ndimage import gaussian_filter
from scipy.sparse import csc_array, csr_array

from firmware.compression.lattice_frame import LatticeFrame, interpolation
from firmware.compression.spectrum import Rings
from firmware.geometry import Array
from firmware.submaps import BinnedSoundings

_ROUNDS = 7  # of scoring; more change the error by less than 0.1 %
_CG_STEPS = 12  # per round, warm-started; twice as many at the end
_CG_TOLERANCE = 1e-8  # of the right side's norm, squared; looser stops before fine detail
_PROBES = 8  # that tell how much the cells say of each coefficient
_PROBE_SIGMA = 4.0  # coefficients over which that is the same
_SHY = 1.03  # on the information: a spectrum too low costs less than one too high
_SMALLEST_M2 = 1e-9
_LARGEST_TERMS = np.array([2.0**19 - 1.0, 127.0, 127.0, 127.0, 127.0, 127.0])  # that the wire holds

Float32 = NDArray[np.float32]


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


@dataclass(frozen=True, slots=True, kw_only=True)
class Surface:
    """Depths in a frame: coefficients (rows, columns) in m, orthonormal, about the trend."""

    frame: LatticeFrame
    trend: Trend
    coefficients_m: Array

    def depth_m(self, position_m: Array) -> Array:
        """Return the depth at positions (N, 2), whether measured there or not."""
        trend_m = self.trend.depth_m(self.frame.nodes_of(position_m), self.frame)
        nodes_m = np.asarray(idctn(self.coefficients_m, norm="ortho")).ravel()
        out: Array = interpolation(self.frame, position_m) @ nodes_m + trend_m
        return out


@dataclass(frozen=True, slots=True, kw_only=True)
class Field(Surface):
    """The estimate of a surface, and how well it is known."""

    noise_m2: float  # of the mean of a cell, typical
    unknown_m2: float  # of the depth at a node, that the cells leave


def fitted_trend(bins: BinnedSoundings, frame: LatticeFrame) -> Trend:
    """Return the trend nearest to the cells, in the least steps in which its terms fit the wire.

    Steps of a centimetre reach down to 5,243 m, steps of two to 10,486 m. What a quadratic takes
    away, the cosines need not bend at the frame's edges for.
    """
    nodes = frame.nodes_of(np.column_stack([bins.north_m, bins.east_m]))
    design = _quadratic(nodes, frame)
    ridge = 1e-3 * len(nodes) * np.diag([0.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    exact = np.linalg.solve(design.T @ design + ridge + 1e-9 * np.eye(6), design.T @ bins.depth_m)
    scale = 0
    while np.any(np.abs(exact) > 0.01 * 2.0**scale * _LARGEST_TERMS):
        scale += 1
    steps = np.round(exact / (0.01 * 2.0**scale)).astype(int)
    return Trend(terms=tuple(int(step) for step in steps), scale=scale)


def _quadratic(nodes: Array, frame: LatticeFrame) -> Array:
    half = 0.5 * np.maximum(np.array(frame.shape) - 1.0, 1.0)
    u, v = ((nodes - half) / half).T
    return np.column_stack([np.ones_like(u), u, v, u * u, u * v, v * v])


def fitted_field_steps(
    bins: BinnedSoundings, frame: LatticeFrame, trend: Trend
) -> Generator[None, None, Field]:
    """Estimate field and spectrum in small steps; the generator's value is the `Field`."""
    variance_m2 = _noise_of_means(bins)
    cells = _Cells.of(bins, frame, trend, 1.0 / variance_m2)
    yield
    radius = wavenumbers(frame)
    rings = Rings(radius)
    information = cells.information()
    yield
    spread_m2 = max(float(np.var(cells.depth_m)), 1e-6)
    prior = _normalised(1.0 / (1.0 + (radius * 60.0) ** 3), spread_m2)
    coefficients = np.zeros(frame.shape, dtype=np.float32)
    for _ in range(_ROUNDS):
        coefficients = yield from cells.posterior(prior, information, coefficients, _CG_STEPS)
        told = cells.share * prior * information / (1.0 + prior * information)
        prior = np.maximum(prior * np.exp(rings.turn(coefficients**2 / prior, told)), _SMALLEST_M2)
        yield
    coefficients = yield from cells.posterior(prior, information, coefficients, 2 * _CG_STEPS)
    unknown = prior / (1.0 + prior * information * cells.share)
    return Field(
        frame=frame,
        trend=trend,
        coefficients_m=coefficients.astype(np.float64),
        noise_m2=float(np.median(variance_m2)),
        unknown_m2=float(unknown.mean()),
    )


def wavenumbers(frame: LatticeFrame) -> Array:
    """Return the radial wavenumber of each coefficient in cycles per metre, (rows, columns)."""
    along = np.arange(frame.rows) / (2.0 * frame.rows * frame.step_m)
    across = np.arange(frame.columns) / (2.0 * frame.columns * frame.step_m)
    out: Array = np.hypot(along[:, None], across[None, :])
    return out


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


@dataclass(frozen=True, slots=True, kw_only=True)
class _Cells:
    """The cells about the trend, how the nodes give them and how well each is known.

    In single precision, which conjugate gradients stand where they start anew in every round.
    """

    frame: LatticeFrame
    read: csr_array
    spread: csc_array  # its transpose, in the same memory
    weight: Float32
    depth_m: Float32
    share: float  # of the frame's nodes that any cell touches

    @classmethod
    def of(
        cls, bins: BinnedSoundings, frame: LatticeFrame, trend: Trend, weight: Array
    ) -> "_Cells":
        position_m = np.column_stack([bins.north_m, bins.east_m])
        read = interpolation(frame, position_m).astype(np.float32)
        depth_m = bins.depth_m - trend.depth_m(frame.nodes_of(position_m), frame)
        covered = np.count_nonzero(np.bincount(read.indices))
        return cls(
            frame=frame,
            read=read,
            spread=read.T,
            weight=weight.astype(np.float32),
            depth_m=depth_m.astype(np.float32),
            share=min(covered / (frame.rows * frame.columns), 1.0),
        )

    def _gathered(self, values: Float32) -> Float32:
        nodes = self.spread @ values
        return np.asarray(dctn(nodes.reshape(self.frame.shape), norm="ortho"))

    def information(self) -> Array:
        """Return the inverse variance with which the cells tell each coefficient, (rows, columns).

        That is the diagonal of C S' W S C' over the share measured. Its high frequencies are told
        less well: where a cell lies between nodes, they hardly reach it.
        """
        rng = np.random.default_rng(1)  # probes need no other chance than their own
        root = np.sqrt(self.weight)
        total = np.zeros(self.frame.shape)
        for _ in range(_PROBES):
            probe = rng.standard_normal(root.size).astype(np.float32)
            total += self._gathered(root * probe) ** 2
        smooth = gaussian_filter(total / _PROBES, _PROBE_SIGMA, mode="reflect")
        return np.asarray(np.maximum(_SHY * smooth / self.share, 1e-12))

    def posterior(
        self, prior: Array, information: Array, start: Float32, most: int
    ) -> Generator[None, None, Float32]:
        """Find the posterior mean of the coefficients from a start in so many steps."""
        nearly = (1.0 / (1.0 / prior + information)).astype(np.float32)
        certainty = (1.0 / prior).astype(np.float32)

        def times(x: Float32) -> Float32:
            seen = self.weight * (self.read @ idctn(x, norm="ortho").ravel())
            return certainty * x + self._gathered(seen)

        right = self._gathered(self.weight * self.depth_m)
        x, residual = start.copy(), right - times(start)
        inner = nearly * residual
        direction, squared = inner.copy(), float(np.vdot(residual, inner))
        enough = _CG_TOLERANCE * float(np.vdot(right, nearly * right))
        for step in range(most):
            if squared <= enough:
                break
            image = times(direction)
            length = squared / float(np.vdot(direction, image))
            x += length * direction
            residual -= length * image
            inner = nearly * residual
            before, squared = squared, float(np.vdot(residual, inner))
            direction = inner + (squared / before) * direction
            if step % 4 == 3:
                yield
        return x


def _normalised(shape: Array, variance_m2: float) -> Array:
    scaled = shape / shape.sum() * variance_m2 * shape.size
    return np.asarray(np.maximum(scaled, _SMALLEST_M2))
