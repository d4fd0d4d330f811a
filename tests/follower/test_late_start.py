"""A vehicle that begins in mid-mission without its past does not take dead reckoning for known."""

import numpy as np
import pytest

from firmware.follower.correction import CorrectionSettings, DriftCorrection
from firmware.leader.graph_settings import GraphSettings
from firmware.leader.pose_graph import PoseGraph

SETTINGS = CorrectionSettings()
HERE_M = np.array([300.0, -40.0])


def sigma_m(correction: DriftCorrection, time_s: float) -> float:
    return float(np.sqrt(correction.corrected(time_s, HERE_M)[1][0, 0]))


def test_a_follower_begun_anew_is_as_uncertain_as_one_that_nobody_corrected() -> None:
    anew, alone = DriftCorrection(200.0, SETTINGS), DriftCorrection(0.0, SETTINGS)
    assert sigma_m(alone, 0.0) == pytest.approx(SETTINGS.start_sigma_m)
    for time_s in (200.0, 500.0):
        assert sigma_m(anew, time_s) == pytest.approx(sigma_m(alone, time_s), rel=1e-9)
    assert sigma_m(anew, 200.0) > 30.0


def test_a_follower_begun_anew_learns_from_its_first_answer() -> None:
    correction = DriftCorrection(200.0, SETTINGS)
    assert correction.receive_answer(200.0, HERE_M, HERE_M + 25.0, sigma_m=8.0)
    believed_m, covariance_m2 = correction.corrected(230.0, HERE_M)
    assert np.hypot(*(believed_m - HERE_M - 25.0)) < 12.0
    assert np.sqrt(covariance_m2[0, 0]) < 15.0


@pytest.mark.parametrize(("begins_s", "least_m", "most_m"), [(0.0, 0.4, 0.6), (200.0, 40.0, 41.0)])
def test_a_chain_that_begins_late_begins_uncertain(
    begins_s: float, least_m: float, most_m: float
) -> None:
    graph = PoseGraph(GraphSettings())
    graph.add_chain(0, begins_s, HERE_M, HERE_M)
    graph.update()
    told_m = float(np.sqrt(graph.predicted_covariance(0, begins_s)[0, 0]))
    assert least_m < told_m < most_m
