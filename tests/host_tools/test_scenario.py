from pathlib import Path

import pytest

from host_tools.mission_settings import MissionSettings, mission_of
from host_tools.scenario import SCENARIOS, load_scenario, named_scenario
from protocol.errors import ConfigError
from protocol.settings import replace


def test_paper_1_holds_the_values_of_the_paper() -> None:
    scenario = named_scenario("paper-1")
    assert (scenario.duration_min, scenario.follower_duration_min) == (40, 30)
    assert (scenario.leg_m, scenario.line_spacing_m, scenario.corner_offset_m) == (600, 100, 50)
    water = scenario.water
    assert scenario.speed_mps == pytest.approx(2.0578, abs=1e-4)
    assert (scenario.beams, scenario.swath_deg, scenario.ping_hz) == (192, 120, 4)
    assert (scenario.drift_mean_mps, scenario.drift_variance) == (0.1, 0.04)
    assert (water.loss, water.outlier_share, water.outlier_factor) == (0.14, 0.2, 1.1)
    assert scenario.lines == 7
    assert not scenario.roughness
    assert scenario.current_mps == scenario.heading_bias_deg == scenario.flier_share == 0


def test_other_scenarios_change_only_what_they_state() -> None:
    paper_2 = named_scenario("paper-2")
    assert (paper_2.duration_min, paper_2.follower_duration_min, paper_2.leg_m) == (55, 50, 800)
    field = named_scenario("field-1")
    assert (field.roll_bias_deg, field.sound_speed_error_mps, field.depth_wander_m) == (0.2, 2, 0.3)
    assert (field.heading_bias_deg, field.log_scale, field.current_mps) == (0.5, 0.005, 0.2)
    assert field.roughness
    assert field.drift_directions_drawn
    assert named_scenario("day-1").duration_min == 1440


def test_every_named_scenario_carries_its_name() -> None:
    assert all(named_scenario(name).name == name for name in SCENARIOS)


def test_toml_file_changes_its_base(tmp_path: Path) -> None:
    path = tmp_path / "short.toml"
    path.write_text(
        'base = "paper-2"\nduration_min = 12\n'
        "survey_north_m = 5\nsurvey_east_m = 6\n[water]\nloss = 0.5\n"
    )
    scenario = load_scenario(str(path))
    assert (scenario.name, scenario.duration_min, scenario.leg_m) == ("short", 12, 800)
    assert (scenario.survey_north_m, scenario.water.loss) == (5, 0.5)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("speed = 3", "bad.toml: unknown setting 'speed'; did you mean speed_mps"),
        ("[water]\nlos = 0.1", "bad.toml: unknown setting 'water.los'; did you mean water.loss"),
        ("[leader.graph]\nx = 2", "what is of 'leader' goes by --set"),
        ("duration_min = true", "bad.toml: duration_min is True; give a number"),
        ("beams = false", "bad.toml: beams is False; give a whole number"),
        ("leg_m = [", "is not a TOML file"),
        ("leg_m = " + "[" * 5000 + "]" * 5000, "is not a TOML file"),
        ("followers = inf", "followers is inf; give a whole number"),
        ("leg_m = 1" + "0" * 400, "give a number"),
        ("leg_m = 1", "at least 20"),
        ("base = 'paper-3'", "choose one of paper-1, paper-2, field-1, day-1"),
        ("line_spacing_m = 12", "needs at least 23.6 m"),
        ("survey_north_m = 12", "give both"),
    ],
)
def test_bad_scenario_file_is_a_clear_error(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_scenario(str(path))


def test_toml_may_be_written_in_capitals(tmp_path: Path) -> None:
    path = tmp_path / "SHORT.TOML"
    path.write_text("duration_min = 12\n")
    assert load_scenario(str(path)).duration_min == 12


def test_a_block_of_one_line_is_refused() -> None:
    with pytest.raises(ConfigError, match="block_lines is 1; give 0, or 2 or more"):
        replace(named_scenario("paper-1"), {"block_lines": 1}).check()
    replace(named_scenario("paper-1"), {"block_lines": 2}).check()


def test_unknown_scenario_names_the_choices() -> None:
    with pytest.raises(ConfigError, match="paper-1, paper-2, field-1, day-1"):
        load_scenario("papper-1")
    with pytest.raises(ConfigError, match="cannot read scenario"):
        load_scenario("missing.toml")
    with pytest.raises(ConfigError, match="null"):
        load_scenario("a\0b.toml")


def test_setting_survey_position_as_text_pairs_both() -> None:
    changed = replace(named_scenario("paper-1"), {"loss": "0.3", "survey_north_m": "none"})
    assert (changed.water.loss, changed.survey_north_m) == (0.3, None)


@pytest.mark.parametrize(
    "pair",
    [
        {"leader.graph.node_interval_s": 7, "leader.graph.alike_interval_s": 70},
        {"slots.leader_period_s": 10, "slots.leader_offsets_s": "2"},
    ],
)
def test_settings_that_are_right_together_may_be_given_in_any_order(
    pair: dict[str, object],
) -> None:
    other_way = dict(reversed(pair.items()))
    settings = MissionSettings()
    assert replace(settings, pair) == replace(settings, other_way) != settings
    first = next(iter(pair))
    with pytest.raises(ConfigError, match=first.rpartition(".")[2][:6]):
        replace(settings, {first: pair[first]})


def test_of_two_names_of_one_setting_the_last_given_counts() -> None:
    settings = replace(MissionSettings(), {"scenario.water.loss": 0.2, "loss": 0.3})
    assert settings.scenario.water.loss == 0.3


@pytest.mark.parametrize(
    ("name", "changes", "heading_deg", "log_scale"),
    [
        ("paper-1", {}, 0.1, 0.002),
        ("field-1", {}, 0.5, 0.005),
        ("paper-1", {"heading_bias_deg": -2.0, "log_scale": 0.01}, 0.1, 0.002),  # nothing of truth
        ("paper-1", {"heading_bias_told_deg": 2.0, "log_scale_told": 0.01}, 2.0, 0.01),
        (
            "field-1",
            {"heading_bias_sigma_deg": 0.3, "leader.graph.log_scale_sigma": 1e-3},
            0.3,
            1e-3,
        ),
    ],
)
def test_a_leader_is_told_what_data_sheets_say_unless_it_is_set(
    name: str, changes: dict[str, object], heading_deg: float, log_scale: float
) -> None:
    graph = mission_of(named_scenario(name), changes).leader.graph
    assert (graph.heading_bias_sigma_deg, graph.log_scale_sigma) == (heading_deg, log_scale)
