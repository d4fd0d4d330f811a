"""The old part of the pose graph made coarse, so that its size hardly grows with the mission.

Beyond the window of detail a chain keeps one node a piece. What lies between is frozen in the shape
that it was last estimated in, and moves with the nodes around it; dead reckoning, fixes, ranges and
closures of a piece are composed. A piece keeps its closures with the oldest pieces, which the start
holds best: so the past hangs on a fixed map rather than on all of itself. Hints it keeps where its
closures leave room.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from firmware.geometry import Array
from firmware.leader.chains import Chain
from firmware.leader.ledger import (
    AbsoluteRecord,
    Anchor,
    ClosureRecord,
    Entry,
    PriorRecord,
    RangeRecord,
    Record,
    SharedDriftRecord,
    TieRecord,
    as_reckoned,
)
from protocol.settings import Settings, setting

_COARSER = 4  # from level to level, pieces and the age at which they begin alike
_VAGUE = 0.04  # of the information of a piece's surest closure: what tells less is but a hint
Link = TypeVar("Link", ClosureRecord, RangeRecord)
Kept = TypeVar("Kept", ClosureRecord, RangeRecord, AbsoluteRecord)
Group = list[tuple[int, Kept]]  # active records of a piece or two: numbers, and as moved
Groups = defaultdict[tuple[int, ...], Group[Kept]]  # by the keys of their nodes, ascending


@dataclass(frozen=True, slots=True, kw_only=True)
class CompositionSettings(Settings):
    """How coarse the past becomes, and when."""

    interval_s: float = setting(300.0, "s", "then the solver is built anew, too", minimum=20.0)
    detail_s: float = setting(
        1200.0, "s", "of full detail; longer than a follower keeps a frame", minimum=900.0
    )
    piece_s: float = setting(
        60.0, "s", "between nodes beyond it: somewhat longer than a sub-map", minimum=10.0
    )
    distant_s: float = setting(
        1800.0,
        "s",
        "beyond it pieces are four times as long, and beyond four times it again",
        minimum=1200.0,
    )
    levels: int = setting(
        4, "", "pieces of 1 to 64 minutes: nodes grow with the logarithm of time", minimum=1
    )
    closures_per_piece: int = setting(
        2, "closures", "with older pieces; more say the same again", minimum=1
    )
    reject_chi_square: float = setting(
        16.0, "1", "four sigmas: an old closure beyond it is dropped", minimum=1.0
    )
    range_floor_m: float = setting(
        1.0, "m", "of composed ranges: sound speed errs alike in all of them", minimum=0.0
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Coarse:
    """What composing leaves: entries by number, and records that are new."""

    kept: Mapping[int, Entry]
    new: list[Record]


def detail_from_s(now_s: float, settings: CompositionSettings) -> float:
    """Return where the window of detail begins: at the begin of a piece."""
    return float(np.floor((now_s - settings.detail_s) / settings.piece_s) * settings.piece_s)


def kept_nodes(
    chain: Chain, now_s: float, pinned: set[int], settings: CompositionSettings
) -> NDArray[np.bool_]:
    """Return which nodes (K,) of a chain stay: the first of each piece, and all in the detail."""
    s, times_s = settings, np.asarray(chain.times_s)
    piece_from_s = times_s
    for level in range(s.levels):
        piece_s = s.piece_s * _COARSER**level
        distant_s = s.distant_s * _COARSER ** (level - 1) if level else 0.0
        age_s = max(distant_s, s.detail_s)
        until_s = np.floor((now_s - age_s) / piece_s) * piece_s
        begin_s = np.floor(times_s / piece_s) * piece_s
        piece_from_s = np.where(times_s < until_s, begin_s, piece_from_s)
    kept = np.diff(piece_from_s, prepend=-np.inf) > 0
    kept |= np.isin(chain.keys, sorted(pinned))
    kept[-1] = True
    return np.asarray(kept)


def pinned_keys(entries: Iterable[Entry]) -> set[int]:
    """Return the keys of nodes that priors, shared drifts and ties of boots speak of."""
    pinned: set[int] = set()
    for entry in entries:
        if isinstance(entry.record, PriorRecord):
            pinned.add(entry.record.key)
        elif isinstance(entry.record, SharedDriftRecord | TieRecord):
            pinned |= {entry.record.origin, entry.record.target}
    return pinned


class Composition:
    """One pass over a ledger.

    owners maps each dropped node to the one it is added to, apart_m2 to the covariance (2, 2) of
    the way between the two; old holds the keys of the nodes before the window of detail; estimate
    has the state (4,) of every node, dropped ones among them, and each vehicle's parameters and
    clock (2,).
    """

    def __init__(
        self,
        owners: Mapping[int, int],
        apart_m2: Mapping[int, Array],
        old: set[int],
        estimate: Mapping[int, Array],
        settings: CompositionSettings,
    ) -> None:
        self._owners, self._apart_m2, self._old = owners, apart_m2, old
        self._estimate, self._settings = estimate, settings

    def coarse(self, ledger: Mapping[int, Entry]) -> Coarse:
        """Return what stays of a ledger, in order; what joins nodes of a chain is left out."""
        kept: dict[int, Entry] = {}
        closures: Groups[ClosureRecord] = defaultdict(list)
        ranges: Groups[RangeRecord] = defaultdict(list)
        fixes: Groups[AbsoluteRecord] = defaultdict(list)
        for number, entry in ledger.items():
            match entry.record:
                case ClosureRecord() as closure:
                    self._sort(number, self._moved(closure), entry, closures, kept)
                case RangeRecord() as ranging:
                    self._sort(number, self._moved(ranging), entry, ranges, kept)
                case AbsoluteRecord() as fix:
                    self._sort(number, self._moved_fix(fix), entry, fixes, kept)
                case PriorRecord() | SharedDriftRecord() | TieRecord() as record:
                    kept[number] = Entry(record=record, active=entry.active)
        new: list[Record] = []
        for fix_group in fixes.values():
            _keep(fix_group, self._one_fix, kept, new)
        for range_group in ranges.values():
            _keep(range_group, self._one_range, kept, new)
        for closure_group in self._thinned(closures):
            _keep(closure_group, self._one_closure, kept, new)
        return Coarse(kept=dict(sorted(kept.items())), new=new)

    def _sort(
        self, number: int, moved: Kept, entry: Entry, groups: Groups[Kept], kept: dict[int, Entry]
    ) -> None:
        """Keep an entry's record as moved; where all of its nodes are old, group it instead."""
        ends = (
            (moved.anchor,) if isinstance(moved, AbsoluteRecord) else (moved.origin, moved.target)
        )
        keys = tuple(sorted(end.key for end in ends))
        if not self._old.issuperset(keys):
            kept[number] = Entry(record=moved, active=entry.active)
            return
        group = groups[keys]
        if entry.active:
            group.append((number, moved))

    def _anchored(self, anchor: Anchor) -> Anchor:
        """Return an anchor at a node that stays, with the way there as it was reckoned."""
        owner = self._owners.get(anchor.key)
        if owner is None:
            return anchor
        here, there = self._estimate[anchor.key], self._estimate[owner]
        moved_m = here[:2] - anchor.lag_s * here[2:] - there[:2]
        reckoned_m = as_reckoned(moved_m, self._estimate[anchor.parameters])
        return replace(anchor, key=owner, offset_m=anchor.offset_m + reckoned_m, lag_s=0.0)

    def _moved(self, record: Link) -> Link:
        """Return a record between nodes that stay, as uncertain as the ways to them make it.

        The closures of a piece share those ways, and may be as many as a piece keeps: each counts
        them as often as that, however many there are, and so does each range.
        """
        ends = record.origin, record.target
        apart_m2 = [self._apart_m2[end.key] for end in ends if end.key in self._owners]
        if not apart_m2:
            return record
        spread_m2 = self._settings.closures_per_piece * np.sum(apart_m2, axis=0)
        origin, target = (self._anchored(end) for end in ends)
        moved = replace(record, origin=origin, target=target)
        if isinstance(moved, ClosureRecord):
            return replace(moved, covariance_m2=moved.covariance_m2 + spread_m2)
        _, direction = moved.innovation_m(self._estimate.__getitem__)
        variance_m2 = moved.sigma_m**2 + float(direction @ spread_m2 @ direction)
        return replace(moved, sigma_m=float(np.sqrt(variance_m2)))

    def _moved_fix(self, fix: AbsoluteRecord) -> AbsoluteRecord:
        """Return a fix at a node that stays, as uncertain as the way to it makes it."""
        apart_m2 = self._apart_m2.get(fix.anchor.key, np.zeros((2, 2)))
        return replace(
            fix,
            anchor=self._anchored(fix.anchor),
            covariance_m2=fix.covariance_m2 + apart_m2,
        )

    def _thinned(self, closures: Groups[ClosureRecord]) -> list[Group[ClosureRecord]]:
        """Return what stays of the groups: the closures that the estimate believes.

        A group belongs to the newer of its two pieces; of each piece those with the oldest others
        stay, vague ones after all others. What lies within one piece goes.
        """
        by_piece: dict[int, list[tuple[float, float, Group[ClosureRecord]]]] = defaultdict(list)
        for (origin, target), group in closures.items():
            believed = [(number, record) for number, record in group if self._is_true(record)]
            if origin == target or not believed:
                continue
            _, first = believed[0]
            ends = sorted((anchor.time_s, anchor.key) for anchor in (first.origin, first.target))
            told = max(record.information for _, record in believed)
            by_piece[ends[1][1]].append((told, ends[0][0], believed))
        thinned = []
        for groups in by_piece.values():
            vague = _VAGUE * max(told for told, _, _ in groups)
            groups.sort(key=lambda item: (item[0] < vague, item[1]))
            thinned += [group for _, _, group in groups[: self._settings.closures_per_piece]]
        return thinned

    def _is_true(self, record: ClosureRecord) -> bool:
        chi_square = record.chi_square(self._estimate.__getitem__)
        return chi_square <= self._settings.reject_chi_square

    def _one_closure(self, records: list[ClosureRecord]) -> ClosureRecord:
        """Return their weighted mean, no surer for their number: neighbours err alike.

        Those that are told from the other end are turned round.
        """
        told = [record.from_lower_key for record in records]
        moved_m, covariance_m2 = self._mean(told)
        return replace(told[0], offset_m=told[0].offset_m + moved_m, covariance_m2=covariance_m2)

    def _one_fix(self, records: list[AbsoluteRecord]) -> AbsoluteRecord:
        """Return their weighted mean, no surer for their number: they share the way and a sky."""
        moved_m, covariance_m2 = self._mean(records)
        return replace(
            records[0], position_m=records[0].position_m + moved_m, covariance_m2=covariance_m2
        )

    def _mean(self, records: Sequence[ClosureRecord | AbsoluteRecord]) -> tuple[Array, Array]:
        """Return how far the first must move to say what all say, and the covariance of that.

        Covariance intersection, weighted by how much each tells: whatever they share, several alike
        tell no more than one of them, and vague ones take nothing from a sure one.
        """
        information = np.linalg.inv([r.covariance_m2 for r in records])  # (N, 2, 2), 1/m2
        weights = np.trace(information, axis1=1, axis2=2)
        information *= (weights / weights.sum())[:, None, None]
        innovations_m = np.array([r.innovation_m(self._estimate.__getitem__) for r in records])
        covariance_m2 = np.linalg.inv(information.sum(axis=0))
        mean_m = covariance_m2 @ np.einsum("nij,nj->i", information, innovations_m)
        return innovations_m[0] - mean_m, covariance_m2

    def _one_range(self, records: list[RangeRecord]) -> RangeRecord:
        """Return the one in the middle with the weighted mean of all innovations."""
        middle = records[len(records) // 2]
        weights = np.array([record.sigma_m**-2 for record in records])
        innovations_m = [r.innovation_m(self._estimate.__getitem__)[0] for r in records]
        mean_m = float(np.average(innovations_m, weights=weights))
        least_m = min(self._settings.range_floor_m, *(record.sigma_m for record in records))
        return replace(
            middle,
            range_m=middle.range_m + innovations_m[len(records) // 2] - mean_m,
            sigma_m=max(float(weights.sum() ** -0.5), least_m),
        )


def _keep(
    group: Group[Kept],
    composed: Callable[[list[Kept]], Kept],
    kept: dict[int, Entry],
    new: list[Record],
) -> None:
    """Let one record of a piece, or of two, stay as it is; several become a new one."""
    if len(group) == 1:
        [(number, record)] = group
        kept[number] = Entry(record=record, active=True)
    elif group:
        new.append(composed([record for _, record in group]))
