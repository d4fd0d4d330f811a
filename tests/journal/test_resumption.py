import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from firmware.checkpoints import read, written
from firmware.follower.journaled import JournaledFollower
from firmware.follower.settings import FollowerSettings
from firmware.inputs import fan_of, from_ping, to_odometry, to_ping
from firmware.journal import Journal, JournalSettings, Owner
from firmware.leader.journaled import JournaledLeader
from firmware.leader.match_jobs import Findings
from firmware.leader.matches import Hint, Match, MatchOutcome, NoMatch
from firmware.soundings import Ping
from firmware.submap_builder import SubmapSettings
from host_tools.kills import Fate, MortalJournal, MortalNode, SensorTape
from host_tools.mission import deployed, run, simulated_vehicles, water_between
from host_tools.mission_settings import MissionSettings, changed
from host_tools.nodes import FollowerNode, LeaderNode
from host_tools.simulator.placement import place_survey
from host_tools.simulator.terrain import open_terrain
from host_tools.simulator.vehicle import SimulatedVehicle
from protocol.acoustics import Delivery
from protocol.schedule import Slots, SlotSettings
from tests.leader.vessels import QUICK, line, sail, start

SHORT = {
    "duration_min": 2.2,
    "follower_duration_min": 2.0,
    "leg_m": 60.0,
    "beams": 32,
    "leader.composition.interval_s": 30.0,
    "depth_wander_m": 4.0,
    "leader.ranges.sound_profile.points": (0.0, 1480.0, 10.0, 1500.0, 30.0, 1450.0),
    "leader.ranges.follower_depth_m": 12.0,
}
KILLS = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class Told:
    deliveries: list[Delivery]
    beliefs: list[np.ndarray]
    trajectories: dict[int, np.ndarray]
    counters: list[dict[str, int]]
    nodes: list[MortalNode]
    kills: int


def mission(folder: Path, kills: int, seed: int = 4) -> Told:
    settings = changed(MissionSettings(), SHORT)
    site = place_survey(open_terrain(None, 1), settings.scenario, seed)
    vehicles = simulated_vehicles(settings, site, seed)
    fates = [
        Fate(np.random.default_rng([seed, v.index]), kills, 1500.0 / max(kills, 1))
        for v in vehicles
    ]
    nodes = {
        v.index: MortalNode(
            lambda tape, v=v: board(settings, v, fates[v.index], folder, tape),  # type: ignore[misc]
            v.steps(),
            0.25,
        )
        for v in vehicles
    }
    deliveries: list[Delivery] = []
    water = water_between(settings, vehicles, seed)
    run(nodes, water, duration_s=132.0, tick_s=0.25, record=deliveries.append)
    leader = nodes[0].core
    assert isinstance(leader, JournaledLeader)
    return Told(
        deliveries=deliveries,
        beliefs=[node.log.columns()["live_m"] for node in nodes.values()],
        trajectories={v: leader.core.trajectory(v).position_m for v in leader.core.vehicles()},
        counters=[
            {k: n for k, n in node.core.status().items() if not k.startswith("store")}
            for node in nodes.values()
        ],
        nodes=list(nodes.values()),
        kills=sum(fate.kills for fate in fates),
    )


def board(
    settings: MissionSettings, vehicle: SimulatedVehicle, fate: Fate, folder: Path, tape: SensorTape
) -> LeaderNode | FollowerNode:
    owner = Owner(vehicle=vehicle.index, fingerprint="test")
    journal = MortalJournal(folder, owner, JournalSettings(checkpoint_s=30.0), fate)
    start, slots = deployed(vehicle), Slots(settings.slots)
    if vehicle.index == 0:
        return LeaderNode(
            JournaledLeader(journal, start, settings=settings.leader, slots=slots), tape
        )
    core = JournaledFollower(journal, 1, start, settings=settings.follower, slots=slots)
    return FollowerNode(core, tape)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Told:
    return mission(tmp_path_factory.mktemp("undisturbed"), 0)


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Told:
    return mission(tmp_path_factory.mktemp("killed"), KILLS)


def test_kills_change_no_frame_no_belief_and_no_estimate(undisturbed: Told, killed: Told) -> None:
    assert undisturbed.kills == 0
    assert killed.kills == 2 * KILLS
    assert len(killed.deliveries) > 15
    assert killed.deliveries == undisturbed.deliveries
    for ours, theirs in zip(killed.beliefs, undisturbed.beliefs, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert killed.trajectories.keys() == undisturbed.trajectories.keys() == {0, 1}
    for vehicle, positions_m in undisturbed.trajectories.items():
        np.testing.assert_array_equal(killed.trajectories[vehicle], positions_m)


def test_every_counter_is_what_it_would_have_been(undisturbed: Told, killed: Told) -> None:
    assert killed.counters == undisturbed.counters


def test_ranges_keep_the_depth_that_they_arrived_at(undisturbed: Told, killed: Told) -> None:
    leaders = [told.nodes[0].core for told in (undisturbed, killed)]
    ranges = [one.core._ranging._held for one in leaders if isinstance(one, JournaledLeader)]
    assert ranges[1] == ranges[0]
    assert len({one.depth_difference_m for one in ranges[0]}) > 1


def test_nothing_is_sent_while_catching_up_nor_told_differently(killed: Told) -> None:
    for node in killed.nodes:
        assert node.stray_frames == 0
        assert node.differing == 0


@pytest.mark.parametrize("vehicle", [0, 1])
def test_vehicles_write_themselves_down_so_that_little_is_replayed(
    undisturbed: Told, vehicle: int
) -> None:
    journal = undisturbed.nodes[vehicle].core.recorder.journal
    assert journal.counters["store_checkpoints"] >= 3
    assert journal.counters["store_checkpoints_put_off"] == 0
    assert journal.counters["store_set_aside"] == 0
    odometry_s = [to_odometry(body).time_s for kind, body in journal.replay() if kind == 1]
    assert odometry_s[0] > 85.0


def test_frames_of_a_slot_that_a_death_cuts_short_go_out_once_each(tmp_path: Path) -> None:
    settings = FollowerSettings(submaps=SubmapSettings(duration_s=20.0), compression=QUICK)
    slots = Slots(SlotSettings(followers=1, follower_slot_s=8, frames_per_slot=3))
    path = line(0.0, 60.0)

    def follower(folder: Path) -> JournaledFollower:
        journal = Journal(folder, Owner(vehicle=1, fingerprint="test"), JournalSettings())
        return JournaledFollower(journal, 1, start(path), settings=settings, slots=slots)

    first = follower(tmp_path / "undisturbed")
    for quarter in range(1, 4 * 32 + 1):
        sail(first, path, quarter / 4)
        first.tick(quarter / 4)
        if quarter < 4 * 32:
            first.poll(quarter / 4)
    sent = []
    for k in range(4):
        sent.append(first.poll(32.0))
        first.recorder.journal.commit()
        shutil.copytree(tmp_path / "undisturbed", tmp_path / f"dead behind {k}")
    assert len({frame for frame in sent if frame is not None}) == 3
    for k in range(4):
        again = follower(tmp_path / f"dead behind {k}")
        assert [again.poll(32.0) for _ in sent] == sent
        assert again.core.counters == first.core.counters


def test_epoch_that_a_follower_began_by_itself_is_not_begun_again(tmp_path: Path) -> None:
    path = line(0.0, 60.0)

    def follower() -> JournaledFollower:
        journal = Journal(tmp_path, Owner(vehicle=1, fingerprint="test"), JournalSettings())
        settings, slots = FollowerSettings(compression=QUICK), Slots(SlotSettings())
        return JournaledFollower(journal, 1, start(path), settings=settings, slots=slots)

    torn = follower()
    for time_s in (0.25, 0.5, 300.0, 300.25, 300.5):
        sail(torn, path, time_s, sonar_on=False)
        torn.tick(time_s)
        torn.poll(time_s)
    assert torn.core.boot_epoch == 1
    torn.recorder.journal.close()
    assert follower().core.boot_epoch == 1
    for file in tmp_path.glob("*.sqlite*"):
        file.unlink()
    assert follower().core.boot_epoch == 2


def test_ping_reads_back_within_float32_and_then_exactly() -> None:
    ping = Ping(
        time_s=1.25,
        slant_ranges_m=np.array([40.123456789, np.nan, 1e9]),
        beam_angles_rad=np.array([-1.0, 0.0, 1.0]),
        roll_rad=0.01,
        pitch_rad=-0.02,
        yaw_rad=3.0,
        depth_m=10.1,
    )
    once = to_ping(from_ping(ping), fan_of(ping))
    twice = to_ping(from_ping(once), fan_of(once))
    np.testing.assert_allclose(once.slant_ranges_m, ping.slant_ranges_m, rtol=6e-8)
    np.testing.assert_array_equal(once.slant_ranges_m, twice.slant_ranges_m)
    np.testing.assert_array_equal(once.beam_angles_rad, ping.beam_angles_rad)
    assert (once.time_s, once.roll_rad, once.depth_m) == (1.25, 0.01, 10.1)


def test_ping_of_no_use_keeps_only_its_number_of_beams() -> None:
    ping = Ping(
        time_s=0.0,
        slant_ranges_m=np.ones((2, 3)),
        beam_angles_rad=np.ones(4),
        roll_rad=0.0,
        pitch_rad=0.0,
        yaw_rad=0.0,
        depth_m=np.nan,
    )
    kept = to_ping(from_ping(ping), fan_of(ping))
    assert kept.slant_ranges_m.size == 6
    assert not np.isfinite(kept.slant_ranges_m).any()


def test_outcomes_read_back_exactly() -> None:
    found = Match(
        shift_m=np.array([1 / 3, -2e-17]),
        covariance_m2=np.array([[0.1, 0.01], [0.01, np.float64(0.3)]]),
        residual=0.1,
        overlap_cells=int(np.int64(7)),
        axis_deg=None,
        misfit=np.inf,
        centre_m=np.array([5.0, 6.0]),
        reference_time_s=3.0,
        query_time_s=4.0,
    )
    outcomes = [MatchOutcome(match=found, reason=None)]
    outcomes += [MatchOutcome(match=None, reason=reason) for reason in NoMatch]
    hint = Hint(shift_m=np.array([0.1, -3.0]), covariance_m2=np.eye(2) / 3)
    outcomes.append(MatchOutcome(match=None, reason=NoMatch.AMBIGUOUS, hint=hint))
    findings = Findings(outcomes=outcomes, false_closures=[3, 141])
    found_again, (now_s,) = read(written(findings, (0.1 + 0.2,)), Findings)
    again = found_again.outcomes
    assert found_again.false_closures == [3, 141]
    assert now_s == 0.1 + 0.2
    assert [o.reason for o in again] == [o.reason for o in outcomes]
    assert again[0].match is not None
    assert again[0].match.misfit == np.inf
    np.testing.assert_array_equal(again[0].match.covariance_m2, found.covariance_m2)
    np.testing.assert_array_equal(again[0].match.shift_m, found.shift_m)
    assert again[-1].hint is not None
    np.testing.assert_array_equal(again[-1].hint.covariance_m2, hint.covariance_m2)
    np.testing.assert_array_equal(again[-1].hint.shift_m, hint.shift_m)


def test_checkpoint_that_cannot_be_read_starts_the_vehicle_anew(tmp_path: Path) -> None:
    settings = changed(MissionSettings(), SHORT)
    site = place_survey(open_terrain(None, 1), settings.scenario, 4)
    follower = simulated_vehicles(settings, site, 4)[1]
    journal = Journal(tmp_path, Owner(vehicle=1, fingerprint="test"), JournalSettings())
    journal.start("0x0p+0 0x0p+0 0x0p+0 0x0p+0 0x0p+0")
    journal.checkpoint(b"\x80\x04cos\nsystem\n.")
    journal.close()
    never = Fate(np.random.default_rng(0), 0, 1.0)
    node = board(settings, follower, never, tmp_path, SensorTape(follower.steps()))
    assert isinstance(node.core, JournaledFollower)
    assert node.core.core.boot_epoch == 1
    assert node.core.status()["store_set_aside"] == 1
    for k in range(20):
        node.tick(0.25 * k)
    assert node.core.reckoned.time_s == 4.75
