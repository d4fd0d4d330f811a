"""Stores of vehicles whose clocks are set: what comes back with a clock that is behind."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from firmware.follower.journaled import JournaledFollower
from firmware.follower.settings import FollowerSettings
from firmware.journal import Journal, JournalSettings, Owner
from firmware.soundings import Odometry, Ping
from tests.leader.vessels import QUICK, SHORT, line, sail, slots_of, start

PATH = line(0.0, 60.0)
SETTINGS = FollowerSettings(submaps=SHORT, compression=QUICK)


def resumed(folder: Path) -> JournaledFollower:
    journal = Journal(folder, Owner(vehicle=1, fingerprint="test"), JournalSettings())
    return JournaledFollower(journal, 1, start(PATH), settings=SETTINGS, slots=slots_of())


def lived(follower: JournaledFollower, from_s: float, to_s: float) -> list[bytes | None]:
    """Return what a follower without a sonar answers from one time to another."""
    answers = []
    for quarter in range(round(4 * from_s) + 1, round(4 * to_s) + 1):
        sail(follower, PATH, quarter / 4, sonar_on=False)
        follower.tick(quarter / 4)
        answers.append(follower.poll(quarter / 4))
    return answers


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A store of two minutes."""
    follower = resumed(tmp_path)
    assert any(lived(follower, 0.0, 120.0))
    follower.recorder.journal.close()
    return tmp_path


@pytest.mark.parametrize("back_s", [8.0, 100.0])
def test_a_clock_behind_the_store_makes_no_vehicle_deaf_and_mute(
    folder: Path, back_s: float
) -> None:
    follower = resumed(folder)
    now_s = 120.0 - back_s
    assert any(lived(follower, now_s, now_s + 30.0))
    assert follower.recorder.last_tick_s == now_s + 30.0
    assert follower.recorder.last_odometry_s == now_s + 30.0
    assert follower.status()["store_clock_set_back"] == 1


def test_what_came_by_a_clock_set_back_is_replayed_as_it_came(folder: Path) -> None:
    follower = resumed(folder)
    lived(follower, 20.0, 60.0)
    follower.recorder.journal.close()
    again = resumed(folder)
    assert again.core.counters == follower.core.counters
    assert again.reckoned == follower.reckoned
    assert again.recorder.last_tick_s == 60.0


def test_what_the_store_holds_just_before_its_end_is_asked_for_in_vain(folder: Path) -> None:
    follower = resumed(folder)
    sent, answers = follower.core.counters["frames_sent"], lived(follower, 116.0, 119.75)
    assert not any(answers)
    assert follower.core.counters["frames_sent"] == sent
    assert follower.recorder.last_tick_s == 120.0
    lived(follower, 119.75, 124.0)
    assert follower.core.counters["frames_sent"] == sent + 2  # of 122 s and 124 s
    assert follower.status().get("store_clock_set_back", 0) == 0


def test_a_leap_of_the_clock_puts_no_checkpoint_off_for_as_long(tmp_path: Path) -> None:
    follower = resumed(tmp_path)
    for now_s in (1.0, 36_000.0, *np.arange(2.0, 70.0, 0.25)):
        follower.tick(now_s)
    assert follower.recorder.journal.counters["store_checkpoints"] >= 2


@pytest.mark.parametrize("stamp_s", [float("nan"), float("inf"), 1e300, 3.2e7, -1800.0])
def test_a_stamp_that_cannot_be_is_not_the_end_of_a_store(tmp_path: Path, stamp_s: float) -> None:
    odometry = Odometry(
        time_s=9.0, velocity_north_mps=2.0, velocity_east_mps=0.0, yaw_rad=0.0, depth_m=9.0
    )
    ping = Ping(
        time_s=9.0,
        slant_ranges_m=np.full(3, 40.0),
        beam_angles_rad=np.array([-0.5, 0.0, 0.5]),
        roll_rad=0.0,
        pitch_rad=0.0,
        yaw_rad=0.0,
        depth_m=9.0,
    )
    first = resumed(tmp_path).recorder
    for one in (odometry, replace(odometry, time_s=stamp_s)):
        first.odometry(one)
    for another in (ping, replace(ping, time_s=stamp_s)):
        first.ping(another)
    first.journal.close()
    again = resumed(tmp_path).recorder
    assert again.marks()[:3] == first.marks()[:3]
    assert again.odometry(odometry) is None
    assert again.ping(ping) is None
