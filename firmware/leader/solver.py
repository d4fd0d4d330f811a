"""The incremental solver of the pose graph: ISAM2 as a cache of the ledger.

It is poisoned as soon as it raises, and can be thrown away and built anew from the ledger and an
estimate at any time. The ledger belongs to the pose graph; which slots of ISAM2 its entries have
is the solver's.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import gtsam
import numpy as np

from firmware.geometry import Array
from firmware.leader.factors import factor_of, values_of
from firmware.leader.ledger import (
    Entry,
    OdometryRecord,
    PriorRecord,
    Record,
    SharedDriftRecord,
    SharedWalkRecord,
)
from protocol.errors import EstimationError

_RECKONING = (PriorRecord, OdometryRecord, SharedDriftRecord, SharedWalkRecord)
_PLAIN = ("_ledger", "_robust_kernel", "_factorization", "rebuilds")
_WORN = 1.3
"""ISAM2 orders anew only what news reach, and fills: so much of that, and it is built anew."""

_MOVED = 0.1
"""Metres, m/s or rad from which a variable is linearised anew.

Only directions of ranges and robust weights bend. A compass hardly turns so far: it is taken anew
when ISAM2 is built, every five minutes at least.
"""


class Solver:
    """Estimates and covariances of the variables that a ledger speaks of."""

    def __init__(self, ledger: dict[int, Entry], robust_kernel: float) -> None:
        self.rebuilds = 0
        self._ledger, self._robust_kernel = ledger, robust_kernel
        self._changed: set[int] = set()
        self._values = gtsam.Values()
        self._fresh = gtsam.Values()
        self._factorization = "CHOLESKY"  # until it calls a long chain indeterminate: then QR
        self._begin()
        self._factors: dict[int, gtsam.NonlinearFactor] = {}  # of the ledger, once made
        self._last = gtsam.KeyGroupMap()  # variables to eliminate last
        self._tree_entries = 0  # of ISAM2 when it was built

    def __getstate__(self) -> dict[str, Any]:
        """Return the solver as plain data, to be taken just after `restart`.

        ISAM2 is built again from the point about which it was linearised, so that it is the same.
        """
        if self._changed or self._fresh.size():
            raise TypeError("the ledger has news that ISAM2 does not know")
        state = {name: self.__dict__[name] for name in _PLAIN}
        return state | {"about": {key: self._about.atVector(key) for key in self._about.keys()}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        about = values_of(state.pop("about"))
        self.__dict__.update(state)
        self._changed, self._fresh, self._factors = set(), gtsam.Values(), {}
        self._rebuild(about)

    def introduce(self, key: int, guess: Array) -> None:
        """Take in a new variable at a first guess."""
        self._fresh.insert(key, np.asarray(guess, dtype=np.float64))

    def note(self, number: int) -> None:
        """Remember that an entry of the ledger is new, or became active or inactive."""
        self._changed.add(number)

    def state(self, key: int) -> Array:
        """Return the estimate of a variable."""
        values = self._values if self._values.exists(key) else self._fresh
        return np.asarray(values.atVector(key))

    def update(self) -> bool:
        """Bring the estimate up to the ledger, and return whether there was anything to do.

        Incrementally, or from scratch if gtsam gives up.
        """
        if not self._changed and self._fresh.size() == 0:
            return False
        try:
            self._increment()
            if self._isam.treeNnz() > _WORN * self._tree_entries:
                self._rebuild(self._values)
        except RuntimeError:
            for key in self._fresh.keys():
                if not self._values.exists(key):
                    self._values.insert(key, self._fresh.atVector(key))
            self._rebuild_by_qr(self._values)
        self._fresh = gtsam.Values()
        self._changed.clear()
        return True

    def restart(self, estimate: Mapping[int, Array]) -> None:
        """Build ISAM2 anew from a ledger that was changed at will, and an estimate of its keys."""
        self._factors.clear()
        values = values_of(estimate)
        try:
            self._rebuild(values)
        except RuntimeError:
            self._rebuild_by_qr(values)
        self._fresh = gtsam.Values()
        self._changed.clear()

    def solve_batch(self) -> None:
        """Solve the ledger from scratch by Levenberg-Marquardt and restart ISAM2 from there."""
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setLinearSolverType("MULTIFRONTAL_QR")
        graph, _ = self._active_factors()
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, self._values, parameters)
        self._rebuild(optimizer.optimize())

    def covariance(self, keys: list[int], *, reckoned: bool = False) -> Array:
        """Return the joint covariance of variables, in their order.

        `reckoned` leaves out closures, ranges and fixes: what dead reckoning alone would know.
        Raises EstimationError if the information matrix is singular.
        """
        try:
            isam = self._reckoning() if reckoned else self._isam
            return np.asarray(isam.jointMarginalCovariance(keys).fullMatrix())
        except RuntimeError as error:
            raise EstimationError("the information matrix is singular") from error

    def _begin(self) -> None:
        """Begin with an empty ISAM2.

        The point about which it is linearised is held, lest each factor that is written in Python
        be handed a copy of it: all variables, for every factor.
        """
        self._isam = _new_isam(self._factorization)
        self._about = self._isam.getLinearizationPoint()

    def _increment(self) -> None:
        added, numbers, removed = gtsam.NonlinearFactorGraph(), [], []
        for number in sorted(self._changed):
            entry = self._ledger[number]
            if entry.active and entry.slot is None:
                added.push_back(self._factor(number))
                numbers.append(number)
            elif not entry.active and entry.slot is not None:
                removed.append(entry.slot)
                entry.slot = None
        self._note_newest(self._ledger[number].record for number in numbers)
        result = self._isam.update(added, self._fresh, removed, self._last)
        for number, slot in zip(numbers, result.getNewFactorsIndices(), strict=True):
            self._ledger[number].slot = slot
        if numbers or removed:
            self._isam.update(constrainedKeys=self._last)  # a robust weight lags a step behind
        self._values = self._isam.calculateEstimate()

    def _note_newest(self, records: Iterable[Record]) -> None:
        """Let a vehicle's parameters, and the node that it has reached, be eliminated last.

        What is told next hangs on these, and most questions are about them: either costs as much
        as all that is eliminated after what it concerns. A ledger may tell of the way into the next
        boot's chain before those within the last one's.
        """
        ways = [record for record in records if isinstance(record, OdometryRecord)]
        for way in ways:
            for key in (way.target, way.parameters):
                self._last.insert2(key, 1)
        for way in ways:
            self._last.erase(way.origin)

    def _rebuild_by_qr(self, values: gtsam.Values) -> None:
        self._factorization = "QR"
        self._rebuild(values)
        self.rebuilds += 1

    def _rebuild(self, values: gtsam.Values) -> None:
        self._last = gtsam.KeyGroupMap()
        for entry in self._ledger.values():
            entry.slot = None
        self._note_newest(entry.record for entry in self._ledger.values())
        graph, entries = self._active_factors()
        self._begin()
        result = self._isam.update(graph, values, [], self._last)
        for entry, slot in zip(entries, result.getNewFactorsIndices(), strict=True):
            entry.slot = slot
        self._values = self._isam.calculateEstimate()
        self._tree_entries = self._isam.treeNnz()

    def _reckoning(self) -> gtsam.ISAM2:
        graph = gtsam.NonlinearFactorGraph()
        for number, entry in self._ledger.items():
            if isinstance(entry.record, _RECKONING):
                graph.push_back(self._factor(number))
        try:
            return _isam_of(graph, self._values, self._factorization)
        except RuntimeError:
            return _isam_of(graph, self._values, "QR")

    def _factor(self, number: int) -> gtsam.NonlinearFactor:
        if number not in self._factors:
            self._factors[number] = factor_of(self._ledger[number].record, self._robust_kernel)
        return self._factors[number]

    def _active_factors(self) -> tuple[gtsam.NonlinearFactorGraph, list[Entry]]:
        graph, entries = gtsam.NonlinearFactorGraph(), []
        for number, entry in self._ledger.items():
            if entry.active:
                graph.push_back(self._factor(number))
                entries.append(entry)
        return graph, entries


def _isam_of(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, factorization: str
) -> gtsam.ISAM2:
    isam = _new_isam(factorization)
    isam.update(graph, values)
    return isam


def _new_isam(factorization: str) -> gtsam.ISAM2:
    """Return an empty ISAM2 that factorises by `QR` or `CHOLESKY`."""
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization(factorization)
    parameters.setRelinearizeThreshold(_MOVED)
    parameters.relinearizeSkip = 1
    parameters.findUnusedFactorSlots = True  # memory stays with what is active
    return gtsam.ISAM2(parameters)
