"""A surveying vehicle: what its sensors say, and, for the evaluation only, where it truly is."""

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware.geometry import Array, wrap_angle
from firmware.soundings import Fix, Odometry, Ping
from host_tools.scenario import ScenarioSettings
from host_tools.simulator.lawnmower import Lawnmower, Turned
from host_tools.simulator.multibeam import Multibeam, Poses
from host_tools.simulator.navigation import NavigationErrors
from host_tools.simulator.seabed import Seabed

CHUNK_S = 40.0


@dataclass(frozen=True, slots=True, kw_only=True)
class TrueTrack:
    """True states of a vehicle on the mission's 1 Hz grid; every array is (T,)."""

    time_s: Array
    north_m: Array
    east_m: Array
    depth_m: Array
    roll_rad: Array
    pitch_rad: Array
    yaw_rad: Array

    @property
    def position_m(self) -> Array:
        """North and east (T, 2)."""
        return np.stack([self.north_m, self.east_m], axis=1)

    def position_at(self, time_s: float) -> Array:
        """Return north and east (2,) at a time, held constant beyond the ends."""
        axes_m = (self.north_m, self.east_m)
        return np.array([np.interp(time_s, self.time_s, axis_m) for axis_m in axes_m])


@dataclass(frozen=True, slots=True, kw_only=True)
class _Chunk:
    """Measurements of consecutive ticks; arrays are (P,), ranges_m is (P, B), NaN without ping."""

    time_s: Array
    is_ping: NDArray[np.bool_]
    velocity_mps: Array  # (P, 2)
    roll_rad: Array
    pitch_rad: Array
    yaw_rad: Array
    depth_m: Array
    ranges_m: Array | None


class SimulatedVehicle:
    """Vehicle `index` (0: the leader) of a scenario; a function of scenario, seabed and seed.

    `on_soundings`, if given, is called chunk by chunk with the measured soundings (N, 3) placed by
    the true poses: north, east, depth. Fliers are left out. It feeds the evaluation's truth map.
    """

    def __init__(
        self,
        scenario: ScenarioSettings,
        seabed: Seabed,
        index: int,
        seed: int,
        on_soundings: Callable[[Array], None] | None = None,
    ) -> None:
        self.index = index
        self._scenario = scenario
        self._survey_s = scenario.survey_s(index)
        self._path: Lawnmower | Turned = Lawnmower(
            scenario, index, np.random.default_rng([seed, index, 0])
        )
        self._errors = NavigationErrors(scenario, index, seed)
        self._attitude_rng = np.random.default_rng([seed, index, 2])
        self._sonar = Multibeam(
            scenario,
            seabed,
            self._errors.roll_bias_deg,
            np.random.default_rng([seed, index, 3]),
        )
        motion = np.random.default_rng([seed, index, 4])
        self._periods_s, self._phases = motion.uniform(5.0, 11.0, 4), motion.uniform(0, 6.28, 4)
        self._on_soundings = on_soundings

    def true_position(self, time_s: float) -> tuple[float, float, float]:
        """Return where the vehicle truly is: north, east, depth."""
        path = self._path.at(time_s)
        return float(path.north_m[0]), float(path.east_m[0]), self._scenario.vehicle_depth_m

    def true_track(self) -> TrueTrack:
        """Return the true states once a second from start to the mission's end."""
        time_s = np.arange(0.0, math.floor(self._scenario.duration_s) + 1.0)
        poses = self._poses(time_s)
        return TrueTrack(
            time_s=time_s,
            north_m=poses.north_m,
            east_m=poses.east_m,
            depth_m=poses.depth_m,
            roll_rad=poses.roll_rad,
            pitch_rad=poses.pitch_rad,
            yaw_rad=poses.yaw_rad,
        )

    def steps(self) -> Iterator[tuple[Odometry, Ping | None]]:
        """Yield navigation and, where there is one, ping of each tick from 0 to the mission's end.

        An odometry's velocity is the mean over the interval that ends at its time, so that their
        sum is the dead-reckoned track without an error of integration. After the survey the sonar
        is off.
        """
        beams_rad = self._sonar.angles_rad
        for chunk in self._chunks():
            for k in range(len(chunk.time_s)):
                yaw_rad, depth_m = float(chunk.yaw_rad[k]), float(chunk.depth_m[k])
                time_s = float(chunk.time_s[k])
                odometry = Odometry(
                    time_s=time_s,
                    velocity_north_mps=float(chunk.velocity_mps[k, 0]),
                    velocity_east_mps=float(chunk.velocity_mps[k, 1]),
                    yaw_rad=yaw_rad,
                    depth_m=depth_m,
                    fix=self._fix(time_s),
                )
                is_silent = time_s > self._survey_s or not chunk.is_ping[k]
                if chunk.ranges_m is None or is_silent:
                    yield odometry, None
                    continue
                yield (
                    odometry,
                    Ping(
                        time_s=time_s,
                        slant_ranges_m=chunk.ranges_m[k].copy(),
                        beam_angles_rad=beams_rad.copy(),
                        roll_rad=float(chunk.roll_rad[k]),
                        pitch_rad=float(chunk.pitch_rad[k]),
                        yaw_rad=yaw_rad,
                        depth_m=depth_m,
                    ),
                )

    def steer(self, from_s: float, heading_rad: float | None = None) -> None:
        """Leave the survey for a straight line: on, or at a heading.

        It must lie beyond the chunk of CHUNK_S that was measured already.
        """
        if heading_rad is None:
            heading_rad = float(self._path.at(from_s).yaw_rad[0])
        self._path = Turned(self._path, from_s, heading_rad, self._scenario.speed_mps)

    def told_start(self) -> tuple[float, float, float]:
        """Return north, east, depth at which the vehicle is told that it begins."""
        north_m, east_m, depth_m = self.true_position(0.0)
        error_m = self._errors.start_error_m
        return north_m + float(error_m[0]), east_m + float(error_m[1]), depth_m

    def _fix(self, time_s: float) -> Fix | None:
        """Return the fix that the leader has at an instant; it dives on as if it had not risen."""
        every_s = 60.0 * self._scenario.gnss_fix_every_min
        if self.index != 0 or not every_s:
            return None
        last_s = time_s - self._scenario.tick_s
        last, now = (math.floor(at_s / every_s + 1e-9) for at_s in (last_s, time_s))
        if not time_s or now == last:
            return None
        north_m, east_m = self._errors.fix_m(np.array(self.true_position(time_s)[:2]))
        return Fix(
            north_m=float(north_m), east_m=float(east_m), sigma_m=self._scenario.gnss_sigma_m
        )

    def _chunks(self) -> Iterator[_Chunk]:
        rate_hz = self._scenario.tick_hz
        last = math.floor(self._scenario.duration_s * rate_hz + 1e-9)
        size = max(1, round(CHUNK_S * rate_hz))
        for first in range(0, last + 1, size):
            yield self._chunk(np.arange(first, min(first + size, last + 1)))

    def _chunk(self, ticks: NDArray[np.int64]) -> _Chunk:
        rate_hz = self._scenario.tick_hz
        time_s = ticks / rate_hz
        pings_due = np.floor(np.stack([ticks - 1, ticks]) * self._scenario.ping_hz / rate_hz + 1e-9)
        poses = self._poses(time_s)
        before_s = np.concatenate([[max(0.0, time_s[0] - self._scenario.tick_s)], time_s])
        path = self._path.at(before_s)
        reckoned_m = self._errors.reckoned_steps(
            before_s, np.stack([path.north_m, path.east_m], axis=1)
        )
        tilt_rad = math.radians(self._scenario.attitude_noise_deg)
        noise = self._attitude_rng.standard_normal((3, len(time_s)))
        heading_rad = math.radians(self._scenario.heading_noise_deg) * noise[2]
        chunk = _Chunk(
            time_s=time_s,
            is_ping=pings_due[1] > pings_due[0],
            velocity_mps=reckoned_m * rate_hz,
            roll_rad=poses.roll_rad + tilt_rad * noise[0],
            pitch_rad=poses.pitch_rad + tilt_rad * noise[1],
            yaw_rad=wrap_angle(poses.yaw_rad + self._errors.heading_bias_rad + heading_rad),
            depth_m=poses.depth_m + self._errors.depth_offset_m(time_s),
            ranges_m=None,
        )
        if time_s[0] > self._survey_s or not chunk.is_ping.any():
            return chunk
        return self._with_ranges(chunk, poses)

    def _with_ranges(self, chunk: _Chunk, poses: Poses) -> _Chunk:
        at = chunk.is_ping
        ranges_m = np.full((len(at), len(self._sonar.angles_rad)), np.nan)
        fliers = np.zeros(ranges_m.shape, dtype=np.bool_)
        ranges_m[at], fliers[at] = self._sonar.measure(poses.part(at))
        if self._on_soundings is not None:
            used = ~fliers & (chunk.time_s <= self._survey_s)[:, None]
            self._on_soundings(self._sonar.soundings(poses, np.where(used, ranges_m, np.nan)))
        return dataclasses.replace(chunk, ranges_m=ranges_m)

    def _poses(self, time_s: Array) -> Poses:
        path = self._path.at(time_s)
        waves = [
            np.sin(2.0 * np.pi * time_s / period_s + phase)
            for period_s, phase in zip(self._periods_s, self._phases, strict=True)
        ]
        roll_rad = math.radians(self._scenario.roll_amplitude_deg) / 2.0 * (waves[0] + waves[1])
        pitch_rad = math.radians(self._scenario.pitch_amplitude_deg) / 2.0 * (waves[2] + waves[3])
        return Poses(
            north_m=path.north_m,
            east_m=path.east_m,
            depth_m=np.full(time_s.shape, self._scenario.vehicle_depth_m),
            roll_rad=roll_rad,
            pitch_rad=pitch_rad,
            yaw_rad=path.yaw_rad,
        )
