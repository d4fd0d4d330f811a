"""Which pairs of sub-maps are worth a match, and all that each of these matches needs."""

import dataclasses
import logging
from collections.abc import Set
from dataclasses import dataclass

import numpy as np

from firmware.geometry import Array
from firmware.leader.atlas import Atlas, Sheet, SheetId, overlap_m2
from firmware.leader.closure_settings import ClosureSettings
from firmware.leader.drift_search import DriftSearch, FoundDrift
from firmware.leader.estimate import Estimate
from firmware.leader.match_job import MatchJob
from firmware.leader.matches import MatchOutcome, NoMatch, PairSigmas
from firmware.leader.nonconvexity import Doubt
from firmware.leader.offsets import Offset, Offsets, anchor_of, corrections
from firmware.leader.pairing import Calibrations, Side, side_of, strain_m

LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What came of a batch: an outcome of each match, and which closures in doubt are false.

    The latter is None where none were in doubt, or the doubt has no solution; drift is what a
    search found, if there was one.
    """

    outcomes: list[MatchOutcome]
    false_closures: list[int] | None = None
    drift: FoundDrift | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SheetJobs:
    """The matches of one new sub-map, and second looks; run all, hand the findings to `finish`.

    Where closures contradict each other, they come as a doubt beside the matches; where nothing
    tells a vehicle's drift, with a search for it.
    """

    sheet: Sheet
    jobs: tuple[MatchJob, ...]
    doubt: Doubt | None = None
    search: DriftSearch | None = None

    def run(self) -> Findings:
        """Run all matches, in order; never raises: one that fails has no match for a reason."""
        return Findings(
            outcomes=[_outcome_of(job) for job in self.jobs],
            false_closures=None if self.doubt is None else _false_by(self.doubt),
            drift=None if self.search is None else _found_by(self.search),
        )


def _outcome_of(job: MatchJob) -> MatchOutcome:
    try:
        return job.run()
    except Exception:
        LOG.exception("the match of %s with %s failed", job.target.id, job.origin.id)
        return MatchOutcome(match=None, reason=NoMatch.RAISED)


def _false_by(doubt: Doubt) -> list[int] | None:
    try:
        return doubt.run()
    except Exception:
        LOG.exception("a doubt failed")
        return None


def _found_by(search: DriftSearch) -> FoundDrift | None:
    try:
        return search.run()
    except Exception:
        LOG.exception("a search for a drift failed")
        return None


def jobs_for(
    sheet: Sheet,
    atlas: Atlas,
    estimate: Estimate,
    offsets: Offsets,
    settings: ClosureSettings,
    calibrations: Calibrations,
) -> list[MatchJob]:
    """Return the matches worth trying for a new sheet, most overlap first, bounded in number.

    Pairs that the estimate knows well teach the calibrations first; then what the sonars do wrong
    is taken out of all. Raises EstimationError if the sheet itself hangs on no node.
    """
    chosen = _worth_trying(_ranked(sheet, atlas, estimate, offsets, settings), settings)
    return _jobs(sheet, chosen, estimate, settings, calibrations, learn=True)


def jobs_again(
    sheet: Sheet,
    partners: list[tuple[Offset, float, int | None]],
    estimate: Estimate,
    settings: ClosureSettings,
    calibrations: Calibrations,
) -> list[MatchJob]:
    """Return the matches of a sheet's open pairs whose offset is known much better by now.

    Offsets of the sheet come with the radius at the last look and the number of the hint that a
    look has left, if any: what the pair itself told is taken out of what is known, lest it confirm
    itself.
    """
    shrunk = []
    for known, radius_m, hint in partners:
        offset = known if hint is None else _without_hint(known, hint, estimate)
        values_m2 = np.linalg.eigvalsh(offset.covariance_m2)
        if (
            0.0 < values_m2[0]
            and np.prod(values_m2) <= (settings.second_look_share * radius_m) ** 4
        ):
            shrunk.append(offset)
    return _jobs(
        sheet,
        shrunk[: settings.pairs_per_submap],
        estimate,
        settings,
        calibrations,
        learn=False,
        have_hints={known.origin.id for known, _, hint in partners if hint is not None},
    )


def jobs_of(
    offsets: list[Offset], estimate: Estimate, settings: ClosureSettings, calibrations: Calibrations
) -> tuple[MatchJob, ...]:
    """Return the matches of pairs as the estimate has them now, whatever came of them before."""
    jobs = list[MatchJob]()
    for offset in offsets:
        jobs += _jobs(offset.target, [offset], estimate, settings, calibrations, learn=False)
    return tuple(jobs)


def _without_hint(offset: Offset, hint: int, estimate: Estimate) -> Offset:
    """Return an offset as if its hint had not been told; the ways to the nodes stay as they are."""
    origin, target, told = offset.origin, offset.target, estimate.closure(hint)
    reckoned_m = target.reckoned_at(target.time_s) - origin.reckoned_at(origin.time_s)
    return offset.without(told.offset_m - reckoned_m, told.covariance_m2)


def _ranked(
    sheet: Sheet, atlas: Atlas, estimate: Estimate, offsets: Offsets, settings: ClosureSettings
) -> list[Offset]:
    """Return how a new sheet lies to those that it may overlap, most overlap first."""
    others = [
        other
        for other in atlas
        if other.id != sheet.id
        and (
            other.id.vehicle != sheet.id.vehicle
            or abs(other.time_s - sheet.time_s) >= settings.shortest_gap_s
        )
    ]
    if not others:
        return []
    anchor_of(sheet, estimate)  # one that hangs on no node has no matches
    moves_m = corrections([sheet, *others], estimate)
    centres_m = np.array([other.centre_m for other in others]) + moves_m[1:]
    distances_m = np.hypot(*(centres_m - sheet.centre_m - moves_m[0]).T)
    nearest = np.argsort(distances_m, kind="stable")[: settings.screened_per_submap]
    ranked, known = [], offsets.of([(others[k], sheet) for k in nearest])
    for offset, spread_m in zip(known, _spreads([o.covariance_m2 for o in known]), strict=True):
        area_m2 = overlap_m2(offset.origin, sheet, offset.shift_m + spread_m).mean()
        if area_m2 >= settings.expected_overlap_m2:
            ranked.append((area_m2, offset))
    ranked.sort(key=lambda item: -item[0])
    return [offset for _, offset in ranked]


def _worth_trying(ranked: list[Offset], settings: ClosureSettings) -> list[Offset]:
    """Return the first of the ranked pairs, few of them with an offset known already."""
    chosen, known = [], 0
    for offset in ranked:
        is_known = offset.open_sigma_m <= settings.known_sigma_m
        known += is_known
        if not is_known or known <= settings.known_pairs_per_submap:
            chosen.append(offset)
    return chosen[: settings.pairs_per_submap]


def _spreads(covariances_m2: list[Array]) -> Array:
    """Return nine shifts each (N, 9, 2): none, one and two sigmas each way along both axes."""
    values, axes = np.linalg.eigh(np.reshape(covariances_m2, (-1, 2, 2)))
    arms_m = axes * np.sqrt(np.maximum(values, 0.0))[:, None]
    steps = np.array([[0, 0], [1, 0], [-1, 0], [2, 0], [-2, 0], [0, 1], [0, -1], [0, 2], [0, -2]])
    return np.asarray(steps @ arms_m.swapaxes(1, 2))


def _jobs(
    sheet: Sheet,
    chosen: list[Offset],
    estimate: Estimate,
    settings: ClosureSettings,
    calibrations: Calibrations,
    *,
    learn: bool,
    have_hints: Set[SheetId] = frozenset(),
) -> list[MatchJob]:
    """Return the matches of a sheet with others, given its offsets from them.

    With `learn` the pairs teach the calibrations first. No hint is asked of those that have one,
    nor of pairs of two vehicles.
    """
    if not chosen:
        return []
    target = side_of(sheet, estimate.trajectory(sheet.id.chain))
    pairs = []
    for offset in chosen:
        origin = side_of(offset.origin, estimate.trajectory(offset.origin.id.chain))
        if learn:
            calibrations.learn(origin, target, offset.shift_m, offset.covariance_m2)
        pairs.append((origin, offset))
    grid = calibrations.level(target)
    return [
        MatchJob(
            origin=origin.sheet,
            target=sheet,
            origin_grid=calibrations.level(origin),
            target_grid=grid,
            origin_drift_mps=origin.drift_mps,
            target_drift_mps=target.drift_mps,
            prior_shift_m=offset.shift_m,
            prior_covariance_m2=offset.covariance_m2,
            settings=calibrations.matching,
            sigmas=_strained(
                calibrations.sigmas_of(origin, target, offset.shift_m), origin, target, offset
            ),
            drifts=offset.drifts,
            hinted=_may_hint(offset, settings) and origin.sheet.id not in have_hints,
            looks=(calibrations.look_of(origin), calibrations.look_of(target)),
        )
        for origin, offset in pairs
    ]


def _may_hint(offset: Offset, settings: ClosureSettings) -> bool:
    """Return whether a pair that does not close may leave a hint.

    Error surfaces know no tilt, and on smooth seabed a tilt moves their minimum by tens of metres.
    A vehicle's own overlaps teach how its passes tilt against each other; how those of two vehicles
    do stays unknown for longer, and in missions only their hints led astray.
    """
    is_own = offset.origin.id.vehicle == offset.target.id.vehicle
    return is_own and offset.sigma_m >= settings.hint_prior_m


def _strained(sigmas: PairSigmas, origin: Side, target: Side, offset: Offset) -> PairSigmas:
    """Return the sigmas of a pair with what is not known of its drifts."""
    known_m2 = offset.covariance_m2
    drift_m2ps2 = offset.drifts.covariance(known_m2)
    expected_m = strain_m(origin, target, drift_m2ps2)
    left_m = strain_m(origin, target, offset.drifts.left)
    strained_m = min(float(np.hypot(left_m, offset.drifts.unresolved_m(known_m2))), expected_m)
    return dataclasses.replace(sigmas, strain_m=strained_m)
