"""What the compressor hands on."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware.compression.dense import DenseCode, DenseDraft
from firmware.compression.lattice import LatticeCode
from firmware.compression.settings import CompressionSettings
from protocol.errors import LocalProtocolError
from protocol.packets import Profile

PAPER_FRAGMENTS, PAPER_POINTS = 10, 15


@dataclass(frozen=True, slots=True, kw_only=True)
class FitReport:
    """How a fit went: nothing that failed is silent."""

    evaluations: int = 0
    failed_factorisations: int = 0
    ended: str = "not fitted"

    @property
    def settled(self) -> bool:
        """Return whether the fit took all of its budget or needed no more."""
        return self.ended in {"budget", "converged"}


@dataclass(frozen=True, slots=True, kw_only=True)
class CompressedPoints:
    """Pseudo points of the `paper` profile, in the order of their fragments.

    points_ned_m is (M, 3), NaN where a place stays unused; the first M / F rows are fragment 0's.
    hyperparameters is (4,) as on the wire.
    """

    profile: Profile
    fragment_count: int
    points_ned_m: NDArray[np.float32]
    hyperparameters: NDArray[np.float32]
    report: FitReport


@dataclass(frozen=True, slots=True, kw_only=True)
class CompressedCode:
    """A sub-map of `lattice` or `dense`: its code, to be cut to frames when they are packed."""

    profile: Profile
    fragment_count: int
    code: LatticeCode | DenseCode | DenseDraft
    settings: CompressionSettings
    report: FitReport


def fragment_points(compressed: CompressedPoints | CompressedCode) -> NDArray[np.float32]:
    """Return the points as (F, M / F, 3), by fragment; only `paper` has them one by one."""
    if not isinstance(compressed, CompressedPoints):
        raise LocalProtocolError(f"{compressed.profile.name} has no points by fragment")
    return compressed.points_ned_m.reshape(compressed.fragment_count, -1, 3)
