"""How a field's spectrum is turned towards what its coefficients say."""

import numpy as np
from scipy.ndimage import gaussian_filter

from firmware.geometry import Array

_RINGS = 11  # of the isotropic part of the spectrum, evenly spaced in log frequency
_LOCAL_SIGMA = 2.0  # coefficients over which the spectrum may stand out of its ring
_LOCAL_DOUBT = 3.0  # coefficients, well measured, that it takes to make it do so
_LARGEST_TURN = 1.5  # of a log spectrum in a round


class Rings:
    """Frequencies between rings evenly spaced in their logarithm, and steps of a spectrum there.

    Fisher scoring on log lambda: what a coefficient's square says beyond its expectation, over how
    much it can say. Where the cells tell nothing above their noise, a step takes the spectrum down
    by a factor of e, and expectation maximisation would hardly move it.
    """

    def __init__(self, radius: Array) -> None:
        lowest = float(radius[radius > 0].min())
        at = np.log(np.maximum(radius, lowest) / lowest)
        at *= (_RINGS - 1) / max(float(at.max()), 1e-9)
        self._ring = np.minimum(at.astype(np.intp), _RINGS - 2)
        self._part = at - self._ring

    def _sums(self, values: Array) -> Array:
        ring, part = self._ring.ravel(), self._part.ravel()
        above = values.ravel() * part
        below = np.bincount(ring, values.ravel() - above, _RINGS)
        return np.asarray(below + np.bincount(ring + 1, above, _RINGS), dtype=np.float64)

    def turn(self, power: Array, told: Array) -> Array:
        """Return the change of the log spectrum, for a^2 / lambda and the share of each told."""
        excess, weight = power - told, told * told
        level = self._sums(excess) / (self._sums(weight) + 1e-3)
        level = np.clip(level, -_LARGEST_TURN, _LARGEST_TURN)
        out = level[self._ring] * (1.0 - self._part) + level[self._ring + 1] * self._part
        local = gaussian_filter(excess - weight * out, _LOCAL_SIGMA, mode="reflect")
        local /= gaussian_filter(weight, _LOCAL_SIGMA, mode="reflect") + _LOCAL_DOUBT
        return np.asarray(out + np.clip(local, -_LARGEST_TURN, _LARGEST_TURN))
