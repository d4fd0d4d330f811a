"""Where sheets lie by the estimate, and their offsets from each other before any match."""

import contextlib
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from firmware.geometry import Array
from firmware.leader.alignment import TINY_M2
from firmware.leader.atlas import Sheet, SheetId
from firmware.leader.drifts import Drifts
from firmware.leader.estimate import Estimate
from firmware.leader.ledger import Anchor
from protocol.errors import EstimationError

_BETWEEN = np.hstack([-np.eye(2, 4), np.eye(2, 4)])  # takes two states to their offset
_DRIFTS = np.eye(8)[[2, 3, 6, 7]]  # and to their drifts


@dataclass(frozen=True, slots=True, kw_only=True)
class Offset:
    """The offset of a sheet, the target, from another one, the origin, as the estimate has it.

    shift_m (2,) is to be added to the offset by dead reckoning, each sheet's at its own time;
    covariance_m2 (2, 2) is that of the offset, of which apart_m2 is the part that lies within the
    composed past: estimated once and for all. drifts are those at the nodes of both.
    """

    origin: Sheet
    target: Sheet
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


class Offsets:
    """Offsets of sheets by an estimate that stays as it is meanwhile.

    All that are asked for share one joint covariance with the sheets that are `expected` to be
    asked for next: that is what costs.
    """

    def __init__(self, estimate: Estimate, expected: Sequence[Sheet] = ()) -> None:
        self._estimate = estimate
        self._sheets: dict[SheetId, Sheet] = {}
        self._anchors: dict[SheetId, Anchor] = {}  # of those that hang on a node
        self._joint: Array | None = None  # of the anchors, in their order
        with contextlib.suppress(Exception):  # whoever asks for such a sheet meets it again
            self._place(expected)

    def of(self, pairs: Sequence[tuple[Sheet, Sheet]]) -> list[Offset]:
        """Return the offset of the second sheet of each pair from the first.

        Pairs with a sheet that hangs on no node are left out: frames were lost there. Raises
        EstimationError if the information matrix is singular.
        """
        self._place(itertools.chain.from_iterable(pairs))
        placed = [pair for pair in pairs if all(sheet.id in self._anchors for sheet in pair)]
        if not placed:
            return []
        if self._joint is None:
            self._joint = self._estimate.state_covariance(list(self._anchors.values()))
        rows = {sheet_id: row for row, sheet_id in enumerate(self._anchors)}
        ends = np.array([[rows[origin.id], rows[target.id]] for origin, target in placed])
        both = self._joint[ends[:, :, None], :, ends[:, None, :], :]  # (pairs, end, end, 4, 4)
        both = both.swapaxes(2, 3).reshape(-1, 8, 8)
        covariances_m2 = _BETWEEN @ both @ _BETWEEN.T
        known = np.linalg.inv(covariances_m2 + TINY_M2 * np.eye(2))
        gains = _DRIFTS @ both @ _BETWEEN.T @ known
        told = gains @ covariances_m2 @ gains.swapaxes(1, 2)
        left = _DRIFTS @ both @ _DRIFTS.T - told
        moves_m = corrections([self._sheets[sheet_id] for sheet_id in rows], self._estimate)
        shifts_m = moves_m[ends[:, 1]] - moves_m[ends[:, 0]]
        return [
            Offset(
                origin=origin,
                target=target,
                shift_m=shifts_m[k],
                covariance_m2=covariances_m2[k],
                apart_m2=self._anchors[origin.id].apart_m2 + self._anchors[target.id].apart_m2,
                drifts=Drifts(gain=gains[k], left=left[k], expected_m=shifts_m[k]),
            )
            for k, (origin, target) in enumerate(placed)
        ]

    def _place(self, sheets: Iterable[Sheet]) -> None:
        """Find the anchors of sheets, and forget the joint covariance where some are new."""
        for sheet in sheets:
            if sheet.id not in self._sheets:
                with contextlib.suppress(EstimationError):
                    self._anchors[sheet.id] = anchor_of(sheet, self._estimate)
                self._sheets[sheet.id], self._joint = sheet, None


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
