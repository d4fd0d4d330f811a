"""All that the match of one pair of sub-maps needs, so that it can run beside the loop."""

from dataclasses import dataclass

import numpy as np

from firmware.geometry import Array
from firmware.leader.atlas import Sheet
from firmware.leader.displacement import Look
from firmware.leader.drifts import NO_DRIFT, Drifts
from firmware.leader.matches import MatchingSettings, MatchOutcome, PairSigmas
from firmware.leader.matching import match
from firmware.submaps import GriddedSubmap


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchJob:
    """Everything one match needs, so that it can run beside the loop.

    Of the grids a drift (2,) was taken about the times of their sheets. The prior, (2,) and (2, 2),
    is that of the shift to add to the target's grid. looks are those of origin and target.
    """

    origin: Sheet
    target: Sheet
    origin_grid: GriddedSubmap
    target_grid: GriddedSubmap
    origin_drift_mps: Array
    target_drift_mps: Array
    prior_shift_m: Array
    prior_covariance_m2: Array
    settings: MatchingSettings
    sigmas: PairSigmas
    looks: tuple[Look, Look]
    drifts: Drifts = NO_DRIFT
    hinted: bool = True

    @property
    def prior_sigma_m(self) -> float:
        """How well the offset was known before the match, in its worst direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self.prior_covariance_m2)[-1]))

    @property
    def prior_radius_m(self) -> float:
        """The radius of the circle whose area equals the prior's one-sigma ellipse."""
        return float(max(np.linalg.det(self.prior_covariance_m2), 0.0) ** 0.25)

    def run(self) -> MatchOutcome:
        """Match the pair."""
        return match(
            self.origin_grid,
            self.target_grid,
            self.prior_shift_m,
            self.prior_covariance_m2,
            self.settings,
            self.sigmas,
            drifts=self.drifts,
            hinted=self.hinted,
        )
