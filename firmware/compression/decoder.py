"""The leader's decoder: depth and variance from pseudo points, the same code on both vehicles.

The follower fits its points through this decoder, so both sides must agree on the nugget.
Source: paper, Eq. 5 and 6 with the pseudo points in the place of the soundings.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, cho_solve, lapack

from firmware.compression.kernels import Hyperparameters, correlation, squared_distance
from firmware.geometry import Array
from protocol.errors import EstimationError

NUGGET = 1e-4  # of c: the least that keeps 150 points solvable; sigma^2 would smooth twice
_ROW_POINTS = 512 * 150  # of kernel rows held at once: 1 MB, and they stay in the cache
_TRIES = 6  # the nugget grows tenfold each time, up to 10 c


@dataclass(frozen=True, slots=True, kw_only=True)
class PointDecoder:
    """A Gaussian process conditioned on pseudo points; cheap to ask for many positions."""

    points_m: NDArray[np.float32]  # (M, 2) about origin_m
    origin_m: Array
    weights_m: NDArray[np.float32]  # (M,)
    whitener: NDArray[np.float32]  # (M, M), inverse of the lower Cholesky factor, transposed
    hyper: Hyperparameters
    nugget: float
    failed_factorisations: int

    def predict(self, position_m: Array) -> tuple[Array, Array]:
        """Return depth and variance (Eq. 5, 6) at positions (N, 2), in chunks of rows."""
        depth_m = np.empty(len(position_m))
        variance_m2 = np.empty(len(position_m))
        c, sigma2 = self.hyper.c_m2, self.hyper.sigma2_m2
        rows = max(64, _ROW_POINTS // len(self.points_m))
        squared, spare = np.empty((2, rows, len(self.points_m)), dtype=np.float32)
        for start in range(0, len(position_m), rows):
            part = slice(start, start + rows)
            local_m = (position_m[part] - self.origin_m).astype(np.float32)
            room, more = squared[: len(local_m)], spare[: len(local_m)]
            squared_distance(local_m, self.points_m, self.hyper.b_per_m, room, more)
            k = correlation(self.hyper.kernel, room, more)
            depth_m[part] = k @ self.weights_m
            white = blas.strmm(1.0, self.whitener.T, k.T, lower=1, overwrite_b=1).T
            explained = np.einsum("ij,ij->i", white, white)
            variance_m2[part] = np.clip(1.0 - explained, 0.0, 1.0)
        return depth_m + self.hyper.mean_depth_m, c * variance_m2 + sigma2


def point_decoder(points_ned_m: Array, hyper: Hyperparameters) -> PointDecoder:
    """Return the decoder for points (M, 3) as north, east, depth.

    Raises
    ------
    EstimationError
        When even the largest nugget does not make the points solvable.
    """
    points_ned_m = np.asarray(points_ned_m, dtype=np.float64)
    origin_m = points_ned_m[:, :2].mean(axis=0)
    local_m = points_ned_m[:, :2] - origin_m
    nugget = NUGGET + (hyper.sigma2_m2 / hyper.c_m2 if hyper.noise_applied else 0.0)
    k = correlation(hyper.kernel, squared_distance(local_m, local_m, hyper.b_per_m))
    lower, nugget, failed = factorised(k, nugget, use_up=True)
    del k
    weights_m = cho_solve((lower.T, False), points_ned_m[:, 2] - hyper.mean_depth_m)
    whitener = lapack.dtrtri(lower.T, lower=0, overwrite_c=1)[0]
    return PointDecoder(
        points_m=local_m.astype(np.float32),
        origin_m=origin_m,
        weights_m=weights_m.astype(np.float32),
        whitener=np.ascontiguousarray(whitener, dtype=np.float32),
        hyper=hyper,
        nugget=nugget,
        failed_factorisations=failed,
    )


def factorised(k: Array, nugget: float, *, use_up: bool = False) -> tuple[Array, float, int]:
    """Return the lower Cholesky factor of k + nugget I, the nugget it took, and the failures.

    The factor is in the order of rows, so that LAPACK takes its transpose as it is. It may take the
    place of k, of whose upper half it says nothing: from there k is restored after a failure.
    """
    room = np.asarray(k, dtype=np.float64) if use_up else np.array(k, dtype=np.float64)
    diagonal = room.diagonal().copy()
    for failed in range(_TRIES):
        np.einsum("ii->i", room)[...] = diagonal + nugget
        upper, info = lapack.dpotrf(room.T, lower=0, overwrite_a=1, clean=0)  # seen as columns
        if info == 0 and np.isfinite(upper[-1, -1]):
            return upper.T, nugget, failed
        below = np.tril_indices_from(room, -1)
        room[below] = room.T[below]
        nugget *= 10.0
    raise EstimationError(f"covariance of {len(k)} points stays singular at a nugget of {nugget} c")
