"""Scenarios: what is surveyed, by whom, with which errors, so that figures compare."""

import math
import tomllib
from dataclasses import dataclass, field
from pathlib import Path

from protocol.acoustics import WaterSettings
from protocol.errors import ConfigError
from protocol.settings import Settings, replace, setting

KNOT_MPS = 1852.0 / 3600.0
MOST_TICKS_HZ = 40


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioSettings(Settings):
    """Everything about a simulated survey that is not the vehicles' own configuration.

    The defaults are the paper's simulation 1. Effects that a real survey adds are off by default.
    """

    name: str = setting("paper-1", "", "the scenario that the values started from")

    duration_min: float = setting(
        40.0, "min", "the leader's mission (paper, 6.2)", minimum=0.5, maximum=7 * 1440.0
    )
    follower_duration_min: float = setting(
        30.0, "min", "after it a follower's sonar is off", minimum=0.5, maximum=7 * 1440.0
    )
    followers: int = setting(1, "", "vehicles beside the leader", minimum=0, maximum=4)

    leg_m: float = setting(600.0, "m", "length of a survey line", minimum=20.0, maximum=20e3)
    line_spacing_m: float = setting(100.0, "m", "between neighbouring lines", minimum=10.0)
    block_lines: int = setting(
        0, "", "lines before the block is surveyed again; 0: leg_m / line_spacing_m + 1", minimum=0
    )
    resurvey_shift_share: float = setting(
        0.5,
        "",
        "lines of a repeated block shift by up to this share of the spacing",
        minimum=0.0,
        maximum=1.0,
    )
    corner_offset_m: float = setting(50.0, "m", "the follower's corner, north and east of ours")
    speed_mps: float = setting(4 * KNOT_MPS, "m/s", "4 knots", minimum=0.2, maximum=10.0)
    turn_rate_dps: float = setting(
        10.0, "deg/s", "fastest turn of a torpedo-shaped vehicle", minimum=0.5, maximum=90.0
    )
    wander_m: float = setting(
        10.0, "m", "how far a follower drifts from its end point", minimum=0.0, maximum=200.0
    )
    roll_amplitude_deg: float = setting(1.0, "deg", "motion of the hull", minimum=0.0, maximum=20.0)
    pitch_amplitude_deg: float = setting(
        0.5, "deg", "motion of the hull", minimum=0.0, maximum=20.0
    )

    vehicle_depth_m: float = setting(10.0, "m", "constant depth of all vehicles", minimum=0.0)
    altitude_m: float = setting(
        40.0, "m", "mean height above the seabed of the survey", minimum=5.0, maximum=500.0
    )
    minimum_altitude_m: float = setting(15.0, "m", "no seabed is nearer than this", minimum=1.0)
    survey_north_m: float | None = setting(
        None, "m", "northing of the leader's first corner in the terrain's projection; none: chosen"
    )
    survey_east_m: float | None = setting(None, "m", "easting of the same corner; none: chosen")
    relief_seed: int = setting(1, "", "of the built-in seabed, used without a terrain", minimum=0)
    roughness: bool = setting(
        False, "", "add relief below the terrain's cell that continues its spectrum"
    )

    beams: int = setting(192, "", "beams of the sonar (paper, 6.1)", minimum=2, maximum=2048)
    swath_deg: float = setting(120.0, "deg", "opening angle", minimum=10.0, maximum=150.0)
    ping_hz: float = setting(
        4.0, "Hz", "pings a second; navigation comes with each", minimum=0.5, maximum=20.0
    )
    sounding_sigma_m: float = setting(0.15, "m", "noise of a slant range", minimum=0.0, maximum=5.0)
    sounding_sigma_share: float = setting(
        0.003, "", "the same as a share of the range, in quadrature", minimum=0.0, maximum=0.2
    )
    flier_share: float = setting(0.0, "", "beams that are plainly wrong", minimum=0.0, maximum=0.5)
    heading_noise_deg: float = setting(0.1, "deg", "paper, 6.2", minimum=0.0, maximum=10.0)
    attitude_noise_deg: float = setting(
        0.01, "deg", "of roll and pitch (paper, 6.2)", minimum=0.0, maximum=10.0
    )
    roll_bias_deg: float = setting(0.0, "deg", "misaligned sonar head", minimum=-5.0, maximum=5.0)
    sound_speed_error_mps: float = setting(
        0.0, "m/s", "true less assumed: the refraction smile", minimum=-50.0, maximum=50.0
    )
    depth_wander_m: float = setting(
        0.0, "m", "amplitude of tide and depth sensor offset", minimum=0.0, maximum=10.0
    )

    drift_mean_mps: float = setting(
        0.1, "m/s", "mean of Eq. 12's noise, north and east", minimum=-2.0, maximum=2.0
    )
    drift_variance: float = setting(0.04, "m2", "variance of Eq. 12's noise", minimum=0.0)
    drift_directions_drawn: bool = setting(
        False, "", "draw the direction of each vehicle's drift and the signs of its biases"
    )
    heading_bias_deg: float = setting(
        0.0, "deg", "in heading and dead reckoning", minimum=-20.0, maximum=20.0
    )
    heading_bias_told_deg: float = setting(
        0.1,
        "deg",
        "its sigma that the leader is told, as by a data sheet, true or not",
        minimum=1e-6,
    )
    log_scale: float = setting(
        0.0, "", "relative error of the speed log", minimum=-0.5, maximum=0.5
    )
    log_scale_told: float = setting(
        0.002, "", "its sigma that the leader is told, as by a data sheet", minimum=1e-9
    )
    current_mps: float = setting(
        0.0, "m/s", "unseen by dead reckoning, the same for all", minimum=0.0, maximum=5.0
    )
    current_period_min: float = setting(60.0, "min", "one turn of the current", minimum=1.0)

    gnss_fix_every_min: float = setting(
        0.0, "min", "the leader surfaces for a fix; 0: never", minimum=0.0
    )
    gnss_sigma_m: float = setting(3.0, "m", "error of a fix, each axis", minimum=0.01)
    start_error_m: float = setting(
        0.0, "m", "sigma of where vehicles are told they begin, each axis", minimum=0.0
    )

    water: WaterSettings = field(default_factory=WaterSettings)

    @property
    def lines(self) -> int:
        """How many lines make the block."""
        return self.block_lines or max(2, round(self.leg_m / self.line_spacing_m) + 1)

    @property
    def turn_diameter_m(self) -> float:
        """The tightest half circle that the turn rate allows."""
        return 2.0 * self.speed_mps / math.radians(self.turn_rate_dps)

    @property
    def duration_s(self) -> float:
        """How long the mission lasts, in seconds."""
        return 60.0 * self.duration_min

    @property
    def tick_hz(self) -> int:
        """The rate of the mission's clock and of navigation, a whole number.

        Frames leave and outputs stand on whole seconds, which must be ticks for that. It is the
        least rate at which each ping falls on a tick, too; where none up to `MOST_TICKS_HZ` has
        that, it is this one, and pings wait for the next tick.
        """
        rates = range(math.ceil(self.ping_hz), MOST_TICKS_HZ)
        exact = (hz for hz in rates if math.isclose(hz / self.ping_hz, round(hz / self.ping_hz)))
        return next(exact, MOST_TICKS_HZ)

    @property
    def tick_s(self) -> float:
        """The time between two ticks."""
        return 1.0 / self.tick_hz

    def survey_s(self, vehicle: int) -> float:
        """Return for how long a vehicle (0: leader) surveys, in seconds, within the mission."""
        followers_min = min(self.follower_duration_min, self.duration_min)
        return 60.0 * (self.duration_min if vehicle == 0 else followers_min)

    def check(self) -> None:
        """Raise ConfigError when values that are right alone do not fit together."""
        if self.block_lines == 1:
            raise ConfigError("block_lines is 1; give 0, or 2 or more: one line is no block")
        diameter_m = self.turn_diameter_m
        if self.line_spacing_m < diameter_m:
            raise ConfigError(
                f"line_spacing_m is {self.line_spacing_m:g} m; a vehicle "
                f"that makes {self.speed_mps:.2f} m/s and turns at {self.turn_rate_dps:g} deg/s "
                f"needs at least {diameter_m:.1f} m"
            )
        if (self.survey_north_m is None) != (self.survey_east_m is None):
            raise ConfigError("give both survey_north_m and survey_east_m, or neither")


SCENARIOS: dict[str, dict[str, object]] = {
    "paper-1": {},
    "paper-2": {"duration_min": 55.0, "follower_duration_min": 50.0, "leg_m": 800.0},
    "field-1": {
        "roll_bias_deg": 0.2,
        "sound_speed_error_mps": 2.0,
        "depth_wander_m": 0.3,
        "heading_bias_deg": 0.5,
        "heading_bias_told_deg": 0.5,
        "log_scale": 0.005,
        "log_scale_told": 0.005,
        "current_mps": 0.2,
        "flier_share": 0.01,
        "roughness": True,
        "drift_directions_drawn": True,
    },
    "day-1": {"duration_min": 1440.0, "follower_duration_min": 1440.0},
}


def named_scenario(name: str) -> ScenarioSettings:
    """Return one of the named scenarios.

    Raises
    ------
    ConfigError
        For an unknown name; the message lists the known ones.
    """
    if name not in SCENARIOS:
        raise ConfigError(
            f"unknown scenario {name!r}; choose one of {', '.join(SCENARIOS)}, or a .toml file"
        )
    return replace(ScenarioSettings(name=name), SCENARIOS[name])


def load_scenario(name_or_path: str) -> ScenarioSettings:
    """Return a named scenario, or the one of a TOML file.

    A file holds scenario keys; `base` names the scenario that it changes (default: paper-1).

    Raises
    ------
    ConfigError
        For a file that cannot be read or parsed, an unknown name or key, or a value out of bounds.
    """
    if not name_or_path.lower().endswith(".toml"):
        return named_scenario(name_or_path)
    path = Path(name_or_path)
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"cannot read scenario {path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path} is not a TOML file: {error}") from error
    base = named_scenario(str(table.pop("base", "paper-1")))
    water = table.pop("water", {})
    if not isinstance(water, dict):
        raise ConfigError(f"{path}: water is {water!r}; write its keys under [water]")
    foreign = [key for key, value in table.items() if isinstance(value, dict)]
    if foreign:
        raise ConfigError(
            f"{path}: a scenario file holds the keys of scenario, without that word, and [water]; "
            f"what is of {foreign[0]!r} goes by --set"
        )
    table |= {f"water.{key}": value for key, value in water.items()}
    try:
        scenario = replace(base, {"name": path.stem, **table})
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    scenario.check()
    return scenario
