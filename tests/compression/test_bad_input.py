"""Bad input gives a valid packet or one clear error, and nothing fails silently."""

import dataclasses
import struct
from collections.abc import Callable

import numpy as np
import pytest

from firmware.compression import Compressed, CompressedCode, compress, packets_from
from firmware.compression.binning import SoundingBins
from firmware.compression.decoder import factorised
from firmware.compression.dense import DenseCode, dense_bodies
from firmware.compression.lattice import LatticeCode, lattice_bodies
from firmware.compression.packing import submap_header
from firmware.compression.settings import CompressionSettings
from firmware.compression.track_code import encode_track
from firmware.geometry import Array
from firmware.leader.reconstruction import ReconstructionSettings, reconstruct_packets
from firmware.submaps import BinnedSoundings
from protocol.codec import decode, encode
from protocol.errors import EstimationError, LocalProtocolError
from protocol.packets import Fragment, SubmapFragment, SubmapPacket
from tests.compression.conftest import Survey, relief_m

PROFILES = ("paper", "dense", "lattice")
QUICK = CompressionSettings(iterations=6, dense_iterations=4)
BOUNDS = ReconstructionSettings(cell_m=1.0, max_cells=200_000)
HEADER = submap_header()
ABSURD = (0.0, -1.0, 1e30, -1e30, 1e-30, float("nan"), float("inf"))


def area() -> Array:
    rng = np.random.default_rng(3)
    places_m = rng.uniform([-40.0, -60.0], [40.0, 60.0], (4000, 2))
    return np.column_stack([places_m, relief_m(*places_m.T) + 0.1 * rng.normal(size=4000)])


def changed(change: Callable[[Array], object]) -> Array:
    soundings = area()
    change(soundings)
    return soundings


def inputs() -> dict[str, Array]:
    every = area()
    line_m = np.linspace(-40.0, 40.0, 3000)
    quiet = np.column_stack([every[:, :2], relief_m(*every[:, :2].T)])
    return {
        "fewer soundings than points": every[:60],
        "one straight line": np.column_stack([line_m, 0.5 * line_m, relief_m(line_m, line_m)]),
        "constant depth": np.column_stack([every[:, :2], np.full(4000, 40.0)]),
        "a cliff": np.column_stack([every[:, :2], np.where(every[:, 0] > 3.0, 20.0, 60.0)]),
        "one in three is NaN": changed(lambda s: s[::3].fill(np.nan)),
        "all are NaN": np.full((50, 3), np.nan),
        "10 km apart": changed(lambda s: np.add(s[2000:], [1e4, 0, 0], out=s[2000:])),
        "millions of metres": every + np.array([5e6, 3e6, 0.0]),
        "zero noise": quiet,
        "a hole in the middle": every[np.hypot(every[:, 0], every[:, 1]) > 25.0],
    }


NO_PACKET = {"all are NaN", "millions of metres"}
NO_MAP = {"fewer soundings than points", "a cliff"}


def binned(soundings: Array) -> BinnedSoundings:
    bins = SoundingBins()
    bins.add(soundings, np.linspace(0.0, 39.0, len(soundings)))
    return bins.result()


def through_the_wire(compressed: Compressed, survey: Survey) -> dict[int, bytes]:
    packets = packets_from(compressed, survey.track, HEADER)
    return {packet.header.fragment: encode(packet) for packet in packets}


def received(frames: dict[int, bytes]) -> dict[int, Fragment]:
    out: dict[int, Fragment] = {}
    for fragment, frame in frames.items():
        packet = decode(frame)
        assert isinstance(packet, Fragment)
        out[fragment] = packet
    return out


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("name", inputs())
def test_bad_input_gives_a_valid_packet_or_one_clear_error(
    name: str, profile: str, survey: Survey
) -> None:
    if name in NO_PACKET:
        with pytest.raises(EstimationError, match="0 usable cells"):
            compress(binned(inputs()[name]), QUICK, profile)
        return
    compressed = compress(binned(inputs()[name]), QUICK, profile)
    assert compressed.report.settled or compressed.report.ended in {"line search", "not fitted"}
    frames = through_the_wire(compressed, survey)
    assert len(frames) == 10
    if name == "one straight line" and profile == "paper":
        with pytest.raises(EstimationError, match="line"):
            reconstruct_packets(received(frames), BOUNDS, 0.0)
        return
    grid = reconstruct_packets(received(frames), BOUNDS, 0.0).grid
    known = grid.depth_m[np.isfinite(grid.depth_m)]
    assert grid.depth_m.size <= 200_000
    assert np.all((known > 0.0) & (known < 90.0))
    if name == "one straight line":
        assert known.size < 1000  # no more than the cells along it
    elif name not in NO_MAP and name != "10 km apart":
        assert known.size > 5000


@pytest.mark.parametrize("profile", ["paper", "dense"])
def test_every_failed_factorisation_of_a_fit_is_told(
    profile: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def clumsy(k: Array, nugget: float, **options: bool) -> tuple[Array, float, int]:
        lower, nugget, failed = factorised(k, nugget, **options)
        return lower, nugget, failed + 1

    monkeypatch.setattr("firmware.compression.weights.factorised", clumsy)
    report = compress(binned(area()), QUICK, profile).report
    assert report.failed_factorisations >= report.evaluations > 0


@pytest.mark.parametrize("profile", ["paper", "dense"])
def test_a_fit_that_cannot_begin_says_so(profile: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise EstimationError("covariance of 150 points stays singular")

    monkeypatch.setattr("firmware.compression.weights.factorised", refuse)
    report = compress(binned(area()), QUICK, profile).report
    assert not report.settled
    assert "singular" in report.ended


@pytest.mark.parametrize("place", range(4))
@pytest.mark.parametrize("value", ABSURD)
def test_absurd_hyperparameters_of_paper_give_a_bounded_grid_or_one_error(
    value: float, place: int, survey: Survey, paper: Compressed
) -> None:
    frames = received(through_the_wire(paper, survey))
    for index, packet in list(frames.items()):
        assert isinstance(packet, SubmapPacket)
        hyperparameters = packet.hyperparameters.copy()
        hyperparameters[place] = value
        frames[index] = dataclasses.replace(packet, hyperparameters=hyperparameters)
    bounded_or_refused(frames)


@pytest.mark.parametrize(
    ("place", "value"), [(0, 0.0), (1, 0.0), (2, np.nan), (3, 15_000.0), (3, np.nan)]
)
def test_hyperparameters_that_mean_nothing_are_those_of_another_fragment(
    place: int, value: float, survey: Survey, paper: Compressed
) -> None:
    frames = received(through_the_wire(paper, survey))
    meant = reconstruct_packets(frames, BOUNDS, 0.0).grid
    first = frames[0]
    assert isinstance(first, SubmapPacket)
    hyperparameters = first.hyperparameters.copy()
    hyperparameters[place] = value
    frames[0] = dataclasses.replace(first, hyperparameters=hyperparameters)
    grid = reconstruct_packets(frames, BOUNDS, 0.0).grid
    assert np.array_equal(grid.depth_m, meant.depth_m, equal_nan=True)
    assert np.array_equal(grid.variance_m2, meant.variance_m2, equal_nan=True)


@pytest.mark.parametrize("depth_m", [-101.0, 500_000.0])
def test_a_point_at_a_depth_that_is_none_is_left_out(depth_m: float, survey: Survey) -> None:
    """As in the packets of a sender without parity; one point alone would pull all cells."""
    paper = compress(survey.bins, dataclasses.replace(QUICK, parity=False), "paper")
    frames = received(through_the_wire(paper, survey))
    first = frames[0]
    assert isinstance(first, SubmapPacket)
    points_ned_m = first.points_ned_m.copy()
    points_ned_m[0, 2] = depth_m
    frames[0] = dataclasses.replace(first, points_ned_m=points_ned_m)
    wide = dataclasses.replace(BOUNDS, max_variance_m2=1e4)
    depths_m = reconstruct_packets(frames, wide, 0.0).grid.depth_m
    assert np.nanmin(depths_m) > 30.0
    assert np.nanmax(depths_m) < 50.0


def test_a_lattice_of_no_variance_is_no_map(survey: Survey, lattice: CompressedCode) -> None:
    assert isinstance(lattice.code, LatticeCode)
    bodies = lattice_bodies(lattice.code, track_of(survey), 244, 1, lattice.settings)
    body = bytearray(bodies[0])
    variances = 4 + len(track_of(survey)) + 20
    body[variances : variances + 3] = b"\xff\xff\xff"
    with pytest.raises(EstimationError, match="no map"):
        reconstruct_packets(fragments_of(lattice, [bytes(body)]), BOUNDS, 0.0)


@pytest.mark.parametrize("place", range(4))
@pytest.mark.parametrize("value", ABSURD)
def test_absurd_hyperparameters_of_dense_give_a_bounded_grid_or_one_error(
    value: float, place: int, survey: Survey, dense: CompressedCode
) -> None:
    assert isinstance(dense.code, DenseCode)
    stream = bytearray(dense.code.stream)
    struct.pack_into(">f", stream, 4 * place, value)
    code = dataclasses.replace(dense.code, stream=bytes(stream))
    bounded_or_refused(fragments_of(dense, dense_bodies(code, track_of(survey), 244, 10)))


@pytest.mark.parametrize("count", [0, 1, 601, 65535])
def test_an_absurd_count_of_points_gives_a_bounded_grid_or_one_error(
    count: int, survey: Survey, dense: CompressedCode
) -> None:
    assert isinstance(dense.code, DenseCode)
    stream = bytearray(dense.code.stream)
    struct.pack_into(">H", stream, 28, count)
    code = dataclasses.replace(dense.code, stream=bytes(stream))
    bounded_or_refused(fragments_of(dense, dense_bodies(code, track_of(survey), 244, 10)))


@pytest.mark.parametrize("value", [0, 1, 255])
@pytest.mark.parametrize("place", range(24))
def test_absurd_geometry_of_lattice_gives_a_bounded_grid_or_one_error(
    value: int, place: int, survey: Survey, lattice: CompressedCode
) -> None:
    assert isinstance(lattice.code, LatticeCode)
    bodies = lattice_bodies(lattice.code, track_of(survey), 244, 1, lattice.settings)
    body = bytearray(bodies[0])
    body[4 + len(track_of(survey)) + place] = value
    bounded_or_refused(fragments_of(lattice, [bytes(body)]))


@pytest.fixture(scope="module")
def paper(survey: Survey) -> Compressed:
    return compress(survey.bins, QUICK, "paper")


@pytest.fixture(scope="module")
def dense(survey: Survey) -> CompressedCode:
    found = compress(survey.bins, QUICK, "dense")
    assert isinstance(found, CompressedCode)
    return found


@pytest.fixture(scope="module")
def lattice(survey: Survey) -> CompressedCode:
    found = compress(survey.bins, CompressionSettings(frames=1), "lattice")
    assert isinstance(found, CompressedCode)
    return found


def track_of(survey: Survey) -> bytes:
    return encode_track(survey.track)


def fragments_of(compressed: CompressedCode, bodies: list[bytes]) -> dict[int, Fragment]:
    header = dataclasses.replace(HEADER, profile=compressed.profile, fragment_count=len(bodies))
    return {
        i: SubmapFragment(header=dataclasses.replace(header, fragment=i), body=body)
        for i, body in enumerate(bodies)
    }


def bounded_or_refused(fragments: dict[int, Fragment]) -> None:
    try:
        grid = reconstruct_packets(fragments, BOUNDS, 0.0).grid
    except (EstimationError, LocalProtocolError):
        return
    assert grid.depth_m.size <= 200_000
    assert not np.isinf(grid.depth_m).any()
