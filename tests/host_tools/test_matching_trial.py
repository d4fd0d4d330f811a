from host_tools.matching_trial import run_trial, trial_lines
from host_tools.scenario import named_scenario
from host_tools.simulator.placement import place_survey
from host_tools.simulator.terrain import open_terrain


def test_trial_counts_every_method_at_every_loss_the_same_for_the_same_seed() -> None:
    scenario = named_scenario("paper-1")
    site = place_survey(open_terrain(None), scenario, 1)
    seen: list[int] = []
    trial = run_trial(scenario, site, 3, pairs=1, losses=(0.0, 1.0), progress=seen.append)
    assert seen == [1]
    assert len(trial.cases) == 2 * 4
    assert len(trial.octree_leaves) == 1
    assert all(case.valid <= case.detected <= case.pairs == 1 for case in trial.cases)
    assert all(case.detected == 0 for case in trial.cases if case.loss == 1.0)
    assert trial_lines(trial) == trial_lines(
        run_trial(scenario, site, 3, pairs=1, losses=(0.0, 1.0))
    )
