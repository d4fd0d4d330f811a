"""Where sheets lie by the estimate, and their offsets from each other before any match."""

import contextlib
from dataclasses import dataclass, replace

import numpy as np

from firmware.geometry import Array
from firmware.leader.atlas import Sheet
from firmware.leader.drifts import Drifts
from firmware.leader.estimate import Estimate
from firmware.leader.ledger import Anchor
from protocol.errors import EstimationError

_BETWEEN = np.hstack([-np.eye(2, 4), np.eye(2, 4)])  # takes two states to their offset
_DRIFTS = np.eye(8)[[2, 3, 6, 7]]  # and to their drifts
_TINY_M2 = 1e-6  # two sub-maps of one node have no offset


@dataclass(frozen=True, slots=True, kw_only=True)
class Offset:
    """The offset of a sheet from another one, the origin, as the estimate has it.

    shift_m (2,) is to be added to the offset by dead reckoning, each sheet's at its own time;
    covariance_m2 (2, 2) is that of the offset, of which apart_m2 is the part that lies within the
    composed past: estimated once and for all. drifts are those at the nodes of both.
    """

    origin: Sheet
    shift_m: Array
    covariance_m2: Array
    apart_m2: Array
    drifts: Drifts

    @property
    def sigma_m(self) -> float:
        """How well it is known in its worst direction."""
        return _worst_m(self.covariance_m2)

    @property
    def open_sigma_m(self) -> float:
        """How much of that a match can still tell."""
        return _worst_m(self.covariance_m2 - self.apart_m2)

    def without(self, told_m: Array, told_m2: Array) -> "Offset":
        """Return the offset with one of the Gaussian factors that it rests on taken out.

        The factor joins what the graph still estimates. What the offset would tell of the drifts
        stays the same.
        """
        told, known = np.linalg.inv(told_m2), np.linalg.inv(self.covariance_m2 - self.apart_m2)
        left_m2 = np.linalg.inv(known - told)
        return replace(
            self,
            shift_m=left_m2 @ (known @ self.shift_m - told @ told_m),
            covariance_m2=left_m2 + self.apart_m2,
        )


def _worst_m(covariance_m2: Array) -> float:
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance_m2)[-1], 0.0)))


def offsets_of(sheet: Sheet, others: list[Sheet], estimate: Estimate) -> list[Offset]:
    """Return the offsets of a sheet from others.

    Those that hang on no node are left out: frames were lost there. Raises EstimationError if the
    sheet itself hangs on none.
    """
    anchors, placed = [anchor_of(sheet, estimate)], []
    for other in others:
        with contextlib.suppress(EstimationError):
            anchors.append(anchor_of(other, estimate))
            placed.append(other)
    joint = estimate.state_covariance(anchors)
    ends = np.array([joint[[k, 0]][:, :, [k, 0]] for k in range(1, len(anchors))])
    ends = ends.reshape(-1, 8, 8)  # of each pair, the other's state first
    covariances_m2 = _BETWEEN @ ends @ _BETWEEN.T
    known = np.linalg.inv(covariances_m2 + _TINY_M2 * np.eye(2))
    gains = _DRIFTS @ ends @ _BETWEEN.T @ known
    told = gains @ covariances_m2 @ gains.swapaxes(1, 2)
    left = _DRIFTS @ ends @ _DRIFTS.T - told
    moves_m = corrections([sheet, *placed], estimate)
    return [
        Offset(
            origin=other,
            shift_m=moves_m[0] - moves_m[k],
            covariance_m2=covariances_m2[k - 1],
            apart_m2=anchors[0].apart_m2 + anchors[k].apart_m2,
            drifts=Drifts(gain=gains[k - 1], left=left[k - 1]),
        )
        for k, other in enumerate(placed, start=1)
    ]


def anchor_of(sheet: Sheet, estimate: Estimate) -> Anchor:
    """Return where in the graph a sheet hangs.

    Raises EstimationError if it hangs on no node.
    """
    return estimate.anchor(sheet.id.chain, sheet.time_s, sheet.track)


def corrections(sheets: list[Sheet], estimate: Estimate) -> Array:
    """Return what is to be added (S, 2) to each sheet's dead reckoning at its time."""
    found_m, chains = np.zeros((len(sheets), 2)), np.array([sheet.id.chain for sheet in sheets])
    times_s = np.array([sheet.time_s for sheet in sheets])
    for chain in dict.fromkeys(chains.tolist()):
        rows = np.flatnonzero(chains == chain)
        found_m[rows] = estimate.trajectory(chain).correct(times_s[rows], np.zeros((rows.size, 2)))
    return found_m
