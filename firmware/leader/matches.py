"""What matching is told and what it answers: settings, a match, or the reason for none."""

import enum
from dataclasses import dataclass, replace

from firmware.geometry import Array
from firmware.leader.calibration import CalibrationSettings
from protocol.settings import Settings, setting


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchingSettings(Settings):
    """How sub-maps are matched and when a match becomes a closure."""

    residual: str = setting(
        "squared",
        "",
        "the 0.02 of the paper lies above the noise only on the squared reading",
        choices=("squared", "absolute"),
    )
    residual_limit: float = setting(0.02, "m^2 or m", "the paper's threshold on E", minimum=0.0)
    residual_noise_ratio: float = setting(
        2.5, "", "E may be this many times the predicted noise where that is larger", minimum=0.0
    )
    minimum_overlap_m2: float = setting(
        480.0, "m^2", "the paper's N_T = 120 points of 2 m cells", minimum=0.0
    )
    coherent_overlap_m2: float = setting(
        1200.0,
        "m^2",
        "more overlap of like relief proves nothing new: a ripple fits farther on as well",
        minimum=0.0,
    )
    hint_overlap_m2: float = setting(
        4000.0, "m^2", "the same for a hint, which does not choose among ripples", minimum=0.0
    )
    search_sigmas: float = setting(3.0, "", "99 % of the prior's mass", minimum=1.0)
    search_cap_m: float = setting(200.0, "m", "beyond it sub-maps do not meet", minimum=1.0)
    basins: int = setting(4, "", "separate minima refined below the cell", minimum=1)
    absolute_depth: bool = setting(
        False, "", "the paper's: neither tide nor datum differs between passes"
    )
    calibration: CalibrationSettings = setting(
        CalibrationSettings, "", "swath errors learned from overlaps"
    )
    drift_sigma_mps: float = setting(
        0.03, "m/s", "drift within a sub-map that is left after its removal", minimum=0.0
    )
    walk_m2_per_s: float = setting(
        0.04, "m^2/s", "Eq. 12: variance 0.04 a second and axis", minimum=0.0
    )
    cell_sigma_m: float = setting(
        0.02, "m", "gridding and sub-cell relief beside the sounding noise", minimum=0.001
    )
    position_sigma_m: float = setting(
        0.5, "m", "heading noise and wandering inside a sub-map, felt on slopes", minimum=0.0
    )
    finest_wave_m: float = setting(
        17.0, "m", "twice the spacing of 150 pseudo points on a sub-map", minimum=0.1
    )
    correlation_m: float = setting(
        6.0, "m", "reach of a reconstruction's errors, below the spacing of its points", minimum=0.1
    )
    correlated_share: float = setting(
        0.8, "", "of a reconstruction's variance that neighbours share", minimum=0.0, maximum=1.0
    )
    basin_m: float = setting(5.0, "m", "further off a closure is called invalid", minimum=0.1)
    false_mass_limit: float = setting(
        0.02, "", "posterior mass that may lie outside the winner's basin", minimum=0.0, maximum=1.0
    )
    null_share: float = setting(
        0.01, "", "chance that the graph's prior is wrong altogether", minimum=0.0, maximum=1.0
    )
    evidence_limit: float = setting(
        3.0, "", "log evidence of the relief alone, whatever the prior says", minimum=0.0
    )
    sigma_limit_m: float = setting(
        2.0, "m", "a weaker shift could not be told from an invalid one", minimum=0.0
    )
    covariance_scale: float = setting(
        1.0, "", "from simulated pairs, so that NEES is 2", minimum=0.1
    )
    hint_scale: float = setting(
        2.5, "1", "of a hint's covariance: neighbouring pairs share soundings", minimum=1.0
    )
    hint_floor_m: float = setting(
        3.0, "m", "least sigma of a hint: an ambiguous pair places nothing better", minimum=0.0
    )
    hint_gain: float = setting(
        0.5, "", "share of the prior's variance that a hint must leave along some axis", minimum=0.0
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class PairSigmas:
    """What is not known of one pair of sub-maps, as standard deviations; all may be zero."""

    offset_m: float = 0.3  # tide and datum between the passes
    tilt: float = 0.004  # m/m; roll bias of 0.2 degree seen from both sides
    bend_per_m: float = 4e-5  # a smile of 0.15 m at the edge of a 60 m swath
    strain_m: float = 0.0  # between cells of both, by drift within them that is not known yet


ANY_PAIR = PairSigmas()  # of vehicles that nothing is known of


class NoMatch(enum.Enum):
    """Why two sub-maps gave no closure."""

    EMPTY = "a grid has no known cell"
    NO_OVERLAP = "no shift of the search window has enough overlap"
    FEATURELESS = "too little relief to tell a match from chance"
    RESIDUAL = "the least residual error is above the threshold"
    AMBIGUOUS = "another shift explains the data nearly as well"
    LOOSE = "the minimum is too wide in both directions"
    UNSETTLED = "no minimum could be refined below the cell"
    RAISED = "the match failed by an error of its own, which the log has"


@dataclass(frozen=True, slots=True, kw_only=True)
class Match:
    """A shift to add to the query's NED coordinates so that it lies on the reference.

    The shift holds between reference_time_s and query_time_s, the mean times at which the two
    measured the overlap. covariance_m2 (2, 2) is the measurement's own, without the prior. axis_deg
    is None, or the direction from north in which a one-axis closure holds; across it the covariance
    is wide. centre_m (2,) is the overlap's middle in the reference's coordinates. residual is the E
    that was judged; misfit the mean square over what the noise model predicts.
    """

    shift_m: Array
    covariance_m2: Array
    residual: float
    misfit: float
    overlap_cells: int
    axis_deg: float | None
    centre_m: Array
    reference_time_s: float
    query_time_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Hint:
    """What a pair that gave no closure still says of the shift, as a Gaussian.

    It is the factor that takes the prior to the first two moments of the posterior, widened by
    `hint_scale` and `hint_floor_m`: wide where several shifts compete, and narrower along an axis
    that they share. Along a ridge that goes on as far as the sub-maps overlap it says nothing. A
    search of drift finds one as well.
    """

    shift_m: Array
    covariance_m2: Array  # (2, 2), a kilometre along a direction without information

    def repeated(self, times: int) -> "Hint":
        """Return the hint as one that says what so many others have said already.

        However many they are, together they tell less than two: 1 + 1/4 + 1/9 ... < 1.65.
        """
        return replace(self, covariance_m2=(1 + times) ** 2 * self.covariance_m2)


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchOutcome:
    """A match, or the reason why there is none and the hint that may be left."""

    match: Match | None
    reason: NoMatch | None
    hint: Hint | None = None
