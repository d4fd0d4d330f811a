"""The fault simulation finds nothing, and would find what it is there for."""

from collections import Counter
from pathlib import Path

import pytest

from firmware.journal import Journal
from host_tools.cli import main
from host_tools.faults.catalogue import Fault, plan_of
from host_tools.faults.command import Tally, summary_lines
from host_tools.faults.held import held_bytes
from host_tools.faults.link_trial import link_trial
from host_tools.faults.mission_trial import mission_trial
from host_tools.faults.rig import Outcome
from host_tools.faults.survey import Survey
from protocol.reassembly import Reassembler
from protocol.seal import Blake2sSuite, ReplayWindow

KINDS = len(Fault)


@pytest.fixture(scope="module")
def outcomes() -> list[Outcome]:
    return [link_trial(seed) for seed in range(2 * KINDS)]


@pytest.fixture(scope="module")
def survey() -> Survey:
    return Survey()


def seed_of(fault: Fault, vehicle: int) -> int:
    """Return a seed in which the fault is the first drawn, and strikes that vehicle."""
    seed = list(Fault).index(fault)
    while plan_of(seed, 0.0, 1.0).strikes[0].vehicle != vehicle:
        seed += KINDS
    return seed


def found(outcome: Outcome, text: str) -> bool:
    return any(text in violation for violation in outcome.violations)


def test_links_survive_every_kind_of_fault(outcomes: list[Outcome]) -> None:
    assert [outcome for outcome in outcomes if outcome.violations] == []


def test_every_kind_of_fault_fires(outcomes: list[Outcome]) -> None:
    fired = Counter[Fault]()
    for outcome in outcomes:
        fired.update(outcome.fired)
    assert set(fired) == set(Fault)
    assert KINDS >= 20


def test_the_same_seed_gives_the_same_bytes(outcomes: list[Outcome], survey: Survey) -> None:
    killed = list(Fault).index(Fault.KILLED)
    assert outcomes[killed].deaths
    assert link_trial(killed) == outcomes[killed]
    assert len({outcome.digest for outcome in outcomes}) == len(outcomes)
    torn = seed_of(Fault.TORN_WRITE, 0)
    assert mission_trial(torn, survey) == mission_trial(torn, Survey())


@pytest.mark.parametrize(
    ("fault", "vehicle"),
    [
        (Fault.KILLED, 0),
        (Fault.TORN_WRITE, 1),
        (Fault.STORE_CORRUPT, 0),
        (Fault.DISK_FULL, 1),
    ],
)
def test_missions_survive_what_befalls_computers(
    survey: Survey, fault: Fault, vehicle: int
) -> None:
    outcome = mission_trial(seed_of(fault, vehicle), survey)
    assert outcome.violations == ()
    assert fault in outcome.fired


def test_a_replayed_frame_that_is_believed_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ReplayWindow, "accept", lambda *_: None)
    assert found(link_trial(seed_of(Fault.REPLAYED, 0)), "opened a frame again")


def test_a_forged_frame_that_is_believed_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Blake2sSuite, "verify", lambda _self, _key, _bound, body, *_: body)
    assert found(link_trial(seed_of(Fault.FORGED, 0)), "believed that nobody sent")


def test_an_exception_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise ValueError("boom")

    monkeypatch.setattr(Reassembler, "advance", fail)
    assert found(link_trial(0), "boom")


def test_a_link_that_stays_down_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Reassembler, "receive", lambda *_: None)
    assert found(link_trial(0), "not well again")


def test_an_acknowledged_frame_that_is_lost_is_found(
    monkeypatch: pytest.MonkeyPatch, survey: Survey
) -> None:
    monkeypatch.setattr(Journal, "_write_rows", lambda journal: journal._full.clear())
    seed = seed_of(Fault.KILLED, 0)
    assert found(mission_trial(seed, survey), "frames that it acknowledged")


def test_a_belief_that_was_led_astray_is_found(
    monkeypatch: pytest.MonkeyPatch, survey: Survey
) -> None:
    monkeypatch.setattr("host_tools.faults.mission_trial.ASTRAY_M", -1000.0)
    monkeypatch.setattr("host_tools.faults.mission_trial.SURE_SIGMAS", 0.0)
    alone = list(Fault).index(Fault.ARRIVAL_UNVOUCHED)
    assert len(plan_of(alone, 0.0, 1.0).strikes) == 1
    assert found(mission_trial(alone, survey), "m off, dead reckoning")


def test_held_bytes_counts_all_that_is_reached_once() -> None:
    data = bytes(10_000)
    assert 10_000 < held_bytes([data, {"again": data}]) < 11_000
    assert held_bytes(Path("short")) < 5_000


def test_a_summary_names_the_seeds_that_broke_something() -> None:
    tally = Tally()
    tally.add(
        Outcome(
            seed=7,
            violations=("something",),
            fired={Fault.LATE: 3},
            digest="",
            recovered_s=12.0,
            deaths=1,
        )
    )
    lines = summary_lines(tally, 1.0)
    assert "1 broken" in lines[0]
    assert lines[-1] == "seed 7: something"


def test_one_seed_runs_again_by_one_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["faults", "--seed", "1"]) == 0
    assert "well again" in capsys.readouterr().out
    monkeypatch.setattr(Reassembler, "receive", lambda *_: None)
    assert main(["faults", "--seeds", "2", "--first", "5"]) == 2
    assert "fathomlink faults --tier link --seed 5" in capsys.readouterr().err
