"""How far aside a place lies from where a sonar with a roll bias and a wrong sound speed saw it.

Depths that err by roll * y + smile * y^2 / W (see `swath`) betray beams that are turned by the roll
and, by Snell's law, bent: a place seen at the across-track distance y, an altitude h below, really
lies h * (roll + 2 * smile * y / W) farther to starboard: half of the second term is Snell's law at
the sonar, half the scale of its ranges. It makes lines of opposite heading seem too near to each
other, or too far apart, and every closure between them alike. What is not known of it yet counts as
independent noise of each closure, which is too optimistic where there are many.
"""

from dataclasses import dataclass

import numpy as np

from firmware.geometry import Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """How a vehicle saw a place: unit vector to starboard (2,), altitude, half the swath's width.

    errors (2,) are what is known of its roll in rad and its smile, covariance (2, 2) how well.
    """

    vehicle: int
    starboard: Array
    altitude_m: float
    half_width_m: float
    errors: Array
    covariance: Array

    def displacement(self, lever_m: Array) -> Array:
        """Return how a place at the end of a lever (2,) is moved per unit of the errors, (2, 2)."""
        across = float(np.clip(self.starboard @ lever_m / self.half_width_m, -1.0, 1.0))
        return np.outer(self.starboard, [self.altitude_m, 2.0 * self.altitude_m * across])


def displaced(looks: tuple[Look, Look], levers_m: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return the correction (2,) of the offset of two vehicles at one place, and its covariance.

    The offset is that of the second from the first.
    """
    first, second = (look.displacement(lever) for look, lever in zip(looks, levers_m, strict=True))
    added_m = first @ looks[0].errors - second @ looks[1].errors
    if looks[0].vehicle == looks[1].vehicle:
        both = first - second
        return added_m, both @ looks[0].covariance @ both.T
    left_m2 = first @ looks[0].covariance @ first.T + second @ looks[1].covariance @ second.T
    return added_m, left_m2
