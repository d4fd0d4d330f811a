import pickle
from collections import Counter, OrderedDict, deque
from pathlib import Path

import numpy as np
import pytest

from firmware.checkpoints import read, written
from firmware.follower.journaled import JournaledFollower
from firmware.journal import Journal, JournalSettings, Owner
from firmware.store_file import StoreUnusableError
from host_tools.mission import deployed, simulated_vehicles
from host_tools.mission_settings import MissionSettings, changed
from host_tools.simulator.placement import place_survey
from host_tools.simulator.terrain import open_terrain
from protocol.packets import Profile
from protocol.schedule import Slots


def test_plain_values_read_back() -> None:
    state = {
        "array": np.arange(6.0).reshape(2, 3).T,
        "small": np.float64(0.1),
        "odd": np.array([], dtype=np.float32),
        "queue": deque([1, 2], maxlen=2),
        "counter": Counter(a=1),
        "ordered": OrderedDict(b=2),
        "enum": Profile.TRAJECTORY,
    }
    back, marks = read(written(state, (1.0, None)), dict)
    assert marks == (1.0, None)
    np.testing.assert_array_equal(back.pop("array"), state.pop("array"))
    np.testing.assert_array_equal(back.pop("odd"), state.pop("odd"))
    assert back == state


class Call:
    def __init__(self, module: str, name: str) -> None:
        self.module, self.name = module, name

    def bytes(self) -> bytes:
        """Return a pickle that would call a function of a module with one text."""
        text = [self.module, self.name, "true"]
        body = b"".join(b"\x8c" + bytes([len(t)]) + t.encode() for t in text[:2])
        return b"\x80\x04" + body + b"\x93" + b"\x8c\x04true\x85R."


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("os", "system"),
        ("builtins", "eval"),
        ("firmware.boot_epochs", "os.system"),
        ("firmware.store_file", "sqlite3.connect"),
        ("firmware.boot_epochs", "write_durably"),
        ("numpy.testing", "runstring"),
        ("protocol.nowhere", "Thing"),
    ],
)
def test_checkpoint_can_call_nothing(module: str, name: str) -> None:
    with pytest.raises(StoreUnusableError, match="cannot be read"):
        read(Call(module, name).bytes(), object)


def test_checkpoint_of_another_core_is_none() -> None:
    with pytest.raises(StoreUnusableError, match="a deque in it is a Counter"):
        read(written(Counter(a=1), ()), deque)


@pytest.mark.parametrize("junk", [b"", b"\x80", pickle.dumps(3), pickle.dumps((1, 2, 3))])
def test_junk_is_no_checkpoint(junk: bytes) -> None:
    with pytest.raises(StoreUnusableError):
        read(junk, object)


@pytest.mark.parametrize(("checkpoint_s", "steps_per_tick"), [(60.0, 50), (45.0, 1)])
@pytest.mark.parametrize("profile", ["paper", "dense", "lattice"])
def test_follower_of_every_profile_resumes_from_its_checkpoint(
    tmp_path: Path, profile: str, checkpoint_s: float, steps_per_tick: int
) -> None:
    """The sub-map ended at 40 s; its fit is done by the checkpoint, or goes on after it."""
    short = {"duration_min": 2.0, "follower_duration_min": 2.0, "leg_m": 60.0, "beams": 24}
    fit = {"follower.profile": profile, "follower.steps_per_tick": steps_per_tick}
    settings = changed(MissionSettings(), {**short, **fit})
    site = place_survey(open_terrain(None, 1), settings.scenario, 4)
    vehicle = simulated_vehicles(settings, site, 4)[1]

    def follower() -> JournaledFollower:
        how = JournalSettings(checkpoint_s=checkpoint_s)
        journal = Journal(tmp_path, Owner(vehicle=1, fingerprint=""), how)
        slots, start = Slots(settings.slots), deployed(vehicle)
        return JournaledFollower(journal, 1, start, settings=settings.follower, slots=slots)

    first = follower()
    for odometry, ping in vehicle.steps():
        if odometry.time_s > 75.0:
            break
        if odometry.time_s == checkpoint_s:
            assert (first.core._fit is not None) == (steps_per_tick == 1)
        first.receive_odometry(odometry)
        if ping is not None:
            first.receive_ping(ping)
        first.tick(odometry.time_s)
        first.poll(odometry.time_s)
    first.recorder.journal.close()
    assert first.recorder.journal.counters["store_checkpoints"] == 1
    again = follower()
    later_s = np.arange(75.25, 120.0, 0.25)
    assert [again.poll(t) for t in later_s] == [first.poll(t) for t in later_s]
    assert again.core.counters == first.core.counters
    assert again.belief().position_m.tolist() == first.belief().position_m.tolist()
