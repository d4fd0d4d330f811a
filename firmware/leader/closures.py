"""Loop closures: from what a match found to the gate and the ledger."""

import dataclasses
import enum
from dataclasses import dataclass

import numpy as np

from firmware.geometry import Array, offset_covariance
from firmware.leader.atlas import SheetId
from firmware.leader.closure_settings import ClosureSettings
from firmware.leader.displacement import displaced
from firmware.leader.ledger import Anchor
from firmware.leader.match_job import MatchJob
from firmware.leader.matches import Hint, MatchOutcome
from firmware.leader.offsets import anchor_of
from firmware.leader.pose_graph import PoseGraph


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
    misfit: float  # mean square over what the noise model predicts
    axis_deg: float | None
    origin_reckoned_m: Array  # (2,) raw dead reckoning at the anchors' times
    target_reckoned_m: Array
    predicted_sigma_m: float = np.inf  # of the offset, before this closure was known
    stage: Stage = Stage.DETECTED
    number: int | None = None  # in the ledger, once gated
    active: bool = False


def closure_of(
    job: MatchJob, outcome: MatchOutcome, graph: PoseGraph, now_s: float
) -> Closure | None:
    """Return the closure that a match found, or None.

    The shift is between grids that agree with dead reckoning at the times of their sheets; the
    closure is between the positions at the mean times of the overlap, and corrected for where both
    sonars really looked.
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
    aside_m, aside_m2 = displaced(job.looks, (anchors[0].lever_m, anchors[1].lever_m))
    return Closure(
        time_s=now_s,
        origin=job.origin.id,
        target=job.target.id,
        origin_anchor=anchors[0],
        target_anchor=anchors[1],
        offset_m=ends_m[1] + found.shift_m - ends_m[0] + aside_m,
        covariance_m2=found.covariance_m2 + aside_m2,
        residual=found.residual,
        misfit=found.misfit,
        axis_deg=found.axis_deg,
        origin_reckoned_m=job.origin.reckoned_at(found.reference_time_s),
        target_reckoned_m=job.target.reckoned_at(found.query_time_s),
    )


def enter_hint(
    job: MatchJob, hint: Hint, graph: PoseGraph, settings: ClosureSettings
) -> int | None:
    """Enter a hint, active; return its number, or None where the graph knows as much already.

    Raises EstimationError where a sub-map hangs on no node.
    """
    if job.prior_sigma_m < settings.hint_prior_m:
        return None
    walk_m2 = job.settings.walk_m2_per_s * settings.hint_span_s
    return graph.add_closure(
        anchor_of(job.origin, graph),
        anchor_of(job.target, graph),
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
    passed = []
    for k, closure in enumerate(closures):
        ends = slice(4 * k, 4 * k + 4)
        prior_m2 = offset_covariance(joint_m2[ends, ends])
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
