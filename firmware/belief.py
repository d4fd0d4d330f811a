"""What a vehicle believes of its own position."""

from dataclasses import dataclass

from firmware.geometry import Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Belief:
    """A position (2,) NED in metres at one time, with its covariance (2, 2)."""

    time_s: float
    position_m: Array
    covariance_m2: Array
