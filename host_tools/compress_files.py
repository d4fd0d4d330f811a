"""`fathomlink compress` and `fathomlink reconstruct`: soundings to frames to a grid, by files."""

import argparse
import dataclasses
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from firmware.compression import compress, packets_from
from firmware.compression.binning import SoundingBins
from firmware.compression.packing import submap_header
from firmware.compression.settings import BinningSettings, CompressionSettings
from firmware.follower.settings import FollowerSettings
from firmware.geometry import Array
from firmware.leader.reconstruction import ReconstructionSettings, reconstruct_packets
from firmware.submaps import Track
from host_tools.commands import CHOICES, Command, check_apart
from protocol.codec import decode, encode
from protocol.errors import ConfigError, EstimationError, ProtocolError, RemoteProtocolError
from protocol.lattice import PROTECTION_BYTES
from protocol.packets import (
    DEEPEST_M,
    FARTHEST_M,
    HIGHEST_M,
    SIZE_BYTES,
    Fragment,
    Profile,
    SubmapPacket,
)
from protocol.settings import replace

_SOUNDINGS = ("north_m", "east_m", "depth_m", "time_s")
_TRACK = ("track_time_s", "track_north_m", "track_east_m", "track_yaw_rad")
_MOST_STATES = 40
_STATE_S = 1.25  # that a state stands for, and a quarter by which it may be rounded
_LATEST_S = 1e11  # three thousand years; UTC has 2e9
_ANY_VARIANCE_M2 = 1e30
_MOST_BYTES = 1 << 20  # of a file of frames: a sub-map has 2,560


def compress_file(
    soundings: Path,
    out: Path,
    profile: str,
    frames: int | None = None,
    *,
    small: bool = False,
    settings: CompressionSettings | None = None,
) -> str:
    """Write a sub-map's frames, back to back, to `out`; return a line that says how it went.

    Raises
    ------
    ConfigError
        When the soundings cannot be read or make no sub-map, or so many frames cannot hold it.
    """
    columns, track = read_soundings(soundings)
    settings = settings or CompressionSettings()
    settings = _with_frames(settings, profile, frames, small)
    bins = SoundingBins(BinningSettings())
    bins.add(np.column_stack(columns[:3]), columns[3])
    cells = bins.result()
    quarters = round(4.0 * float(track.time_s[0])) % (1 << 20)
    try:
        compressed = compress(cells, settings, profile)
        packets = packets_from(compressed, track, submap_header(time_quarters=quarters))
        data = b"".join(encode(packet) for packet in packets)
    except (EstimationError, ProtocolError) as error:
        raise ConfigError(f"{soundings} makes no {profile} sub-map: {error}") from error
    if small:
        _check_map(soundings, packets)
    _write(out, data)
    report = compressed.report
    return (
        f"{bins.soundings} soundings in {len(cells.count)} cells, {len(packets)} frames, "
        f"{len(data)} bytes; {bins.dropped_bad} bad and {bins.dropped_fliers} wild soundings "
        f"dropped; fit: {report.ended} after {report.evaluations} evaluations, "
        f"{report.failed_factorisations} failed factorisations{_late(columns[3], track)}"
    )


def _late(time_s: Array, track: Track) -> str:
    """Return what to add where soundings (N,) were measured after the track's last state."""
    late = int(np.count_nonzero(time_s > track.time_s[-1] + _STATE_S))
    if not late:
        return ""
    return (
        f"; {late} soundings are later than the track, of which a sub-map holds {_MOST_STATES} "
        f"states: the last is {track.time_s[-1] - track.time_s[0]:.0f} s after the first"
    )


def reconstruct_file(frames: Path, out: Path, drop: set[int], cell_m: float) -> str:
    """Write the grid of the frames that were not dropped to `out`; return a line about it.

    Raises
    ------
    ConfigError
        When the file holds no sub-map's frames or what remains gives no map.
    """
    fragments = read_frames(frames)
    unknown = sorted(drop - set(range(max(fragments) + 1)))
    if unknown:
        raise ConfigError(f"--drop {unknown[0]}: {frames} has fragments 0 to {max(fragments)}")
    kept = {index: packet for index, packet in fragments.items() if index not in drop}
    settings = ReconstructionSettings(cell_m=cell_m)
    try:
        found = reconstruct_packets(kept, settings, 0.0)
    except EstimationError as error:
        raise ConfigError(f"{len(kept)} frames of {frames} give no map: {error}") from error
    grid = found.grid
    good = int(np.count_nonzero(np.isfinite(grid.depth_m)))
    if not good:
        raise ConfigError(
            f"{len(kept)} of {len(fragments)} frames of {frames} give no cell: "
            + _why_no_cell(kept, settings)
        )
    with open(out, "wb") as file:
        rows, columns = grid.depth_m.shape
        np.savez_compressed(
            file,
            north_m=grid.north0_m + grid.cell_m * np.arange(rows),
            east_m=grid.east0_m + grid.cell_m * np.arange(columns),
            depth_m=grid.depth_m,
            variance_m2=grid.variance_m2,
        )
    return (
        f"{len(kept)} of {len(fragments)} frames, {good} cells of {grid.cell_m:g} m; "
        f"{found.recovered_points} points recovered from parity"
    )


def _check_map(soundings: Path, packets: Sequence[Fragment]) -> None:
    """Raise ConfigError where small frames hold so much track that no map comes of all of them."""
    try:
        reconstruct_packets(dict(enumerate(packets)), ReconstructionSettings(), 0.0)
    except EstimationError as error:
        raise ConfigError(
            f"{soundings} makes no map in {len(packets)} frames of 62 bytes, filled by its track; "
            f"give a smooth one ({', '.join(_TRACK)}) or more --frames, or leave --small out"
        ) from error


def _why_no_cell(fragments: dict[int, Fragment], settings: ReconstructionSettings) -> str:
    """Return why a rebuilt grid is empty, and what would fill it."""
    most_m2 = settings.max_variance_m2
    uncut = replace(settings, {"max_variance_m2": _ANY_VARIANCE_M2})
    variance_m2 = reconstruct_packets(fragments, uncut, 0.0).grid.variance_m2
    if not np.isfinite(variance_m2).any():
        return (
            f"the soundings enclose none of {settings.cell_m:g} m; compress those of a swath, or "
            "give a smaller --cell"
        )
    return (
        f"no depth is known to {most_m2:g} m2 beyond its soundings' noise, the best to "
        f"{np.nanmin(variance_m2):.2g} with it; "
        "drop fewer frames, or compress more soundings, less rough ones, or as another --profile"
    )


def read_soundings(path: Path) -> tuple[list[Array], Track]:
    """Return north, east, depth, time (N,) each, and the track, given or along the soundings.

    Raises
    ------
    ConfigError
        When the file is no npz of these arrays, or they disagree.
    """
    try:
        if path.is_file() and not zipfile.is_zipfile(path):
            raise ConfigError(f"{path} is no npz; give one such as replay or numpy.savez writes")
        with path.open("rb") as stream, np.load(stream) as data:
            names = [name for name in (*_SOUNDINGS, *_TRACK) if name in data.files]
            arrays = {name: data[name].astype(np.float64, casting="same_kind") for name in names}
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror or error}") from error
    except (zipfile.BadZipFile, zlib.error, NotImplementedError) as error:
        raise ConfigError(f"{path} is damaged or no npz: {error}") from error
    except (ValueError, KeyError, EOFError, TypeError, AttributeError) as error:
        raise ConfigError(f"{path} is not an npz of numeric arrays: {error}") from error
    missing = [name for name in _SOUNDINGS if name not in arrays]
    if missing:
        raise ConfigError(f"{path} lacks {', '.join(missing)}; needed: {', '.join(_SOUNDINGS)}")
    columns = [arrays[name].ravel() for name in _SOUNDINGS]
    if len({column.size for column in columns}) != 1:
        sizes = ", ".join(str(column.size) for column in columns)
        raise ConfigError(f"{path}: {', '.join(_SOUNDINGS)} have {sizes} values; give equally many")
    if not np.isfinite(np.column_stack(columns)).all(axis=1).any():
        raise ConfigError(f"{path} holds no sounding that is finite in all of its four numbers")
    farthest_m = float(np.nanmedian(np.abs(np.concatenate(columns[:2]))))
    if farthest_m > FARTHEST_M:
        raise ConfigError(
            f"{path}: coordinates of {farthest_m:.0f} m; give them from a mission datum within "
            f"{FARTHEST_M / 1000:.0f} km, float32 on the wire steps by half a metre out there"
        )
    depth_m = float(np.nanmedian(columns[2]))
    if not HIGHEST_M <= depth_m <= DEEPEST_M:
        raise ConfigError(
            f"{path}: depths of {depth_m:.0f} m; give metres, positive down, from {HIGHEST_M:.0f} "
            f"to {DEEPEST_M:.0f}"
        )
    for name in ("time_s", "track_time_s"):
        times_s = np.abs(arrays.get(name, np.zeros(1)))
        latest_s = float(np.max(times_s, where=np.isfinite(times_s), initial=0.0))
        if latest_s > _LATEST_S:
            raise ConfigError(f"{path}: {name} of {latest_s:g} s; give seconds, UTC or less")
    given = [name for name in _TRACK if name in arrays]
    if given and len(given) < len(_TRACK):
        raise ConfigError(f"{path} has {given[0]} but not all of {', '.join(_TRACK)}")
    track = _given_track(path, arrays) if given else _track_along(columns)
    return columns, track


def read_frames(path: Path) -> dict[int, Fragment]:
    """Return the fragments of the one sub-map in a file of frames back to back.

    Raises
    ------
    ConfigError
        When there is none, or a frame is damaged or of another sub-map.
    """
    try:
        data = path.read_bytes()[: _MOST_BYTES + 1]
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from error
    if not data or len(data) > _MOST_BYTES:
        raise ConfigError(f"{path} has {len(data)} bytes; give the frames of one sub-map")
    size = SIZE_BYTES[Profile.SUBMAP_PAPER]
    if len(data) % size or (data[0] & 31) == Profile.SUBMAP_LATTICE_SMALL:
        size = SIZE_BYTES[Profile.SUBMAP_LATTICE_SMALL]
    if len(data) % size:
        raise ConfigError(f"{path} has {len(data)} bytes; frames have 256, small ones 62")
    fragments: dict[int, Fragment] = {}
    first = None
    for start in range(0, len(data), size):
        try:
            packet = decode(data[start : start + size])
        except RemoteProtocolError as error:
            raise ConfigError(f"{path}, frame {start // size}: {error}") from error
        if not isinstance(packet, Fragment):
            raise ConfigError(f"{path}, frame {start // size} is no fragment of a sub-map")
        first = packet if first is None else first
        known = fragments.setdefault(packet.header.fragment, packet)
        if _common(packet) != _common(first) or _content(packet) != _content(known):
            raise ConfigError(
                f"{path}, frame {start // size} ({_named(packet)}) is of another sub-map than "
                f"frame 0 ({_named(first)}); give the frames of one"
            )
    return fragments


def _common(packet: Fragment) -> tuple[object, ...]:
    """Return what all fragments of a sub-map have in common."""
    header = packet.header
    key = (header.profile, header.vehicle, header.boot_epoch, header.submap, header.fragment_count)
    if isinstance(packet, SubmapPacket):
        return (*key, packet.hyperparameters.tobytes())
    return (*key, packet.body[:PROTECTION_BYTES])


def _content(packet: Fragment) -> bytes:
    """Return what a repeat of a fragment has in common with it: all but when it was sent."""
    header = dataclasses.replace(packet.header, tx_second=0)
    return encode(dataclasses.replace(packet, header=header))


def _named(packet: Fragment) -> str:
    header = packet.header
    return f"{header.profile.name}, vehicle {header.vehicle}, number {header.submap}"


def _given_track(path: Path, arrays: dict[str, Array]) -> Track:
    rows = [arrays[name].ravel() for name in _TRACK]
    if len({row.size for row in rows}) != 1 or not rows[0].size:
        raise ConfigError(f"{path}: {', '.join(_TRACK)} must have equally many values, at least 1")
    states = np.column_stack(rows)
    states = states[np.isfinite(states).all(axis=1)]
    if not len(states):
        raise ConfigError(f"{path}: no state of the track is finite")
    states = states[np.argsort(states[:, 0], kind="stable")]
    whole = np.unique(np.round(states[:, 0] - states[0, 0]).astype(np.int64), return_index=True)[1]
    states = states[whole][:_MOST_STATES]
    return Track(
        time_s=states[:, 0], north_m=states[:, 1], east_m=states[:, 2], yaw_rad=states[:, 3]
    )


def _track_along(columns: list[Array]) -> Track:
    """Return the mean position of the soundings of each second, heading along it."""
    good = np.isfinite(np.column_stack(columns)).all(axis=1)
    north_m, east_m, _, time_s = (column[good] for column in columns)
    second = np.floor(time_s - time_s.min()).astype(np.int64)
    seconds, inverse = np.unique(np.minimum(second, _MOST_STATES - 1), return_inverse=True)
    count = np.bincount(inverse)
    north = np.bincount(inverse, north_m) / count
    east = np.bincount(inverse, east_m) / count
    yaw = np.zeros(len(seconds))
    if len(seconds) > 1:
        yaw = np.arctan2(np.gradient(east), np.gradient(north))
    first_s = 0.25 * np.round(4.0 * float(time_s.min()))
    return Track(time_s=first_s + seconds, north_m=north, east_m=east, yaw_rad=yaw)


def _with_frames(
    settings: CompressionSettings, profile: str, frames: int | None, small: bool
) -> CompressionSettings:
    if small and profile not in {"lattice", "auto"}:
        raise ConfigError("--small frames exist for --profile lattice only")
    if frames is None:
        frames = settings.frames if profile != "paper" else 10
    if profile == "paper" and frames != 10:
        raise ConfigError("--profile paper has 10 frames; --frames is for dense and lattice")
    if not 1 <= frames <= 15:
        raise ConfigError(f"--frames {frames}: a transfer has 1 to 15 fragments")
    return replace(settings, {"frames": frames, "small_frames": small})


def _write(path: Path, data: bytes) -> None:
    try:
        path.write_bytes(data)
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from error


def _configure_compress(parser: argparse.ArgumentParser) -> None:
    profile = FollowerSettings().profile
    parser.add_argument(
        "soundings",
        type=Path,
        metavar="SOUNDINGS.npz",
        help=f"arrays {', '.join(_SOUNDINGS)}; with a track also {', '.join(_TRACK)}",
    )
    parser.add_argument(
        "--profile",
        choices=CHOICES,
        default=profile,
        help=f"default: {profile}; auto: lattice in the fewest frames that do about as well",
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="FRAMES.bin", help="frames back to back"
    )
    parser.add_argument(
        "--frames",
        type=int,
        metavar="N",
        help="how many, for dense and lattice, or at most, for auto; default: 10",
    )
    parser.add_argument("--small", action="store_true", help="lattice in frames of 62 bytes")


def _configure_reconstruct(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("frames", type=Path, metavar="FRAMES.bin", help="what compress wrote")
    parser.add_argument("--drop", default="", metavar="I,J", help="fragments to leave out, from 0")
    parser.add_argument(
        "--cell", type=float, default=1.0, metavar="M", help="of the grid, in metres; default: 1.0"
    )
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        metavar="GRID.npz",
        help="arrays north_m, east_m, depth_m (rows north), variance_m2",
    )


def _run_compress(arguments: argparse.Namespace) -> None:
    check_apart(arguments.soundings, arguments.out)
    print(
        compress_file(
            arguments.soundings,
            arguments.out,
            arguments.profile,
            arguments.frames,
            small=arguments.small,
        )
    )


def _run_reconstruct(arguments: argparse.Namespace) -> None:
    check_apart(arguments.frames, arguments.out)
    try:
        drop = {int(text) for text in arguments.drop.split(",") if text.strip()}
    except ValueError as error:
        raise ConfigError(f"--drop {arguments.drop!r} is not a list such as 2,7") from error
    print(reconstruct_file(arguments.frames, arguments.out, drop, arguments.cell))


COMPRESS = Command(
    name="compress",
    help="compress soundings to the frames of one sub-map",
    configure=_configure_compress,
    run=_run_compress,
)
RECONSTRUCT = Command(
    name="reconstruct",
    help="rebuild a sub-map's grid from its frames",
    configure=_configure_reconstruct,
    run=_run_reconstruct,
)
