import dataclasses

import numpy as np
import pytest

from firmware.geometry import Array
from firmware.leader.map_vote import VoteSettings, VoteWindow, carried, vote
from firmware.leader.matches import MatchingSettings
from tests.matching.scenes import Scene

MATCHING, SETTINGS = MatchingSettings(), VoteSettings()


def window(
    scene: Scene, shift_m: tuple[float, float], believed_m: tuple[float, float]
) -> VoteWindow:
    return VoteWindow(
        reference=scene.submap(200, 200, (41, 70)),
        query=scene.submap(180, 230, (70, 41), shift_m=shift_m),
        shift_m=np.array(believed_m),
        covariance_m2=np.eye(2) * 2.0,
        matching=MATCHING,
    )


def test_windows_speak_for_a_true_closure_and_against_a_false_one(scene: Scene) -> None:
    windows = [window(scene, (6.0, -8.0), (5.0, -7.0)) for _ in range(3)]
    true = vote(windows, SETTINGS)
    assert true.informed == 3
    assert true.log_ratio > 10.0
    false = vote([window(scene, (6.0, -8.0), (-24.0, 20.0))], SETTINGS)
    assert false.log_ratio < -3.0


def test_flat_seabed_and_far_windows_abstain(scene: Scene) -> None:
    def level(north: Array, east: Array) -> Array:
        return 40.0 + 0.0 * (north + east)

    flat = VoteWindow(
        reference=scene.submap(200, 200, (41, 70), relief=level),
        query=scene.submap(200, 210, (41, 70), relief=level),
        shift_m=np.zeros(2),
        covariance_m2=np.eye(2),
        matching=MATCHING,
    )
    far = dataclasses.replace(flat, shift_m=np.array([5000.0, 0.0]))
    result = vote([flat, far], SETTINGS)
    assert (result.log_ratio, result.informed) == (0.0, 0)
    assert vote([], SETTINGS).log_ratio == 0.0


def test_one_window_cannot_carry_the_vote(scene: Scene) -> None:
    result = vote([window(scene, (0.0, 0.0), (0.0, 0.0))], SETTINGS)
    assert result.log_ratio == SETTINGS.window_limit


def test_neighbours_are_carried_by_their_drift() -> None:
    drift_r, drift_q = np.array([0.1, 0.0]), np.array([0.0, -0.05])
    shift, covariance = carried(
        np.array([3.0, 4.0]), np.eye(2), (40.0, -40.0), (drift_r, drift_q), MATCHING
    )
    assert shift == pytest.approx([3.0 + 4.0, 4.0 - 2.0])
    assert covariance[0, 0] == pytest.approx(1.0 + 2 * (0.04 * 40.0 + 1.2**2))
    assert covariance[0, 1] == 0.0
