"""Which pairs of sub-maps are matched, and what a closure must withstand, in numbers."""

from dataclasses import dataclass

from protocol.errors import ConfigError
from protocol.settings import Settings, setting


@dataclass(frozen=True, slots=True, kw_only=True)
class ClosureSettings(Settings):
    """How many pairs are tried, and what a closure must withstand."""

    pairs_per_submap: int = setting(
        12, "pairs", "a tenth of a second of work; some seconds while drift is unknown", minimum=1
    )
    known_pairs_per_submap: int = setting(
        3, "pairs", "of them whose offset is known already; more would only repeat it", minimum=1
    )
    known_sigma_m: float = setting(
        2.0,
        "m",
        "from here on an offset counts as known; a match tells it to half a metre",
        minimum=0.1,
    )
    screened_per_submap: int = setting(
        48, "sub-maps", "nearest ones whose joint covariance is asked for", minimum=1
    )
    second_looks: int = setting(
        3,
        "sub-maps",
        "whose open pairs are reviewed with each new one",
        minimum=0,
    )
    second_look_share: float = setting(
        0.7, "1", "of the radius at the last look: half the area to look for a pair in", minimum=0.0
    )
    open_submaps: int = setting(
        256, "sub-maps", "with open pairs; those not looked at for longest go", minimum=1
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
        "an offset known better than this learns nothing from an ambiguous pair",
        minimum=0.0,
    )
    hint_span_s: float = setting(
        40.0, "s", "dead reckoning between the overlap and the middles of the sub-maps", minimum=0.0
    )
    gate_chi_square: float = setting(
        13.8, "1", "99.9 % of true innovations of two components pass", minimum=1.0
    )
    drift_pairs: int = setting(
        8, "pairs", "of a vehicle's own sub-maps that a search of their drift weighs", minimum=1
    )
    drift_least_pairs: int = setting(
        5, "pairs", "fewer may repeat each other by chance: the same hill for another", minimum=1
    )
    drift_memory_s: float = setting(
        900.0, "s", "of pairs that are weighed; drift wanders in longer times", minimum=60.0
    )
    drift_interval_s: float = setting(
        80.0, "s", "between searches: two seconds of work each, while drift is unknown", minimum=1.0
    )
    drift_known_mps: float = setting(
        0.04, "m/s", "a drift known better than this is left to the closures", minimum=0.0
    )

    def __post_init__(self) -> None:
        # super() does not survive the new class that slots=True makes
        Settings.__post_init__(self)
        if self.drift_least_pairs > self.drift_pairs:
            raise ConfigError(
                f"drift_least_pairs is {self.drift_least_pairs}; a search of drift_pairs, "
                f"{self.drift_pairs}, can have no more"
            )
