"""Two or more cores over a small made-up relief and a perfect, simple water."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from firmware.compression.settings import CompressionSettings
from firmware.dead_reckoning import ReckonedState
from firmware.follower.core import FollowerCore
from firmware.follower.settings import FollowerSettings
from firmware.leader.core import LeaderCore
from firmware.leader.settings import LeaderSettings
from firmware.soundings import Odometry, Ping
from firmware.submap_builder import SubmapSettings
from firmware.vehicle_core import Navigator
from protocol.codec import decode, encode
from protocol.packets import Header, Packet, Profile, TrajectoryPacket
from protocol.schedule import Slots, SlotSettings
from protocol.settings import replace

SPEED_MPS, DEPTH_M, ANGLES_RAD = 2.0, 10.0, np.radians(np.linspace(-60.0, 60.0, 25))
SHORT = SubmapSettings(duration_s=20.0)
QUICK = CompressionSettings(iterations=2, dense_iterations=2)
Path = Callable[[float], tuple[float, float]]
Frame = tuple[bytes, float]  # and the arrival of its first bit


def seabed_m(north_m: np.ndarray, east_m: np.ndarray) -> np.ndarray:
    """Return depths of hills that repeat nowhere near."""
    return (
        50.0
        + 3.0 * np.sin(north_m / 17.0 + 0.3 * np.sin(east_m / 23.0))
        + 2.0 * np.cos(east_m / 13.0 + north_m / 61.0)
    )


def sail(core: Navigator, path: Path, time_s: float, *, sonar_on: bool = True) -> None:
    """Feed one quarter second of navigation and, if asked, a ping."""
    north_m, east_m = path(time_s)
    before_m = path(time_s - 0.25)
    core.receive_odometry(
        Odometry(
            time_s=time_s,
            velocity_north_mps=(north_m - before_m[0]) * 4.0,
            velocity_east_mps=(east_m - before_m[1]) * 4.0,
            yaw_rad=0.0,
            depth_m=DEPTH_M,
        )
    )
    if sonar_on and time_s % 1.0 == 0.0:
        below_m = seabed_m(np.full(ANGLES_RAD.size, north_m), east_m + 40.0 * np.tan(ANGLES_RAD))
        core.receive_ping(
            Ping(
                time_s=time_s,
                slant_ranges_m=(below_m - DEPTH_M) / np.cos(ANGLES_RAD),
                beam_angles_rad=ANGLES_RAD,
                roll_rad=0.0,
                pitch_rad=0.0,
                yaw_rad=0.0,
                depth_m=DEPTH_M,
            )
        )


def line(north_m: float, east_m: float) -> Path:
    """Return a straight way north at survey speed."""
    return lambda time_s: (north_m + SPEED_MPS * time_s, east_m)


def start(
    path: Path, time_s: float = 0.0, off_m: tuple[float, float] = (0.0, 0.0)
) -> ReckonedState:
    """Return the state in which a vehicle begins, dead reckoning off by so much."""
    north_m, east_m = np.add(path(time_s), off_m)
    return ReckonedState(
        time_s=time_s, north_m=north_m, east_m=east_m, yaw_rad=0.0, depth_m=DEPTH_M
    )


def slots_of(followers: int = 1) -> Slots:
    """Return the raster of the air."""
    return Slots(SlotSettings(followers=followers, follower_slot_s=2))


def follower_of(
    path: Path,
    vehicle: int = 1,
    *,
    slots: Slots | None = None,
    boot_epoch: int = 0,
    at_s: float = 0.0,
    off_m: tuple[float, float] = (0.0, 0.0),
    **changes: object,
) -> FollowerCore:
    """Return a follower with short sub-maps and a quick fit."""
    settings = replace(FollowerSettings(submaps=SHORT, compression=QUICK), changes)
    return FollowerCore(
        vehicle, boot_epoch, start(path, at_s, off_m), settings=settings, slots=slots or slots_of()
    )


def leader_of(path: Path, *, slots: Slots | None = None, **changes: object) -> LeaderCore:
    """Return a leader with short sub-maps."""
    settings = replace(LeaderSettings(submaps=SHORT), changes)
    return LeaderCore(0, start(path), settings=settings, slots=slots or slots_of())


@dataclass
class Convoy:
    """A leader and followers in step; frames arrive after one second per 1500 m."""

    leader: LeaderCore
    leader_path: Path
    followers: dict[int, tuple[FollowerCore, Path]]
    lose: Callable[[Packet, float], bool] = lambda *_: False
    sonar_until_s: float = np.inf
    up: list[tuple[Packet, float]] = field(default_factory=list)  # and when it was transmitted
    down: list[tuple[Packet, float]] = field(default_factory=list)

    def run(self, begin_s: float, end_s: float) -> "Convoy":
        """Sail from one time to another, by quarter seconds."""
        for quarter in range(round(4 * begin_s) + 1, round(4 * end_s) + 1):
            self._step(quarter / 4.0)
        return self

    def _step(self, now_s: float) -> None:
        sail(self.leader, self.leader_path, now_s)
        self.leader.tick(now_s)
        while (waiting := self.leader.next_jobs()) is not None:
            self.leader.finish(waiting, waiting.run(), now_s)
        for core, path in self.followers.values():
            sail(core, path, now_s, sonar_on=now_s <= self.sonar_until_s)
            core.tick(now_s)
            frame = core.poll(now_s)
            if frame is not None:
                packet = decode(frame)
                self.up.append((packet, now_s))
                if not self.lose(packet, now_s):
                    self.leader.receive_frame(frame, self._arrival_s(path, now_s), now_s + 1e-3)
        frame = self.leader.poll(now_s)
        if frame is None:
            return
        self.down.append((decode(frame), now_s))
        for core, path in self.followers.values():
            if not self.lose(decode(frame), now_s):
                core.receive_frame(frame, self._arrival_s(path, now_s), now_s + 1e-3)

    def _arrival_s(self, path: Path, now_s: float) -> float:
        apart_m = np.subtract(path(now_s), self.leader_path(now_s))
        return now_s + float(np.hypot(*apart_m)) / 1500.0


def convoy(
    followers: int = 1,
    *,
    answers: str = "paper",
    lose: Callable[[Packet, float], bool] = lambda *_: False,
    **changes: Any,
) -> Convoy:
    """Return a leader and followers on lines beside each other."""
    slots, leader_path = slots_of(followers), line(0.0, 0.0)
    paths = {v: line(-30.0 * v, 60.0 * v) for v in range(1, followers + 1)}
    return Convoy(
        leader=leader_of(leader_path, slots=slots, answers=answers),
        leader_path=leader_path,
        followers={
            v: (follower_of(path, v, slots=slots, **changes), path) for v, path in paths.items()
        },
        lose=lose,
    )


def sailed(until_s: float = 100.0) -> LeaderCore:
    """Return a leader that has surveyed alone."""
    path = line(0.0, 0.0)
    alone = Convoy(leader=leader_of(path), leader_path=path, followers={})
    return alone.run(0.0, until_s).leader


def sheets_of(leader: LeaderCore, vehicle: int = 1) -> list[tuple[int, int]]:
    """Return boot and number of each sub-map of a vehicle that the leader holds."""
    return sorted((s.id.boot_epoch, s.id.submap) for s in leader.atlas if s.id.vehicle == vehicle)


def changed(frame: bytes, **changes: object) -> bytes:
    """Return a frame with other values in its header."""
    packet = decode(frame)
    header = dataclasses.replace(packet.header, **changes)  # type: ignore[arg-type]
    return encode(dataclasses.replace(packet, header=header))


def trajectory(states: np.ndarray, first_s: float, *, vehicle: int = 1) -> bytes:
    """Return a trajectory packet of states (T, 3), one a second from first_s."""
    header = Header(
        profile=Profile.TRAJECTORY,
        vehicle=vehicle,
        boot_epoch=0,
        submap=1,
        fragment=0,
        fragment_count=1,
        tx_second=0,
        time_quarters=round(4 * first_s) % (1 << 20),
    )
    rows = np.full((20, 3), np.nan, dtype=np.float32)
    rows[: len(states)] = states
    return encode(TrajectoryPacket(header=header, states=rows))


def walked(count: int, north_m: float) -> np.ndarray:
    """Return states (count, 3) of a walk north."""
    return np.column_stack([north_m + 2.0 * np.arange(count), np.zeros(count), np.zeros(count)])
