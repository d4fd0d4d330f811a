"""What each vehicle's process writes, and the evaluation reads when the mission is over.

In `processes/` under --out, per vehicle: `NAME.beliefs`, rows of ten little-endian doubles, one a
second, appended as they come, so that a killed process leaves all but its last; `NAME.json`,
counters; `NAME.soundings.npz`, what the simulated sonar measured, placed by true navigation, for
the map's truth; and of the leader `leader.npz`, its trajectories, closures and sheets.
"""

import contextlib
import dataclasses
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from firmware.belief import Belief
from firmware.dead_reckoning import ReckonedState
from firmware.geometry import Array, wrap_angle
from firmware.leader.trajectory import Trajectory
from host_tools.collect import LeaderRecord
from host_tools.mapping import DepthMap
from host_tools.nodes import ROW_NUMBERS, YAW, belief_columns, belief_row
from host_tools.results import ClosureResult, Counters, SoundingPatch
from protocol.errors import ConfigError
from protocol.seal_state import write_durably
from protocol.vehicles import LEADER, name_of

FOLDER = "processes"
_ROW_BYTES = 8 * ROW_NUMBERS
_PATCH = ("north_m", "east_m", "depth_m", "variance_m2", "time_s")
_TRAJECTORY = tuple(field.name for field in dataclasses.fields(Trajectory))


class VehicleFiles:
    """The files of one vehicle's process."""

    def __init__(self, out: Path, vehicle: int) -> None:
        self.folder, self.name = out / FOLDER, name_of(vehicle)

    def prepare(self) -> int | None:
        """Make the folder and return how often this vehicle has started before in it.

        None where the count is damaged; it stays so, lest a number be given twice.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self._path("starts")
        try:
            starts = int(path.read_text(encoding="ascii")) if path.exists() else 0
        except ValueError:
            return None
        write_durably(path, str(starts + 1))
        return starts

    def forget(self) -> None:
        """Remove what an earlier mission left."""
        for suffix in ("starts", "beliefs", "json", "soundings.npz", "npz", "log"):
            self._path(suffix).unlink(missing_ok=True)

    def note(self, belief: Belief, reckoned: ReckonedState) -> None:
        """Append one second to the beliefs, over what a full disk may have left of another."""
        row = np.array(belief_row(belief, reckoned), dtype="<f8")
        with self._path("beliefs").open("ab") as stream:
            stream.truncate(stream.tell() // _ROW_BYTES * _ROW_BYTES)
            stream.write(row.tobytes())

    def beliefs(self, time_s: Array) -> dict[str, np.ndarray]:
        """Return the columns of the beliefs on the grid time_s (T,), gaps interpolated.

        Raises
        ------
        ConfigError
            When there is none, or hardly any.
        """
        by_time = {float(row[0]): row for row in self._rows()}
        if len(by_time) < 2:
            path = self._path("beliefs")
            raise ConfigError(
                f"{path} holds no mission; start {self.name} with --out {path.parents[1]}"
            )
        known = np.array([by_time[t] for t in sorted(by_time)])
        known[:, YAW] = np.unwrap(known[:, YAW])
        columns = [np.interp(time_s, known[:, 0], known[:, k]) for k in range(ROW_NUMBERS)]
        columns[YAW] = wrap_angle(columns[YAW])
        return belief_columns(np.stack(columns, axis=1))

    def last_belief_s(self) -> float:
        """Return the newest time of the beliefs, NaN where there is none."""
        return float(max(self._rows()[:, 0], default=np.nan))

    def _rows(self) -> Array:
        data = self._path("beliefs").read_bytes() if self._path("beliefs").exists() else b""
        rows = np.frombuffer(data[: len(data) // _ROW_BYTES * _ROW_BYTES], dtype="<f8")
        return rows.reshape(-1, ROW_NUMBERS)

    def write_counters(self, counters: Counters) -> None:
        """Write the counters."""
        with self._whole("json") as stream:
            stream.write(json.dumps(counters, indent=1).encode() + b"\n")

    def missing(self) -> list[str]:
        """Return the names of the files that the vehicle's process did not live to write."""
        suffixes = ["json", "soundings.npz"] + ["npz"] * (self.name == name_of(LEADER))
        return [path.name for path in map(self._path, suffixes) if not path.exists()]

    def counters(self) -> dict[str, float]:
        """Return the counters, none if they are missing."""
        if not self._path("json").exists():
            return {}
        counters: dict[str, float] = json.loads(self._path("json").read_text(encoding="ascii"))
        return counters

    def write_soundings(self, truth_map: DepthMap) -> None:
        """Write what the sonar measured."""
        with self._whole("soundings.npz") as stream:
            np.savez(stream, sums=truth_map.sums)

    def add_soundings(self, truth_map: DepthMap) -> None:
        """Add what the sonar measured to a map, if it is there."""
        if not self._path("soundings.npz").exists():
            return
        with np.load(self._path("soundings.npz")) as arrays:
            truth_map.add_sums(arrays["sums"])

    def write_record(self, record: LeaderRecord) -> None:
        """Write what the leader holds."""
        arrays: dict[str, Any] = {}
        for vehicle, trajectory in record.trajectories.items():
            for field in _TRAJECTORY:
                arrays[f"trajectory.{vehicle}.{field}"] = getattr(trajectory, field)
            arrays[f"covariances.{vehicle}"] = record.covariances_m2[vehicle]
        for k, patch in enumerate(record.patches):
            columns = np.stack([getattr(patch, field) for field in _PATCH])
            arrays[f"patch.{patch.vehicle}.{k}"] = columns
        closures = [dataclasses.asdict(closure) for closure in record.closures]
        seen = json.dumps({"quantities": record.quantities, "remarks": record.remarks})
        arrays |= {"closures": np.array(json.dumps(closures)), "seen": np.array(seen)}
        with self._whole("npz") as stream:
            np.savez(stream, **arrays)

    def record(self) -> LeaderRecord:
        """Return what the leader holds, nothing if it is missing."""
        if not self._path("npz").exists():
            return LeaderRecord(trajectories={}, covariances_m2={}, closures=[], patches=[])
        with np.load(self._path("npz")) as arrays:
            vehicles = [int(k.split(".")[1]) for k in arrays.files if k.startswith("covariances.")]
            return LeaderRecord(
                trajectories={v: _trajectory(arrays, v) for v in vehicles},
                covariances_m2={v: arrays[f"covariances.{v}"] for v in vehicles},
                closures=[
                    ClosureResult(**closure) for closure in json.loads(str(arrays["closures"]))
                ],
                patches=self._patches(),
                **json.loads(str(arrays["seen"])),
            )

    def _patches(self) -> Iterator[SoundingPatch]:
        with np.load(self._path("npz")) as arrays:
            for key in arrays.files:
                if key.startswith("patch."):
                    columns = dict(zip(_PATCH, arrays[key], strict=True))
                    yield SoundingPatch(vehicle=int(key.split(".")[1]), **columns)

    @contextlib.contextmanager
    def _whole(self, suffix: str) -> Iterator[BinaryIO]:
        """Give a file to write that has its name once it is whole."""
        path = self._path(suffix)
        fresh = path.with_name(path.name + ".new")
        with fresh.open("wb") as stream:
            yield stream
        fresh.replace(path)

    def _path(self, suffix: str) -> Path:
        return self.folder / f"{self.name}.{suffix}"


def _trajectory(arrays: Mapping[str, np.ndarray], vehicle: int) -> Trajectory:
    return Trajectory(**{field: arrays[f"trajectory.{vehicle}.{field}"] for field in _TRAJECTORY})
