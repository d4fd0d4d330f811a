"""What the leader's estimate leaves open, and the manoeuvre that would tell most of it."""

import logging

import numpy as np

from firmware.geometry import Array
from firmware.leader.atlas import Atlas, Sheet
from firmware.leader.estimate import Estimate
from firmware.leader.fleet import Fleet
from firmware.leader.manoeuvre import (
    Ground,
    ManoeuvreSettings,
    Proposal,
    Situation,
    propose,
    relief_information,
)
from firmware.leader.matches import MatchingSettings
from firmware.leader.observability import Observability, observe
from firmware.leader.offsets import anchor_of, corrections
from firmware.submaps import GriddedSubmap
from protocol.errors import EstimationError
from protocol.vehicles import name_of

LOG = logging.getLogger(__name__)
MOST_GROUND = 32  # sub-maps whose joint covariance is asked for
APART_M = 60.0  # nearer ones tell the same
_VELOCITY_OVER_S = 20.0


class Outlook:
    """What can be said of the newest states of all vehicles, and of how to know them better.

    These are remarks only: where one cannot be made, compositions and records go on without it.
    """

    def __init__(
        self,
        fleet: Fleet,
        estimate: Estimate,
        atlas: Atlas,
        settings: ManoeuvreSettings,
        matching: MatchingSettings,
    ) -> None:
        self._noted: Observability | None = None
        self._fleet, self._estimate, self._atlas = fleet, estimate, atlas
        self._settings, self._matching = settings, matching

    def observe(self, now_s: float) -> Observability | None:
        """Return what the geometry leaves open of the vehicles' newest states; None if unknown."""
        vehicles, estimate = self._fleet.vehicles(), self._estimate
        names = [name_of(vehicle) for vehicle in vehicles]
        try:
            chains = [self._fleet.newest_chain(vehicle) for vehicle in vehicles]
            joint, reckoned = (
                estimate.newest_covariance(chains, reckoned=alone) for alone in (False, True)
            )
            positions_m = [estimate.trajectory(chain).position_m[-1] for chain in chains]
            return observe(now_s, names, np.array(positions_m), joint, reckoned)
        except (EstimationError, np.linalg.LinAlgError):
            return None
        except Exception:
            LOG.exception("what the geometry leaves open was not found")
            return None

    def note(self, now_s: float) -> None:
        """Keep what is to be observed now for the status."""
        self._noted = self.observe(now_s)

    def propose(self) -> Proposal | None:
        """Return the manoeuvre that would help most, if one would."""
        try:
            return propose(self._situation(), self._settings)
        except (EstimationError, np.linalg.LinAlgError):
            return None
        except Exception:
            LOG.exception("no manoeuvre was found")
            return None

    def status(self) -> dict[str, int]:
        """Return what was noted last, in numbers for a status line."""
        seen = self._noted
        if seen is None:
            return {}
        return {
            "joint_sigma_cm": round(100.0 * seen.worst_m),
            "undetermined_quantities": sum(q.is_undetermined for q in seen.quantities),
            "undetermined_directions": seen.blind,
        }

    def _situation(self) -> Situation:
        """Return where everyone is and what is known of the ground in reach.

        Raises EstimationError if the estimate can say nothing.
        """
        vehicles, estimate, settings = self._fleet.vehicles(), self._estimate, self._settings
        chains = [self._fleet.newest_chain(vehicle) for vehicle in vehicles]
        positions_m = np.array([estimate.trajectory(chain).position_m[-1] for chain in chains])
        velocities_mps = np.array([_velocity(self._fleet, estimate, chain) for chain in chains])
        reach_m = float(np.hypot(*velocities_mps.T).max()) * settings.horizon_s
        sheets, places_m = _in_reach(list(self._atlas), estimate, positions_m, reach_m)
        anchors = [anchor_of(sheet, estimate) for sheet in sheets]
        return Situation(
            names=tuple(name_of(vehicle) for vehicle in vehicles),
            positions_m=positions_m,
            velocities_mps=velocities_mps,
            ground=tuple(
                Ground(
                    position_m=place_m,
                    information=_told(sheet.grid, self._matching, settings.closure_floor_m),
                )
                for sheet, place_m in zip(sheets, places_m, strict=True)
            ),
            joint=estimate.newest_with(chains, anchors),
            wandering=estimate.wandering,
        )


def _told(grid: GriddedSubmap, matching: MatchingSettings, floor_m: float) -> Array:
    variance_m2 = float(np.nanmedian(grid.variance_m2)) + matching.cell_sigma_m**2
    redundancy = matching.calibration.redundancy
    return relief_information(grid.depth_m, grid.cell_m, variance_m2, redundancy, floor_m)


def _velocity(fleet: Fleet, estimate: Estimate, chain: int) -> Array:
    track = fleet.track(chain)
    end_s = float(track.time_s[-1])
    ends_s = np.array([max(end_s - _VELOCITY_OVER_S, float(track.time_s[0])), end_s])
    ends_m = estimate.trajectory(chain).correct(ends_s, track.position_at(ends_s))
    return np.asarray((ends_m[1] - ends_m[0]) / max(ends_s[1] - ends_s[0], 1.0))


def _in_reach(
    sheets: list[Sheet], estimate: Estimate, positions_m: Array, reach_m: float
) -> tuple[list[Sheet], list[Array]]:
    """Return sub-maps in reach of a vehicle and where they lie, the oldest of each place."""
    chosen: list[Sheet] = []
    places_m: list[Array] = []
    moves_m = corrections(sheets, estimate)
    for sheet, move_m in sorted(zip(sheets, moves_m, strict=True), key=lambda s: s[0].time_s):
        place_m = sheet.centre_m + move_m
        near_m = np.hypot(*(positions_m - place_m).T).min()
        apart_m = np.hypot(*(np.array(places_m) - place_m).T).min() if places_m else np.inf
        if near_m <= reach_m and apart_m >= APART_M and len(chosen) < MOST_GROUND:
            chosen.append(sheet)
            places_m.append(place_m)
    return chosen, places_m
