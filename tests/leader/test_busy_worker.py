"""Matches that are never done in time, or not judged: the leader composes its past all the same."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from firmware.journal import Journal, JournalSettings, Owner
from firmware.journaled import bare
from firmware.leader.atlas import Atlas
from firmware.leader.closures import Closure
from firmware.leader.core import LeaderCore
from firmware.leader.journaled import JournaledLeader
from firmware.leader.loop import LeaderLoop
from firmware.leader.match_jobs import Findings, SheetJobs
from firmware.leader.pose_graph import PoseGraph
from firmware.leader.settings import LeaderSettings
from firmware.leader.worker import Finished
from protocol.acoustics import Water, WaterSettings
from protocol.modems.loopback import LoopbackMedium
from protocol.settings import replace
from tests.leader.vessels import SHORT, line, sail, slots_of, start

PATH = line(0.0, 0.0)
SETTINGS = replace(LeaderSettings(submaps=SHORT), {"composition.interval_s": 60.0})


class SlowWorker:
    """Takes a second more for a batch than the leader for a sub-map."""

    def __init__(self) -> None:
        self.now_s = self._given_s = 0.0
        self._batch: SheetJobs | None = None

    @property
    def is_free(self) -> bool:
        return self._batch is None

    def give(self, batch: SheetJobs) -> None:
        self._batch, self._given_s = batch, self.now_s

    def take(self) -> Finished | None:
        if self._batch is None or self.now_s - self._given_s < SETTINGS.hop_s + 1.0:
            return None
        batch, self._batch = self._batch, None
        return Finished(batch=batch, findings=batch.run())

    def close(self) -> None:
        """Nothing is at work."""


def surveyed(driven: LeaderCore | JournaledLeader, until_s: float) -> list[float]:
    """Sail with a slow worker; return the times up to which the past was composed."""
    core, worker = bare(driven), SlowWorker()
    composed_s = [core.composed_s]
    water = Water(WaterSettings(), np.random.default_rng(1), lambda *_: (0.0, 0.0, 10.0))
    loop = LeaderLoop(driven, LoopbackMedium(water).modem(0), iter(()), worker, lambda: 0.0)
    for quarter in range(1, round(4 * until_s) + 1):
        worker.now_s = quarter / 4.0
        sail(driven, PATH, worker.now_s)
        loop.step(worker.now_s)
        if core.composed_s != composed_s[-1]:
            composed_s.append(core.composed_s)
    return composed_s


def journaled(folder: Path) -> JournaledLeader:
    journal = Journal(folder, Owner(vehicle=0, fingerprint="test"), JournalSettings())
    return JournaledLeader(journal, start(PATH), settings=SETTINGS, slots=slots_of())


def test_worker_that_is_always_busy_does_not_starve_composition() -> None:
    leader = LeaderCore(0, start(PATH), settings=SETTINGS, slots=slots_of())
    composed_s = surveyed(leader, 300.0)
    assert len(composed_s) >= 4
    assert "submaps_unmatched" not in leader.status()


def test_judgement_that_fails_once_starves_neither_matches_nor_composition(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    leader = LeaderCore(0, start(PATH), settings=SETTINGS, slots=slots_of())
    judgement, failures = leader._closing._judgement, [MemoryError()]
    consider = judgement.consider

    def fails_once(passed: list[Closure], atlas: Atlas, graph: PoseGraph) -> None:
        if failures and leader._is_to_compose:
            raise failures.pop()
        consider(passed, atlas, graph)

    monkeypatch.setattr(judgement, "consider", fails_once)
    assert len(surveyed(leader, 300.0)) >= 4
    assert not failures
    assert "submaps_unmatched" not in leader.status()


@pytest.mark.parametrize("odd", [(k for k in ""), object()], ids=["unwritable", "unreadable"])
def test_findings_that_no_store_holds_starve_neither_matches_nor_composition(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, odd: Any
) -> None:
    found = Findings(outcomes=[], false_closures=[odd])
    monkeypatch.setattr(SheetJobs, "run", lambda _: found)
    leader = journaled(tmp_path)
    assert len(surveyed(leader, 300.0)) >= 4
    assert leader.status()["store_outcomes_refused"] > 4
    assert "submaps_unmatched" not in leader.status()
    leader.recorder.journal.commit()
    leader.recorder.journal._close()
    resumed = journaled(tmp_path)
    assert resumed.core.counters == leader.core.counters
    assert resumed.recorder.journal.counters == {"store_resumed": 1}


@pytest.mark.parametrize("until_s", [81.0, 143.0])
def test_leader_that_waits_to_compose_resumes_as_it_stood(tmp_path: Path, until_s: float) -> None:
    dead = journaled(tmp_path)
    surveyed(dead, until_s)
    dead.recorder.journal.commit()
    dead.recorder.journal._close()
    resumed = journaled(tmp_path)
    assert resumed.recorder.journal.counters["store_resumed"] == 1
    assert not resumed.core.has_jobs
    cut_short = resumed.next_jobs()
    assert cut_short is not None
    findings, stood_s = cut_short.run(), resumed.core.composed_s
    for leader in (dead, resumed):
        assert leader.core.composed_s == stood_s
        leader.finish(cut_short, findings, until_s)
        assert leader.next_jobs() is None
        leader.tick(until_s + 0.25)
        assert leader.core.composed_s > stood_s
        assert leader.core.has_jobs
    ours_m, theirs_m = (leader.core.trajectory(0).position_m for leader in (resumed, dead))
    np.testing.assert_array_equal(ours_m, theirs_m)
