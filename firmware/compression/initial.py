"""Where the fit starts: pseudo points spread by roughness, dealt over the fragments.

Some points go to the rim, because the leader maps only inside the hull of what it receives.
"""

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from firmware.geometry import Array

_LLOYD_STEPS = 8
_ROUGHNESS_POWER = 0.9  # 0 spreads evenly; much above 1 starves smooth parts
_RIM_SHARE = 0.1  # of the points: a rectangle needs four, a ragged edge some more


def roughness(position_m: Array, depth_m: Array) -> Array:
    """Return each cell's mean deviation from the plane of its neighbourhood, (K,)."""
    near = min(13, len(depth_m))
    _, index = cKDTree(position_m).query(position_m, k=near)
    index = index.reshape(len(depth_m), near)
    offset_m = position_m[index] - position_m[:, None, :]
    deviation_m = depth_m[index] - depth_m[index].mean(axis=1, keepdims=True)
    offset_m = offset_m - offset_m.mean(axis=1, keepdims=True)
    moment = np.einsum("kni,knj->kij", offset_m, offset_m) + 1e-3 * np.eye(2)
    slope = np.linalg.solve(moment, np.einsum("kni,kn->ki", offset_m, deviation_m)[..., None])
    residual_m = deviation_m - (offset_m @ slope)[..., 0]
    return np.asarray(np.sqrt((residual_m**2).mean(axis=1)))


def rim(position_m: Array, count: int) -> Array:
    """Return up to `count` of the positions (K, 2), evenly along their convex hull."""
    try:
        hull = ConvexHull(position_m)
    except QhullError:  # all on one line, or too few
        along = position_m @ main_axis(position_m)
        return position_m[[int(np.argmin(along)), int(np.argmax(along))]]
    corners_m = position_m[hull.vertices]
    closed_m = np.vstack([corners_m, corners_m[:1]])
    length_m = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(closed_m, axis=0), axis=1))]
    along_m = np.linspace(0.0, length_m[-1], count, endpoint=False)
    even_m = np.column_stack([np.interp(along_m, length_m, closed_m[:, i]) for i in range(2)])
    _, nearest = cKDTree(position_m).query(even_m)
    chosen = np.unique(np.r_[nearest, _extremes(position_m)])
    out: Array = position_m[chosen[:count]]
    return out


@dataclass(frozen=True, slots=True)
class Outline:
    """The convex outline of some positions, as half planes: normals (F, 2), offsets (F,)."""

    normal: Array
    offset_m: Array

    @classmethod
    def of(cls, position_m: Array) -> "Outline":
        """Return the outline of positions (K, 2); without area it holds nothing back."""
        try:
            equations = ConvexHull(position_m).equations
        except QhullError:
            equations = np.empty((0, 3))
        return cls(equations[:, :2], equations[:, 2])

    def outside(self, position_m: Array) -> NDArray[np.bool_]:
        """Return which positions (N, 2) lie outside."""
        return np.asarray((position_m @ self.normal.T + self.offset_m > 1e-9).any(axis=1))

    def excess(self, point_m: Array) -> tuple[float, Array]:
        """Return the sum of squared distances outside, m^2, and its gradient (M, 2)."""
        beyond_m = np.maximum(point_m @ self.normal.T + self.offset_m, 0.0)
        return float(np.sum(beyond_m**2)), 2.0 * beyond_m @ self.normal


def _extremes(position_m: Array) -> NDArray[np.intp]:
    """Return the cells farthest out in the four diagonal directions of the main axes."""
    axis = main_axis(position_m)
    local_m = position_m @ np.array([[axis[0], -axis[1]], [axis[1], axis[0]]])
    local_m = (local_m - local_m.mean(axis=0)) / np.maximum(np.ptp(local_m, axis=0), 1e-9)
    signs = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    return np.asarray(np.argmax(local_m @ signs.T, axis=0), dtype=np.intp)


def main_axis(position_m: Array) -> Array:
    """Return the direction (2,) along which positions (N, 2) spread most."""
    centred_m = position_m - position_m.mean(axis=0)
    axis: Array = np.linalg.eigh(centred_m.T @ centred_m)[1][:, -1]
    return axis


def initial_point_steps(
    position_m: Array, depth_m: Array, count: int
) -> Generator[None, None, tuple[Array, int]]:
    """Find starting positions (M, 2) and how many of them, the first, sit on the rim.

    The generator's value is both. Lloyd's iteration on cells weighted by roughness, with the rim
    held. M is `count` or the number of cells if that is less.
    """
    if len(position_m) <= count:
        return position_m.copy(), len(position_m)
    rim_m = rim(position_m, int(count * _RIM_SHARE))
    yield
    weight = roughness(position_m, depth_m)
    yield
    weight = (weight / max(float(np.median(weight)), 1e-6)) ** _ROUGHNESS_POWER
    weight = np.clip(weight, 0.2, 5.0)
    order = hilbert_order(position_m)
    share = np.cumsum(weight[order])
    free = count - len(rim_m)
    picked = order[np.searchsorted(share, (np.arange(free) + 0.5) * share[-1] / free)]
    inner_m = position_m[picked] + 1e-3 * np.arange(free)[:, None]
    for _ in range(_LLOYD_STEPS):
        _, owner = cKDTree(np.vstack([rim_m, inner_m])).query(position_m)
        mass = np.bincount(owner, weight, count)
        for axis in range(2):
            total = np.bincount(owner, weight * position_m[:, axis], count)[len(rim_m) :]
            own = mass[len(rim_m) :]
            inner_m[own > 0, axis] = total[own > 0] / own[own > 0]
        yield
    return np.vstack([rim_m, inner_m]), len(rim_m)


def hilbert_order(position_m: Array) -> NDArray[np.intp]:
    """Return the order of positions (K, 2) along a Hilbert curve over their square."""
    low = position_m.min(axis=0)
    span_m = max(float(np.ptp(position_m, axis=0).max()), 1e-9)
    x, y = np.minimum((position_m - low) / span_m * 1024, 1023).astype(np.int64).T
    distance = np.zeros(len(x), dtype=np.int64)
    side = 512
    while side:
        right, up = (x & side) > 0, (y & side) > 0
        distance += side * side * ((3 * right) ^ up)
        flip = ~up & right
        x, y = np.where(flip, 1023 - x, x), np.where(flip, 1023 - y, y)
        x, y = np.where(up, x, y), np.where(up, y, x)
        side //= 2
    return np.argsort(distance, kind="stable")


def dealt_fragments(position_m: Array, fragments: int) -> NDArray[np.intp]:
    """Return the fragment (M,) of each point so that neighbours travel apart.

    Dealt in turn along a Hilbert curve, then improved by the best swaps of two points until none
    helps; every fragment gets the same number of points, give or take one.
    """
    count = len(position_m)
    fragment = np.empty(count, dtype=np.intp)
    fragment[hilbert_order(position_m)] = np.arange(count) % fragments
    if count <= fragments:
        return fragment
    distance_m = np.linalg.norm(position_m[:, None] - position_m[None], axis=2)
    spacing_m = max(float(np.median(np.sort(distance_m, axis=1)[:, 1])), 1e-9)
    coupling = np.exp(-distance_m / spacing_m)
    np.fill_diagonal(coupling, 0.0)
    member = np.eye(fragments)[fragment]
    for _ in range(count):
        cost = coupling @ member
        own = cost[np.arange(count), fragment]
        moved = cost[:, fragment]  # cost of point i in the fragment of point j
        gain = moved + moved.T - own[:, None] - own[None, :] - 2.0 * coupling
        gain[fragment[:, None] == fragment[None, :]] = 0.0
        i, j = np.unravel_index(int(np.argmin(gain)), gain.shape)
        if gain[i, j] >= -1e-9:
            break
        fragment[i], fragment[j] = fragment[j], fragment[i]
        member[i], member[j] = member[j].copy(), member[i].copy()
    return fragment
