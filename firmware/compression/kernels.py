"""Covariance functions of the sub-map's Gaussian process, and how a packet names them.

All take the scaled distance s = b d and return the correlation (c = 1). Equation (3) of the paper
can be read with the norm (`EXPONENTIAL`, as printed) or its square (`SQUARED_EXPONENTIAL`).
"""

import enum
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware.geometry import Array
from protocol.packets import DEEPEST_M, HIGHEST_M

FloatArray = NDArray[Any]  # float32 for rows over soundings, float64 among points
_ROWS = 64  # at once where no room is given: matrices among points need none of their own size
_EXPONENT_FLOOR = -60.0  # below it float32 gets denormal, and denormals are 20-60 times slower


class Kernel(enum.IntEnum):
    """The covariance functions that the hyperparameters can name."""

    SQUARED_EXPONENTIAL = 0  # exp(-s^2 / 2)
    MATERN32 = 1  # (1 + sqrt3 s) exp(-sqrt3 s)
    EXPONENTIAL = 2  # exp(-s / 2)

    @property
    def reach(self) -> float:
        """Return the s at which the correlation has fallen to 1e-4, the least that counts."""
        return (4.3, 6.8, 18.4)[self]


def correlation(kernel: Kernel, squared: FloatArray, spare: FloatArray | None = None) -> FloatArray:
    """Return the correlation at squared scaled distances, which are used up, in their precision."""
    if spare is not None:
        return correlation_and_slope(kernel, squared, squared, spare)[0]
    for start in range(0, len(squared), _ROWS):
        part = squared[start : start + _ROWS]
        correlation_and_slope(kernel, part, part)
    return squared


def correlation_and_slope(
    kernel: Kernel,
    squared: FloatArray,
    k: FloatArray | None = None,
    slope: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return the correlation k and the slope -2 dk/d(s^2), both of the shape of `squared`.

    With s = b d, dk/dz = slope b^2 (x - z) for a point z, and dk/d(log b) = -slope s^2. The slope
    of the exponential kernel is singular at zero distance and is held there. Room for both may be
    given, also `squared` itself: fresh pages cost as much as the arithmetic.
    """
    if kernel is Kernel.SQUARED_EXPONENTIAL:
        k = _floored(np.multiply(squared, -0.5, out=k))
        np.exp(k, out=k)
        return k, k
    k = np.sqrt(squared, out=k)
    if kernel is Kernel.MATERN32:
        k *= -np.sqrt(3.0).astype(k.dtype)
        slope = np.exp(_floored(k), out=slope)
        np.subtract(1.0, k, out=k)
        k *= slope
        slope *= 3.0
        return k, slope
    slope = np.maximum(k, 1e-4, out=slope)
    k *= -0.5
    np.exp(_floored(k), out=k)
    np.divide(k, slope, out=slope)
    slope *= 0.5
    return k, slope


def _floored(exponent: FloatArray) -> FloatArray:
    """Return exponents, in place, where they are not too low to tell; few sub-maps reach there."""
    if exponent.size and exponent.min() < _EXPONENT_FLOOR:
        np.maximum(exponent, exponent.dtype.type(_EXPONENT_FLOOR), out=exponent)
    return exponent


def squared_distance(
    left_m: FloatArray,
    right_m: FloatArray,
    b: float,
    squared: FloatArray | None = None,
    spare: FloatArray | None = None,
) -> FloatArray:
    """Return b^2 |x - z|^2 for all pairs of left (N, 2) and right (M, 2), as (N, M).

    Room for the result, and as much to spare, may be given.
    """
    left, right = minuends(left_m), subtrahends(right_m)
    if spare is not None:
        return squared_differences(left, right, b, squared, spare)
    out = np.empty((len(left_m), len(right_m)), left_m.dtype) if squared is None else squared
    for start in range(0, len(out), _ROWS):
        part = slice(start, start + _ROWS)
        squared_differences(left[:, part], right, b, out[part])
    return out


def squared_differences(
    minuends: FloatArray,
    subtrahends: FloatArray,
    b: float,
    squared: FloatArray | None = None,
    spare: FloatArray | None = None,
) -> FloatArray:
    """Return b^2 |x - z|^2 of what `minuends` and `subtrahends` made of x (N, 2) and z (M, 2).

    Differences of all pairs are products of matrices, [x 1] [1 -z]': exact, and five times faster.
    """
    squared = np.matmul(minuends[0], subtrahends[0], out=squared)
    squared *= squared
    east = np.matmul(minuends[1], subtrahends[1], out=spare)
    east *= east
    squared += east
    squared *= squared.dtype.type(b * b)
    return squared


def minuends(position_m: FloatArray) -> FloatArray:
    """Return (2, N, 2): [x 1] along north and east, for positions (N, 2)."""
    return np.stack([position_m.T, np.ones_like(position_m.T)], axis=2)


def subtrahends(position_m: FloatArray) -> FloatArray:
    """Return (2, 2, M): [1 -z]' along north and east, for positions (M, 2)."""
    return np.stack([np.ones_like(position_m.T), -position_m.T], axis=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Hyperparameters:
    """What the 16 bytes of a packet say: b, c, sigma^2 and the mean depth, and the kernel.

    The kernel is told by signs: b > 0 and c > 0 the squared exponential, b < 0 Matern-3/2, c < 0
    the exponential. sigma^2 < 0 asks the leader to apply |sigma^2| as noise (Eq. 5 to the letter);
    otherwise only the nugget counts, as pseudo points are already free of noise.
    """

    b_per_m: float
    c_m2: float
    sigma2_m2: float
    mean_depth_m: float
    kernel: Kernel
    noise_applied: bool = False

    def to_wire(self) -> NDArray[np.float32]:
        """Return the four float32 of the packet."""
        b = -self.b_per_m if self.kernel is Kernel.MATERN32 else self.b_per_m
        c = -self.c_m2 if self.kernel is Kernel.EXPONENTIAL else self.c_m2
        sigma2 = -self.sigma2_m2 if self.noise_applied else self.sigma2_m2
        return np.array([b, c, sigma2, self.mean_depth_m], dtype=np.float32)

    @classmethod
    def from_wire(cls, values: Array, fallback_depth_m: float) -> "Hyperparameters":
        """Return what the four numbers say, held within bounds; for what means nothing, usual ones.

        A mean depth that means nothing is the fallback.
        """
        b, c, sigma2, mean_m = (float(value) for value in np.asarray(values, dtype=np.float64))
        kernel = Kernel.SQUARED_EXPONENTIAL
        if c < 0.0:
            kernel = Kernel.EXPONENTIAL
        elif b < 0.0:
            kernel = Kernel.MATERN32
        return cls(
            b_per_m=_held(abs(b) or np.nan, 1e-4, 1e2, 0.1),
            c_m2=_held(abs(c) or np.nan, 1e-8, 1e6, 1.0),
            sigma2_m2=_held(abs(sigma2), 0.0, 1e6, 0.02),
            mean_depth_m=mean_m if HIGHEST_M <= mean_m <= DEEPEST_M else fallback_depth_m,
            kernel=kernel,
            noise_applied=sigma2 < 0.0,
        )


def _held(value: float, lowest: float, highest: float, otherwise: float) -> float:
    return min(max(value, lowest), highest) if np.isfinite(value) else otherwise
