"""Stores of vehicles whose clocks are set."""

from pathlib import Path

import numpy as np

from firmware.follower.journaled import JournaledFollower
from firmware.follower.settings import FollowerSettings
from firmware.journal import Journal, JournalSettings, Owner
from tests.leader.vessels import QUICK, SHORT, line, slots_of, start

PATH = line(0.0, 60.0)
SETTINGS = FollowerSettings(submaps=SHORT, compression=QUICK)


def resumed(folder: Path) -> JournaledFollower:
    journal = Journal(folder, Owner(vehicle=1, fingerprint="test"), JournalSettings())
    return JournaledFollower(journal, 1, start(PATH), settings=SETTINGS, slots=slots_of())


def test_a_leap_of_the_clock_puts_no_checkpoint_off_for_as_long(tmp_path: Path) -> None:
    core = resumed(tmp_path)
    for now_s in (1.0, 36_000.0, *np.arange(2.0, 70.0, 0.25)):
        core.tick(now_s)
    assert core.recorder.journal.counters["store_checkpoints"] >= 2
