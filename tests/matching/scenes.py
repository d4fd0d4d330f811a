from collections.abc import Callable

import numpy as np
from scipy import ndimage

from firmware.geometry import Array
from firmware.submaps import GriddedSubmap

Relief = Callable[[Array, Array], Array]
CELL_M = 2.0


class Scene:
    """A seeded seabed and sub-maps cut from it."""

    def __init__(self, seed: int, rms_m: float = 0.6) -> None:
        self.rng = np.random.default_rng(seed)
        self.depth_m = ndimage.gaussian_filter(self.rng.standard_normal((400, 400)), 6.0)
        self.depth_m += 0.3 * ndimage.gaussian_filter(self.rng.standard_normal((400, 400)), 2.0)
        self.depth_m *= rms_m / self.depth_m.std()

    def at(self, north_m: Array, east_m: Array) -> Array:
        """Return the depth around 40 m, one node per metre."""
        return 40.0 + ndimage.map_coordinates(self.depth_m, [north_m, east_m], order=1)

    def submap(
        self,
        north_m: float,
        east_m: float,
        shape: tuple[int, int],
        *,
        shift_m: tuple[float, float] = (0.0, 0.0),
        offset_m: float = 0.0,
        sigma_m: float = 0.05,
        relief: Relief | None = None,
    ) -> GriddedSubmap:
        """Return a grid whose coordinates are wrong by minus the shift that mends them."""
        north = north_m + CELL_M * np.arange(shape[0])
        east = east_m + CELL_M * np.arange(shape[1])
        mesh_n, mesh_e = np.meshgrid(north, east, indexing="ij")
        depth = (relief or self.at)(mesh_n, mesh_e)
        depth = depth + offset_m + sigma_m * self.rng.standard_normal(shape)
        time_s = np.broadcast_to(40.0 * np.arange(shape[0])[:, None] / shape[0], shape)
        return GriddedSubmap(
            north0_m=north_m - shift_m[0],
            east0_m=east_m - shift_m[1],
            cell_m=CELL_M,
            depth_m=depth,
            variance_m2=np.full(shape, sigma_m**2),
            time_s=np.array(time_s),
        )
