"""Loop closures: which pairs of sub-maps to match, and what becomes of what the match finds."""

import contextlib
import dataclasses
import enum
from dataclasses import dataclass

import numpy as np

from firmware.geometry import Array
from firmware.leader.atlas import Atlas, Sheet, SheetId, overlap_m2
from firmware.leader.ledger import Anchor
from firmware.leader.matching import Hint, MatchingSettings, MatchOutcome, match
from firmware.leader.pairing import Calibrations, side_of
from firmware.leader.pose_graph import PoseGraph
from firmware.submaps import GriddedSubmap
from protocol.errors import EstimationError
from protocol.settings import Settings, setting


@dataclass(frozen=True, slots=True, kw_only=True)
class ClosureSettings(Settings):
    """How many pairs are tried, and what a closure must withstand."""

    pairs_per_submap: int = setting(
        12, "pairs", "bounds the work of one sub-map to a tenth of a second", minimum=1
    )
    known_pairs_per_submap: int = setting(
        3, "pairs", "of those whose offset is known already; more would say it again", minimum=1
    )
    known_sigma_m: float = setting(
        2.0, "m", "an offset so well known is known; a match tells it to half a metre", minimum=0.1
    )
    screened_per_submap: int = setting(
        48, "sub-maps", "nearest ones whose joint covariance is asked for", minimum=1
    )
    second_looks: int = setting(
        3,
        "sub-maps",
        "asked with each new one whether their open pairs are known better",
        minimum=0,
    )
    second_look_share: float = setting(
        0.5, "1", "of the sigma at the last look: then an open pair is looked at again", minimum=0.0
    )
    open_submaps: int = setting(
        256, "sub-maps", "with open pairs; the longest not looked at go", minimum=1
    )
    shortest_gap_s: float = setting(
        41.0, "s", "nearer in time, sub-maps of one vehicle share their soundings", minimum=0.0
    )
    expected_overlap_m2: float = setting(
        300.0, "m^2", "mean over the prior; a match needs 480 m^2", minimum=0.0
    )
    hint_prior_m: float = setting(
        8.0,
        "m",
        "an offset known better than so learns nothing from an ambiguous pair",
        minimum=0.0,
    )
    hint_span_s: float = setting(
        40.0, "s", "dead reckoning between the overlap and the middles of the sub-maps", minimum=0.0
    )
    gate_chi_square: float = setting(
        13.8, "1", "99.9 % of true innovations of two components pass", minimum=1.0
    )


class Stage(enum.StrEnum):
    """The last test that a closure has passed."""

    DETECTED = "detected"
    GATED = "gated"
    CONSISTENT = "consistent"


@dataclass(slots=True, kw_only=True)
class Closure:
    """A detected closure: the offset of `target` from `origin` (2,) and how far it has come."""

    time_s: float
    origin: SheetId
    target: SheetId
    origin_anchor: Anchor
    target_anchor: Anchor
    offset_m: Array
    covariance_m2: Array
    residual: float
    misfit: float  # residual over what the noise model predicts
    axis_deg: float | None
    origin_reckoned_m: Array  # (2,) raw dead reckoning at the anchors' times
    target_reckoned_m: Array
    predicted_sigma_m: float = np.inf  # of the offset, before this closure was known
    stage: Stage = Stage.DETECTED
    number: int | None = None  # in the ledger, once gated
    active: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchJob:
    """Everything one match needs, so that it can run beside the loop."""

    origin: Sheet
    target: Sheet
    origin_grid: GriddedSubmap
    target_grid: GriddedSubmap
    origin_drift_mps: Array
    target_drift_mps: Array
    prior_shift_m: Array
    prior_covariance_m2: Array
    settings: MatchingSettings

    @property
    def prior_sigma_m(self) -> float:
        """How well the offset was known before the match, in its worst direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self.prior_covariance_m2)[-1]))

    def run(self) -> MatchOutcome:
        """Match the pair."""
        return match(
            self.origin_grid,
            self.target_grid,
            self.prior_shift_m,
            self.prior_covariance_m2,
            self.settings,
            reference_reconstructed=self.origin.reconstructed,
            query_reconstructed=self.target.reconstructed,
        )


def jobs_for(
    sheet: Sheet,
    atlas: Atlas,
    graph: PoseGraph,
    settings: ClosureSettings,
    matching: MatchingSettings,
    calibrations: Calibrations | None = None,
) -> list[MatchJob]:
    """Return the matches worth trying for a new sheet, most overlap first, bounded in number.

    Pairs that the graph knows well teach the calibrations first (new ones, if none are given);
    then what the sonars do wrong is taken out of all.

    Raises EstimationError if the sheet itself hangs on no node.
    """
    own_m = _correction(sheet, graph)
    chosen = [
        (other, covariance_m2, own_m - _correction(other, graph))
        for other, covariance_m2 in _worth_trying(_ranked(sheet, atlas, graph, settings), settings)
    ]
    return _jobs(sheet, chosen, graph, calibrations or Calibrations(matching), learn=True)


def jobs_again(
    sheet: Sheet,
    partners: list[tuple[Sheet, float, int | None]],
    graph: PoseGraph,
    settings: ClosureSettings,
    calibrations: Calibrations,
) -> list[MatchJob]:
    """Return the matches of a sheet's open pairs whose offset others have told much better by now.

    partners come with the sigma at the last look and the number of the hint that a look has left,
    if any: what the pair itself told is taken out of what is known, lest it confirm itself. Raises
    EstimationError if the sheet itself hangs on no node.
    """
    open_pairs = {other.id: (sigma_m, hint) for other, sigma_m, hint in partners}
    shrunk, own_m = [], _correction(sheet, graph)
    for other, known_m2 in _offset_covariances(sheet, [p[0] for p in partners], graph):
        sigma_m, hint = open_pairs[other.id]
        shift_m, covariance_m2 = own_m - _correction(other, graph), known_m2
        if hint is not None:
            reckoned_m = sheet.reckoned_at(sheet.time_s) - other.reckoned_at(other.time_s)
            told = graph.closure(hint)
            told_m = told.offset_m - reckoned_m
            shift_m, covariance_m2 = _without(shift_m, known_m2, told_m, told.covariance_m2)
        values_m2 = np.linalg.eigvalsh(covariance_m2)
        if 0.0 < values_m2[0] and values_m2[1] <= (settings.second_look_share * sigma_m) ** 2:
            shrunk.append((other, covariance_m2, shift_m))
    return _jobs(sheet, shrunk[: settings.pairs_per_submap], graph, calibrations, learn=False)


def _without(
    mean_m: Array, covariance_m2: Array, told_m: Array, told_m2: Array
) -> tuple[Array, Array]:
    """Return mean and covariance of a Gaussian from which one of its factors is taken out."""
    told, known = np.linalg.inv(told_m2), np.linalg.inv(covariance_m2)
    left_m2 = np.linalg.inv(known - told)
    return left_m2 @ (known @ mean_m - told @ told_m), left_m2


def _jobs(
    sheet: Sheet,
    chosen: list[tuple[Sheet, Array, Array]],
    graph: PoseGraph,
    calibrations: Calibrations,
    *,
    learn: bool,
) -> list[MatchJob]:
    """Return the matches with other sheets, given with covariance and shift of their offset."""
    if not chosen:
        return []
    target = side_of(sheet, graph.trajectory(sheet.id.chain))
    pairs = []
    for other, covariance_m2, shift_m in chosen:
        origin = side_of(other, graph.trajectory(other.id.chain))
        if learn:
            calibrations.learn(origin, target, shift_m, covariance_m2)
        pairs.append((origin, shift_m, covariance_m2))
    grid = calibrations.level(target)
    return [
        MatchJob(
            origin=origin.sheet,
            target=sheet,
            origin_grid=calibrations.level(origin),
            target_grid=grid,
            origin_drift_mps=origin.drift_mps,
            target_drift_mps=target.drift_mps,
            prior_shift_m=shift_m,
            prior_covariance_m2=covariance_m2,
            settings=calibrations.matching_of(origin, target, shift_m),
        )
        for origin, shift_m, covariance_m2 in pairs
    ]


def closure_of(
    job: MatchJob, outcome: MatchOutcome, graph: PoseGraph, now_s: float
) -> Closure | None:
    """Return the closure that a match found, or None.

    The shift lies between the grids as they agree with dead reckoning at their own instants; the
    closure is stated between the positions at the mean times of the overlap.
    """
    if outcome.match is None:
        return None
    found = outcome.match
    ends_m, anchors = [], []
    for sheet, drift_mps, time_s, centre_m in (
        (job.origin, job.origin_drift_mps, found.reference_time_s, found.centre_m),
        (job.target, job.target_drift_mps, found.query_time_s, found.centre_m - found.shift_m),
    ):
        ends_m.append(sheet.reckoned_at(time_s) - drift_mps * (time_s - sheet.time_s))
        anchor = graph.anchor(sheet.id.chain, time_s, sheet.track)
        anchors.append(dataclasses.replace(anchor, lever_m=centre_m - ends_m[-1]))
    return Closure(
        time_s=now_s,
        origin=job.origin.id,
        target=job.target.id,
        origin_anchor=anchors[0],
        target_anchor=anchors[1],
        offset_m=ends_m[1] + found.shift_m - ends_m[0],
        covariance_m2=found.covariance_m2,
        residual=found.residual,
        misfit=found.residual / found.variance_m2,
        axis_deg=found.axis_deg,
        origin_reckoned_m=job.origin.reckoned_at(found.reference_time_s),
        target_reckoned_m=job.target.reckoned_at(found.query_time_s),
    )


def enter_hint(
    job: MatchJob, hint: Hint, graph: PoseGraph, settings: ClosureSettings
) -> int | None:
    """Let a hint lean on the estimate; return its number, None where the graph knows as much.

    Raises EstimationError where a sub-map hangs on no node.
    """
    if job.prior_sigma_m < settings.hint_prior_m:
        return None
    walk_m2 = job.settings.walk_m2_per_s * settings.hint_span_s
    return graph.add_closure(
        _anchor(job.origin, graph),
        _anchor(job.target, graph),
        job.target.reckoned_at(job.target.time_s)
        + hint.shift_m
        - job.origin.reckoned_at(job.origin.time_s),
        hint.covariance_m2 + walk_m2 * np.eye(2),
        active=True,
    )


def gated(closures: list[Closure], graph: PoseGraph, settings: ClosureSettings) -> list[Closure]:
    """Enter in the ledger those closures whose innovation the graph finds possible; return them.

    Raises EstimationError if the graph can say nothing.
    """
    if not closures:
        return []
    anchors = [anchor for c in closures for anchor in (c.origin_anchor, c.target_anchor)]
    joint_m2 = graph.covariance(anchors)
    between = np.hstack([-np.eye(2), np.eye(2)])
    passed = []
    for k, closure in enumerate(closures):
        ends = slice(4 * k, 4 * k + 4)
        prior_m2 = between @ joint_m2[ends, ends] @ between.T
        spread_m2 = prior_m2 + closure.covariance_m2
        predicted_m = graph.offset(closure.origin_anchor, closure.target_anchor)
        innovation_m = closure.offset_m - predicted_m
        if innovation_m @ np.linalg.solve(spread_m2, innovation_m) > settings.gate_chi_square:
            continue
        closure.stage = Stage.GATED
        largest_m2 = float(np.linalg.eigvalsh(prior_m2)[-1])
        closure.predicted_sigma_m = float(np.sqrt(max(largest_m2, 0.0)))
        closure.number = graph.add_closure(
            closure.origin_anchor,
            closure.target_anchor,
            closure.offset_m,
            closure.covariance_m2,
            active=False,
        )
        passed.append(closure)
    return passed


def corrections(sheets: list[Sheet], graph: PoseGraph) -> Array:
    """Return what is to be added (S, 2) to each sheet's dead reckoning at its time."""
    found_m, chains = np.zeros((len(sheets), 2)), np.array([sheet.id.chain for sheet in sheets])
    times_s = np.array([sheet.time_s for sheet in sheets])
    for chain in dict.fromkeys(chains.tolist()):
        rows = np.flatnonzero(chains == chain)
        found_m[rows] = graph.trajectory(chain).correct(times_s[rows], np.zeros((rows.size, 2)))
    return found_m


def _correction(sheet: Sheet, graph: PoseGraph) -> Array:
    trajectory = graph.trajectory(sheet.id.chain)
    reckoned_m = sheet.reckoned_at(sheet.time_s)
    return trajectory.correct(sheet.time_s, reckoned_m) - reckoned_m


def _ranked(
    sheet: Sheet, atlas: Atlas, graph: PoseGraph, settings: ClosureSettings
) -> list[tuple[Sheet, Array]]:
    """Return the sheets that may overlap a new one, most first, with the offset's covariance."""
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
    moves_m = corrections(others, graph)
    centres_m = np.array([other.centre_m for other in others]) + moves_m
    own_m = _correction(sheet, graph)
    distances_m = np.hypot(*(centres_m - sheet.centre_m - own_m).T)
    nearest = np.argsort(distances_m, kind="stable")[: settings.screened_per_submap]
    move_m = {others[k].id: moves_m[k] for k in nearest}
    ranked = []
    for other, covariance_m2 in _offset_covariances(sheet, [others[k] for k in nearest], graph):
        shift_m = own_m - move_m[other.id]
        area_m2 = overlap_m2(other, sheet, shift_m + _spread(covariance_m2)).mean()
        if area_m2 >= settings.expected_overlap_m2:
            ranked.append((area_m2, other, covariance_m2))
    ranked.sort(key=lambda item: -item[0])
    return [(other, covariance_m2) for _, other, covariance_m2 in ranked]


def _offset_covariances(
    sheet: Sheet, others: list[Sheet], graph: PoseGraph
) -> list[tuple[Sheet, Array]]:
    """Return the covariance (2, 2) in m^2 of each other sheet's offset from one.

    Those that hang on no node are left out: frames were lost there.
    """
    anchors, placed = [_anchor(sheet, graph)], []
    for other in others:
        with contextlib.suppress(EstimationError):
            anchors.append(_anchor(other, graph))
            placed.append(other)
    joint_m2 = graph.covariance(anchors).reshape(len(anchors), 2, len(anchors), 2)
    found = []
    for k, other in enumerate(placed, start=1):
        cross_m2 = joint_m2[0, :, k]
        found.append((other, joint_m2[0, :, 0] + joint_m2[k, :, k] - cross_m2 - cross_m2.T))
    return found


def _worth_trying(
    ranked: list[tuple[Sheet, Array]], settings: ClosureSettings
) -> list[tuple[Sheet, Array]]:
    """Return the first of the ranked pairs, but few whose offset is known before the match."""
    chosen, known = [], 0
    for other, covariance_m2 in ranked:
        is_known = np.linalg.eigvalsh(covariance_m2)[-1] <= settings.known_sigma_m**2
        known += bool(is_known)
        if not is_known or known <= settings.known_pairs_per_submap:
            chosen.append((other, covariance_m2))
    return chosen[: settings.pairs_per_submap]


def _spread(covariance_m2: Array) -> Array:
    """Return nine shifts (9, 2): none, and one and two sigmas each way along both axes."""
    values, axes = np.linalg.eigh(covariance_m2)
    arms_m = axes * np.sqrt(np.maximum(values, 0.0))
    steps = np.array([[0, 0], [1, 0], [-1, 0], [2, 0], [-2, 0], [0, 1], [0, -1], [0, 2], [0, -2]])
    return np.asarray(steps @ arms_m.T)


def _anchor(sheet: Sheet, graph: PoseGraph) -> Anchor:
    return graph.anchor(sheet.id.chain, sheet.time_s, sheet.track)
