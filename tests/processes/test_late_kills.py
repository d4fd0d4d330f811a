"""A process that is killed between its last instant and its last file."""

import argparse
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from firmware.belief import Belief
from firmware.dead_reckoning import ReckonedState
from firmware.leader.atlas import SheetId, sheet_of
from firmware.leader.journaled import JournaledLeader
from firmware.submaps import GriddedSubmap, Track
from host_tools.emulators.ptys import PseudoPort
from host_tools.processes import vehicle
from host_tools.processes.process_group import ProcessGroup
from host_tools.processes.records import VehicleFiles
from host_tools.processes.vehicle import Aboard
from host_tools.processes.voyage import Voyage, add_voyage_arguments, voyage_of
from protocol.acoustics import Water, WaterSettings
from protocol.errors import ConfigError
from protocol.modems.serial_line import DEFAULT_BAUD

SHORT = ["--set", "duration_min=0.5", "--set", "follower_duration_min=0.5", "--set", "beams=32"]


class Killed(BaseException):
    """What no code catches, as a kill."""


@pytest.fixture
def voyage() -> Voyage:
    parser = argparse.ArgumentParser()
    add_voyage_arguments(parser)
    return voyage_of(parser.parse_args(SHORT))


@pytest.fixture
def group(voyage: Voyage, tmp_path: Path) -> Iterator[ProcessGroup]:
    water = Water(
        WaterSettings(), np.random.default_rng(1), lambda *_: (0.0, 0.0, 10.0), nodes=range(1)
    )
    group = ProcessGroup(water, voyage.fingerprint, on_wait=lambda _: None, folder=tmp_path / "p")
    yield group
    group.close()


def lived(
    group: ProcessGroup,
    ending: threading.Thread,
    voyage: Voyage,
    folder: Path,
    store: Path | None,
) -> BaseException | None:
    """Run the leader's process to its end; return what ended it.

    Once the first life has had all its instants, ending begins to end the mission.
    """
    ended: list[BaseException] = []

    def live() -> None:
        try:
            out = folder / "out"
            vehicle.run_vehicle(0, group.modem_url(0), group.clock_url, voyage, out, "next", store)
        except BaseException as error:
            ended.append(error)

    thread = threading.Thread(target=live, daemon=True)
    thread.start()
    if ending.ident is None:  # the first life is served its mission
        group.wait_for_all()
        for step in range(round(voyage.settings.scenario.duration_s / 0.25) + 1):
            group.nodes[0].tick(step * 0.25)
        ending.start()
    thread.join(60.0)
    assert not thread.is_alive()
    return ended[0] if ended else None


@pytest.mark.parametrize("has_store", [True, False])
def test_process_killed_after_its_last_instant_ends_the_mission_when_it_starts_again(
    voyage: Voyage,
    group: ProcessGroup,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    has_store: bool,
) -> None:
    def killed(*_: object) -> None:
        raise Killed

    store = tmp_path / "store" if has_store else None
    ending = threading.Thread(target=group.end, daemon=True)
    with monkeypatch.context() as patch:
        patch.setattr(vehicle, "_write", killed)
        assert isinstance(lived(group, ending, voyage, tmp_path, store), Killed)
        assert ending.is_alive()
    again = lived(group, ending, voyage, tmp_path, store)
    ending.join(60.0)
    assert not ending.is_alive()  # else the group would be closed under it
    files = {path.name for path in (tmp_path / "out" / "processes").iterdir()}
    if has_store:
        assert again is None
        assert {"leader.npz", "leader.json"} <= files
    else:
        assert isinstance(again, ConfigError)
        assert "no store holds it" in str(again)
        assert "leader.npz" not in files


@pytest.mark.parametrize("other", ["follower_1.sqlite", "leader.aside-1.sqlite"])
def test_the_store_of_another_vehicle_or_life_holds_no_mission_that_is_over(
    voyage: Voyage, tmp_path: Path, other: str
) -> None:
    (tmp_path / other).touch()
    port = PseudoPort(DEFAULT_BAUD)
    with pytest.raises(ConfigError, match="no store holds it"):
        vehicle.run_vehicle(
            0, f"serial://{port.name}", "wall", voyage, None, "2020-01-01T00:00:00Z", tmp_path
        )
    port.close()


def test_half_a_row_that_a_full_disk_left_spoils_no_later_one(tmp_path: Path) -> None:
    files = VehicleFiles(tmp_path, 0)
    files.prepare()
    for second in range(4):
        state = ReckonedState(time_s=second, north_m=1.0, east_m=2.0, yaw_rad=0.0, depth_m=5.0)
        belief = Belief(time_s=second, position_m=np.ones(2), covariance_m2=np.eye(2))
        files.note(belief, state)
        if second == 1:
            with (tmp_path / "processes" / "leader.beliefs").open("ab") as stream:
                stream.write(b"half")
    data = (tmp_path / "processes" / "leader.beliefs").read_bytes()
    times_s = np.frombuffer(data, dtype="<f8").reshape(4, -1)[:, 0]
    assert times_s.tolist() == [0.0, 1.0, 2.0, 3.0]


def test_what_lies_on_the_shelf_of_a_store_is_in_the_record(
    voyage: Voyage, group: ProcessGroup, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sail = vehicle._sail
    grid = GriddedSubmap(
        north0_m=0.0,
        east0_m=0.0,
        cell_m=2.0,
        depth_m=np.full((5, 5), 30.0),
        variance_m2=np.ones((5, 5)),
        time_s=np.ones((5, 5)),
    )
    zeros = np.zeros(3)
    track = Track(time_s=np.arange(3.0), north_m=zeros, east_m=zeros, yaw_rad=zeros)
    sheet = sheet_of(SheetId(vehicle=0, boot_epoch=0, submap=1), track, grid)

    def sail_and_shelve(aboard: Aboard, ticks: Iterator[float], *, on_wall: bool) -> None:
        sail(aboard, ticks, on_wall=on_wall)
        core = aboard.loop.core
        assert isinstance(core, JournaledLeader)
        assert sheet is not None
        core.core.atlas.add(sheet)
        core.core.atlas.shelve(sheet.id)

    monkeypatch.setattr(vehicle, "_sail", sail_and_shelve)
    ending = threading.Thread(target=group.end, daemon=True)
    assert lived(group, ending, voyage, tmp_path, tmp_path / "store") is None
    ending.join(60.0)
    assert not ending.is_alive()
    patches = list(VehicleFiles(tmp_path / "out", 0).record().patches)
    assert any((patch.depth_m == 30.0).all() for patch in patches)


def test_yaw_in_a_gap_turns_the_short_way(tmp_path: Path) -> None:
    files = VehicleFiles(tmp_path, 0)
    files.prepare()
    for time_s, yaw_rad in ((0.0, 3.1), (2.0, -3.0), (4.0, -2.9)):
        state = ReckonedState(time_s=time_s, north_m=1.0, east_m=2.0, yaw_rad=yaw_rad, depth_m=5.0)
        files.note(Belief(time_s=time_s, position_m=np.ones(2), covariance_m2=np.eye(2)), state)
    found_rad = files.beliefs(np.arange(5.0))["yaw_rad"]
    np.testing.assert_allclose(found_rad, [3.1, 0.05 - np.pi, -3.0, -2.95, -2.9], atol=1e-4)


def test_starts_are_counted_and_by_the_clock_where_the_count_is_damaged(tmp_path: Path) -> None:
    files = VehicleFiles(tmp_path, 0)
    assert [files.prepare(), files.prepare()] == [0, 1]
    for damage in (b"", b"two", b"\xff"):
        (tmp_path / "processes" / "leader.starts").write_bytes(damage)
        assert [files.prepare(), files.prepare()] == [None, None]
