"""The file commands, on good soundings and on every bad input that was thought of."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

from firmware.compression.settings import CompressionSettings
from firmware.geometry import Array
from host_tools.compress_files import compress_file, reconstruct_file
from protocol.codec import decode, encode
from protocol.errors import ConfigError
from tests.compression.conftest import Survey, relief_m

QUICK = CompressionSettings(iterations=3, dense_iterations=2)
PROFILES = ("paper", "dense", "lattice")


def saved(path: Path, soundings_ned_m: Array, time_s: Array | None = None) -> Path:
    north_m, east_m, depth_m = soundings_ned_m.T
    if time_s is None:
        time_s = np.linspace(0.0, 39.0, len(north_m))
    np.savez(path, north_m=north_m, east_m=east_m, depth_m=depth_m, time_s=time_s)
    return path


def grid_of(
    tmp_path: Path, soundings: Path, profile: str, drop: set[int], **options: int | bool
) -> tuple[Array, Array, Array, Array]:
    frames, out = tmp_path / "frames.bin", tmp_path / "grid.npz"
    compress_file(soundings, frames, profile, settings=QUICK, **options)  # type: ignore[arg-type]
    reconstruct_file(frames, out, drop, 1.0)
    with np.load(out) as data:
        return data["north_m"], data["east_m"], data["depth_m"], data["variance_m2"]


@pytest.mark.parametrize("profile", PROFILES)
def test_grid_of_received_frames_is_the_seabed(
    profile: str, survey: Survey, tmp_path: Path
) -> None:
    soundings = saved(tmp_path / "s.npz", survey.soundings_ned_m, survey.time_s)
    north_m, east_m, depth_m, variance_m2 = grid_of(tmp_path, soundings, profile, {2, 7})
    error_m = depth_m - relief_m(*np.meshgrid(north_m, east_m, indexing="ij"))
    assert np.sqrt(np.nanmean(error_m**2)) < 0.2  # m, of a relief of 1.3 m standard deviation
    assert np.array_equal(np.isnan(depth_m), np.isnan(variance_m2))
    assert np.isfinite(depth_m).mean() > 0.8
    assert np.nanmax(variance_m2) <= 0.1


def test_two_lattice_frames_hold_the_map(survey: Survey, tmp_path: Path) -> None:
    soundings = saved(tmp_path / "s.npz", survey.soundings_ned_m, survey.time_s)
    north_m, east_m, depth_m, _ = grid_of(tmp_path, soundings, "lattice", set(), frames=2)
    error_m = depth_m - relief_m(*np.meshgrid(north_m, east_m, indexing="ij"))
    assert np.sqrt(np.nanmean(error_m**2)) < 0.1
    assert (tmp_path / "frames.bin").stat().st_size == 512


def test_small_frames_of_62_bytes_hold_a_lattice(survey: Survey, tmp_path: Path) -> None:
    soundings = saved(tmp_path / "s.npz", survey.soundings_ned_m, survey.time_s)
    north_m, east_m, depth_m, _ = grid_of(tmp_path, soundings, "lattice", {4}, small=True)
    error_m = depth_m - relief_m(*np.meshgrid(north_m, east_m, indexing="ij"))
    assert np.sqrt(np.nanmean(error_m**2)) < 0.3
    assert (tmp_path / "frames.bin").stat().st_size == 620


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("deeper_m", [-130.0, 6000.0, 10_900.0, 11_900.0])
def test_depth_of_the_sea_does_not_matter(
    deeper_m: float, profile: str, survey: Survey, tmp_path: Path
) -> None:
    deep = survey.soundings_ned_m + np.array([0.0, 0.0, deeper_m])
    soundings = saved(tmp_path / "s.npz", deep, survey.time_s)
    north_m, east_m, depth_m, _ = grid_of(tmp_path, soundings, profile, set())
    error_m = depth_m - deeper_m - relief_m(*np.meshgrid(north_m, east_m, indexing="ij"))
    assert np.sqrt(np.nanmean(error_m**2)) < 0.3  # m
    assert np.isfinite(depth_m).mean() > 0.7


def test_wild_soundings_are_counted_once(survey: Survey, tmp_path: Path) -> None:
    soundings_ned_m = survey.soundings_ned_m.copy()
    soundings_ned_m[::500, 2] += 20.0
    soundings = saved(tmp_path / "s.npz", soundings_ned_m, survey.time_s)
    line = compress_file(soundings, tmp_path / "f.bin", "lattice", settings=QUICK)
    found = re.search(r"(\d+) wild soundings", line)
    assert found is not None
    assert int(found[1]) < 1.2 * len(soundings_ned_m) / 500


# hardly any depth of pseudo points is then as certain as the leader keeps
UNCERTAIN = {
    "fewer soundings than points": {"dense"},
    "millimetres across": {"paper", "dense", "lattice"},
    "cliff of 40 m": {"paper"},
}
BORDERLINE = {("cliff of 40 m", "dense")}  # which cells are certain is a matter of rounding
NO_CELL = "give no cell: (no depth is known to .* m2 beyond|the soundings enclose)"


def bad_inputs() -> dict[str, Array]:
    rng = np.random.default_rng(0)
    area = rng.uniform([-40.0, -60.0], [40.0, 60.0], (4000, 2))
    noise_m = 0.1 * rng.normal(size=4000)
    flat = np.column_stack([area, np.full(4000, 40.0)])
    rough = np.column_stack([area, relief_m(*area.T) + noise_m])
    broken = rough.copy()
    broken[::3, 2] = np.nan
    wild = rough.copy()
    wild[::20, 2] += rng.uniform(-30.0, 30.0, 200)
    apart = rough.copy()
    apart[2000:, 0] += 10_000.0
    return {
        "fewer soundings than points": rough[:60],
        "constant depth without noise": flat,
        "cliff of 40 m": np.column_stack([area, np.where(area[:, 0] > 3.0, 20.0, 60.0)]),
        "step of 3 m": np.column_stack([area, np.where(area[:, 0] > 3.0, 40.0, 43.0)]),
        "one in three is NaN": broken,
        "one in twenty is wild": wild,
        "two places 10 km apart": apart,
        "hole in the middle": rough[np.hypot(*area.T) > 25.0],
        "millimetres across": rough * np.array([1e-4, 1e-4, 1.0]),
    }


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("name", bad_inputs())
def test_awkward_soundings_give_frames_and_a_grid_or_one_clear_error(
    name: str, profile: str, tmp_path: Path
) -> None:
    soundings = saved(tmp_path / "s.npz", bad_inputs()[name])
    if name == "two places 10 km apart" and profile != "paper":
        with pytest.raises(ConfigError, match="track"):
            grid_of(tmp_path, soundings, profile, set())
        return
    depth_m, refusal = np.full(1, np.nan), "none"
    try:
        _, _, depth_m, _ = grid_of(tmp_path, soundings, profile, set())
    except ConfigError as error:
        refusal = str(error)
    finite = depth_m[np.isfinite(depth_m)]
    assert finite.size or re.search(NO_CELL, refusal)
    if (name, profile) not in BORDERLINE:
        assert (finite.size > 0.01 * depth_m.size) != (profile in UNCERTAIN.get(name, ()))
    assert np.all((finite > 0.0) & (finite < 90.0))


@pytest.mark.parametrize(
    ("second", "vehicle"), [("lattice", 2), ("lattice", 1), ("dense", 1), ("paper", 1)]
)
def test_frames_of_two_sub_maps_are_refused(
    second: str, vehicle: int, survey: Survey, tmp_path: Path
) -> None:
    soundings = saved(tmp_path / "s.npz", survey.soundings_ned_m, survey.time_s)
    other = saved(tmp_path / "o.npz", survey.soundings_ned_m[::2], survey.time_s[::2])
    one, two, both = (tmp_path / name for name in ("1.bin", "2.bin", "both.bin"))
    compress_file(soundings, one, "lattice", settings=QUICK)
    compress_file(other, two, second, settings=QUICK)
    frames = [renumbered(data, vehicle) for data in frames_of(two)]
    both.write_bytes(one.read_bytes() + b"".join(frames))
    with pytest.raises(ConfigError, match=r"frame 10 \(.*\) is of another sub-map than frame 0"):
        reconstruct_file(both, tmp_path / "g.npz", set(), 1.0)
    both.write_bytes(b"".join(frames_of(one)[:5] + frames[5:]))
    with pytest.raises(ConfigError, match=r"frame 5 \(.*\) is of another sub-map than frame 0"):
        reconstruct_file(both, tmp_path / "g.npz", set(), 1.0)


def test_repeats_of_frames_are_frames_of_the_sub_map(survey: Survey, tmp_path: Path) -> None:
    soundings = saved(tmp_path / "s.npz", survey.soundings_ned_m, survey.time_s)
    frames = tmp_path / "f.bin"
    compress_file(soundings, frames, "lattice", settings=QUICK)
    again = b"".join(renumbered(data, 1, tx_second=9) for data in frames_of(frames)[:4])
    frames.write_bytes(frames.read_bytes() + again)
    line = reconstruct_file(frames, tmp_path / "g.npz", set(), 1.0)
    assert line.startswith("10 of 10 frames")


def frames_of(path: Path) -> list[bytes]:
    data = path.read_bytes()
    return [data[start : start + 256] for start in range(0, len(data), 256)]


def renumbered(data: bytes, vehicle: int, tx_second: int = 0) -> bytes:
    packet = decode(data)
    header = dataclasses.replace(packet.header, vehicle=vehicle, tx_second=tx_second)
    return encode(dataclasses.replace(packet, header=header))


@pytest.mark.parametrize("profile", PROFILES)
def test_one_line_of_soundings_is_told_from_a_map(profile: str, tmp_path: Path) -> None:
    along = np.linspace(-40.0, 40.0, 3000)
    line = np.column_stack([along, np.zeros(3000), relief_m(along, np.zeros(3000))])
    soundings = saved(tmp_path / "s.npz", line)
    with pytest.raises(ConfigError, match="enclose none" if profile == "lattice" else "line"):
        grid_of(tmp_path, soundings, profile, set())


@pytest.mark.parametrize(
    ("soundings", "complaint"),
    [
        (np.array([[4_600_000.0, 330_000.0, 20.0]] * 9), "mission datum"),
        (np.full((9, 3), np.nan), "no sounding that is finite"),
        (np.array([[1.0, 2.0, 20.0]] * 9), "usable cells"),
        (np.array([[1.0, 2.0, 12_500.0]] * 9), r"depths of 12500 m; .* to 12000"),
        (np.array([[1.0, 2.0, -6_000.0]] * 9), "positive down"),
    ],
)
def test_soundings_of_which_no_map_can_be_made_are_refused(
    soundings: Array, complaint: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=complaint):
        compress_file(saved(tmp_path / "s.npz", soundings), tmp_path / "f.bin", "paper")


@pytest.mark.parametrize("damage", ["cut", "flipped", "torn"])
def test_damaged_soundings_are_told(damage: str, survey: Survey, tmp_path: Path) -> None:
    soundings = saved(tmp_path / "s.npz", survey.soundings_ned_m, survey.time_s)
    if damage == "torn":  # within what is compressed
        with np.load(soundings) as arrays:
            np.savez_compressed(soundings, **arrays)
    data = bytearray(soundings.read_bytes())
    data[400:420] = bytes(20) if damage == "torn" else bytes(b ^ 0xFF for b in data[400:420])
    soundings.write_bytes(data[: len(data) // 2] if damage == "cut" else data)
    with pytest.raises(ConfigError, match=r"s\.npz is (damaged or )?no npz"):
        compress_file(soundings, tmp_path / "f.bin", "lattice")


@pytest.mark.parametrize("name", ["time_s", "track_time_s"])
def test_times_that_are_none_are_refused(name: str, survey: Survey, tmp_path: Path) -> None:
    north_m, east_m, depth_m = survey.soundings_ned_m.T
    columns = {"north_m": north_m, "east_m": east_m, "depth_m": depth_m, "time_s": survey.time_s}
    track = {"track_time_s": np.arange(2.0), "track_north_m": np.arange(2.0)}
    track |= {"track_east_m": np.arange(2.0), "track_yaw_rad": np.zeros(2)}
    wild = {**columns, **track}
    wild[name] = wild[name] * 1e300
    np.savez(tmp_path / "s.npz", **wild)
    with pytest.raises(ConfigError, match=rf"{name} of \S+ s; give seconds"):
        compress_file(tmp_path / "s.npz", tmp_path / "f.bin", "lattice")


@pytest.mark.parametrize("states", [40, 60, None])
def test_soundings_later_than_the_track_are_told(
    states: int | None, survey: Survey, tmp_path: Path
) -> None:
    north_m, east_m, depth_m = survey.soundings_ned_m.T
    time_s = np.linspace(0.0, 39.99 if states == 40 else 59.99, len(north_m))
    columns = {"north_m": north_m, "east_m": east_m, "depth_m": depth_m, "time_s": time_s}
    if states is not None:
        at = np.arange(float(states))
        columns |= {"track_time_s": at, "track_north_m": at, "track_east_m": 0.0 * at}
        columns |= {"track_yaw_rad": 0.0 * at}
    np.savez(tmp_path / "s.npz", **columns)
    told = compress_file(tmp_path / "s.npz", tmp_path / "f.bin", "lattice", settings=QUICK)
    late = re.search(r"; (\d+) soundings are later than the track.* 39 s after the first", told)
    if states == 40:
        assert late is None
    else:
        assert late is not None
        assert int(late[1]) == np.count_nonzero(time_s > 39.0 + 1.25)


@pytest.mark.parametrize("other", [np.array("a note"), np.array([None]), np.array([1j])])
def test_arrays_beside_the_soundings_are_left_alone(
    other: Array, survey: Survey, tmp_path: Path
) -> None:
    north_m, east_m, depth_m = survey.soundings_ned_m.T
    columns = {"north_m": north_m, "east_m": east_m, "depth_m": depth_m, "time_s": survey.time_s}
    np.savez(tmp_path / "s.npz", **columns, note=other)
    compress_file(tmp_path / "s.npz", tmp_path / "f.bin", "lattice", settings=QUICK)
    np.savez(tmp_path / "s.npz", **columns | {"north_m": np.resize(other, north_m.size)})
    with pytest.raises(ConfigError, match="is not an npz of numeric arrays"):
        compress_file(tmp_path / "s.npz", tmp_path / "f.bin", "lattice", settings=QUICK)


@pytest.mark.parametrize("kind", [np.int32, np.uint16, np.float32])
def test_soundings_of_any_number_kind_are_read(kind: type, survey: Survey, tmp_path: Path) -> None:
    whole: Array = np.abs(np.round(survey.soundings_ned_m)).astype(kind)
    soundings = saved(tmp_path / "s.npz", whole, survey.time_s)
    compress_file(soundings, tmp_path / "f.bin", "lattice", settings=QUICK)


def test_small_frames_too_few_for_a_map_are_refused(tmp_path: Path) -> None:
    """A track that jumps about takes half of each."""
    rng = np.random.default_rng(0)
    area = rng.uniform([-40.0, -60.0], [40.0, 60.0], (4000, 2))
    soundings = saved(tmp_path / "s.npz", np.column_stack([area, relief_m(*area.T)]))
    with pytest.raises(ConfigError, match=r"makes no map in 1 frames of 62 bytes.*track_time_s"):
        compress_file(soundings, tmp_path / "f.bin", "lattice", frames=1, small=True)
    assert not (tmp_path / "f.bin").exists()
    compress_file(soundings, tmp_path / "f.bin", "lattice", small=True)
    assert (tmp_path / "f.bin").stat().st_size == 10 * 62


def test_files_that_hold_something_else_are_refused(tmp_path: Path) -> None:
    text = tmp_path / "text.npz"
    text.write_text("no arrays here")
    with pytest.raises(ConfigError, match=r"text\.npz is no npz; give one such as replay"):
        compress_file(text, tmp_path / "f.bin", "paper")
    with pytest.raises(ConfigError, match="cannot read"):
        compress_file(tmp_path / "nowhere.npz", tmp_path / "f.bin", "paper")
    with pytest.raises(ConfigError, match="bytes"):
        reconstruct_file(text, tmp_path / "g.npz", set(), 1.0)
