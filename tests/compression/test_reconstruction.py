"""Whatever the packets say, the leader is bounded: a grid, or one EstimationError."""

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware.compression import bitplanes, compress, compress_steps, packets_from
from firmware.compression.mantissa import (
    completed,
    fitting_steps,
    flagged,
    steps_of,
    with_parity,
)
from firmware.compression.packing import submap_header
from firmware.compression.settings import CompressionSettings
from firmware.compression.steps import run
from firmware.compression.track_code import decode_track, encode_track
from firmware.geometry import Array, wrap_angle
from firmware.leader.reconstruction import (
    ReconstructionSettings,
    reconstruct_packets,
    reconstruct_points,
    times_of_cells,
)
from firmware.submaps import Track
from protocol.arithmetic import Decoder, Encoder
from protocol.errors import EstimationError
from protocol.packets import Header, Profile, SubmapFragment
from tests.compression.conftest import Survey, made_survey, relief_m

PLACES_M = np.random.default_rng(3).uniform([-40.0, -70.0], [40.0, 70.0], (150, 2))
POINTS = np.column_stack([PLACES_M, relief_m(*PLACES_M.T)])
TRACK = Track(
    time_s=np.arange(40.0),
    north_m=np.arange(40.0),
    east_m=np.zeros(40),
    yaw_rad=np.zeros(40),
)
ABSURD = [0.0, -0.0, 1e-30, 1e30, -1e30, float("nan"), float("inf"), -float("inf"), 1.0]


@settings(max_examples=25, deadline=None)
@given(st.lists(st.sampled_from(ABSURD), min_size=4, max_size=4))
def test_absurd_hyperparameters_give_a_bounded_grid_or_one_error(values: list[float]) -> None:
    hyper = np.array(values)
    try:
        grid = reconstruct_points(POINTS, hyper, TRACK, ReconstructionSettings())
    except EstimationError:
        return
    assert grid.depth_m.size < 10_000


@pytest.mark.parametrize("far_m", [1e4, 1e6, 1e20, np.nan])
def test_points_far_away_do_not_make_the_grid_grow(far_m: float) -> None:
    points = POINTS.copy()
    points[0, 0] = far_m
    bounds = ReconstructionSettings(cell_m=0.1, max_cells=20_000)
    grid = reconstruct_points(points, np.array([-0.1, 0.01, 0.01, 40.0]), TRACK, bounds)
    assert grid.depth_m.size <= 20_000


def test_points_in_a_strip_make_no_long_grid() -> None:
    strip = np.array([[1e4 * k, 0.5 * (k % 2), 40.0] for k in range(75)])
    bounds = ReconstructionSettings(cell_m=1.0)
    grid = reconstruct_points(strip, np.array([-0.1, 0.01, 0.01, 40.0]), TRACK, bounds)
    assert max(grid.depth_m.shape) <= 1000


def test_points_on_a_line_are_told() -> None:
    points = np.column_stack([np.arange(20.0), np.arange(20.0), np.full(20, 40.0)])
    with pytest.raises(EstimationError, match="line"):
        reconstruct_points(points, np.array([0.1, 1.0, 0.1, 40.0]), TRACK, ReconstructionSettings())


@pytest.mark.parametrize("lost", [{0}, {3, 4}, {1, 5, 9}, {0, 2, 4, 6}])
def test_parity_in_the_mantissas_gives_lost_points_back(lost: set[int]) -> None:
    steps = fitting_steps(POINTS, 40.0)
    assert steps is not None
    mean_m = flagged(40.0, steps)
    wired = with_parity(POINTS, steps).reshape(10, 15, 3)
    whole, none = completed(dict(enumerate(wired)), mean_m)
    arrived = {i: wired[i] for i in range(10) if i not in lost}
    points, recovered = completed(arrived, mean_m)
    assert none == 0
    assert recovered == 15 * len(lost)
    assert {tuple(p) for p in points} == {tuple(p) for p in whole}
    assert np.abs(whole - POINTS).max() <= 0.5 * steps.sizes_m.max() + 1e-9
    assert np.abs(wired.reshape(-1, 3) - whole).max() <= 0.5 * steps.sizes_m.max()


def test_five_lost_packets_leave_the_points_that_came() -> None:
    steps = fitting_steps(POINTS, 40.0)
    assert steps is not None
    wired = with_parity(POINTS, steps).reshape(10, 15, 3)
    points, recovered = completed({i: wired[i] for i in range(5)}, flagged(40.0, steps))
    assert (len(points), recovered) == (75, 0)


@pytest.mark.parametrize("bits", [0x7FC00001, 0x7F800001, 0x7F000001, 0x7F000003])
def test_parity_about_no_mean_depth_leaves_the_points_that_came(bits: int) -> None:
    """The bits that tell of parity stand in any number, NaN and 1e38 m among them."""
    mean_m = np.uint32(bits).view(np.float32)
    steps = steps_of(mean_m)
    assert steps is not None
    wired = with_parity(POINTS, steps).reshape(10, 15, 3)
    points, recovered = completed({i: wired[i] for i in range(7)}, mean_m)
    assert (len(points), recovered) == (105, 0)


@pytest.mark.parametrize("arrived", [6, 8, 10])
def test_points_of_another_sender_with_the_flag_by_chance_are_left_alone(arrived: int) -> None:
    sent = POINTS.astype(np.float32).reshape(10, 15, 3)[:arrived]
    points, recovered = completed(dict(enumerate(sent)), flagged(40.0, fitting_steps(POINTS, 40.0)))
    assert np.array_equal(points, sent.reshape(-1, 3))
    assert recovered == 0


def turning_track() -> Track:
    second = np.arange(40.0)
    yaw_rad = np.clip((second - 10.0) * 0.16, 0.0, np.pi)
    north_m = 3000.0 + np.cumsum(2.0 * np.cos(yaw_rad))
    east_m = -700.0 + np.cumsum(2.0 * np.sin(yaw_rad))
    return Track(time_s=second, north_m=north_m, east_m=east_m, yaw_rad=yaw_rad)


def test_a_turning_track_fits_forty_bytes_within_a_metre() -> None:
    data = encode_track(turning_track())
    track, taken = decode_track(data + b"more", 0.0)
    assert taken == len(data) <= 46
    assert np.abs(track.north_m - turning_track().north_m).max() < 1.0
    assert np.abs(track.east_m - turning_track().east_m).max() < 1.0


@pytest.mark.parametrize("turn_deg", [-400.0, 200.0, 270.0, 700.0])
def test_yaw_of_a_vehicle_that_circles_is_told(turn_deg: float) -> None:
    yaw_rad = np.radians(turn_deg) * np.linspace(0.0, 1.0, 40)
    circling = dataclasses.replace(turning_track(), yaw_rad=yaw_rad)
    track, _ = decode_track(encode_track(circling), 0.0)
    assert np.abs(wrap_angle(track.yaw_rad - yaw_rad)).max() < np.radians(6.0)


@pytest.mark.parametrize("sealed", [False, True])
def test_small_frames_hold_a_map_in_a_turn(survey: Survey, *, sealed: bool) -> None:
    settings = CompressionSettings(small_frames=True, sealed=sealed)
    code = compress(survey.bins, settings, "lattice")
    packets = packets_from(code, turning_track(), submap_header())
    found = reconstruct_packets(
        dict(enumerate(packets)), ReconstructionSettings(sealed=sealed), 0.0
    )
    assert np.isfinite(found.grid.depth_m).sum() > 500


@pytest.fixture(scope="module")
def fragments(survey: Survey) -> list[SubmapFragment]:
    compressed = compress(survey.bins, CompressionSettings(), "lattice")
    packets = packets_from(compressed, survey.track, submap_header())
    return [packet for packet in packets if isinstance(packet, SubmapFragment)]


@pytest.mark.parametrize("profile", ["paper", "dense", "lattice"])
def test_a_map_of_noisy_soundings_is_kept_as_one_of_good_ones_is(profile: str) -> None:
    """From 100 m above the seabed a beam's noise alone has a variance above 0.1."""
    areas_m2 = []
    for noise_m in (0.15, 0.5):
        survey = made_survey(noise_m=noise_m)
        packets = packets_from(compress(survey.bins, None, profile), survey.track, submap_header())
        found = reconstruct_packets(dict(enumerate(packets)), ReconstructionSettings(), 0.0).grid
        areas_m2.append(np.count_nonzero(np.isfinite(found.depth_m)) * found.cell_m**2)
    assert areas_m2[1] > 0.8 * areas_m2[0] > 0.0


def error_m(fragments: list[SubmapFragment], kept: list[int]) -> float:
    arrived = {i: fragments[i] for i in kept}
    grid = reconstruct_packets(arrived, ReconstructionSettings(max_variance_m2=9.0), 0.0).grid
    axes = [
        first + grid.cell_m * np.arange(length)
        for first, length in zip((grid.north0_m, grid.east0_m), grid.depth_m.shape, strict=True)
    ]
    true_m: Array = relief_m(*np.meshgrid(*axes, indexing="ij"))
    return float(np.sqrt(np.nanmean((grid.depth_m - true_m) ** 2)))


def test_a_dense_fit_cut_short_sends_what_it_has(survey: Survey) -> None:
    settings = CompressionSettings(dense_points=150, dense_iterations=6)
    errors_m = []
    evaluations = 0
    for best in compress_steps(survey.bins, settings, "dense"):
        if best.report.evaluations in {0, evaluations}:
            continue
        evaluations = best.report.evaluations
        packets = packets_from(best, survey.track, submap_header())
        cut_short = [packet for packet in packets if isinstance(packet, SubmapFragment)]
        errors_m.append(error_m(cut_short, list(range(10))))
    assert len(errors_m) >= 4
    assert errors_m[-1] < errors_m[0] < 0.3  # m, of a relief of 1.3 m


def test_two_lattice_frames_of_ten_give_a_usable_map(fragments: list[SubmapFragment]) -> None:
    assert error_m(fragments, [2, 7]) < 0.3  # m, of a relief of 1.3 m
    assert error_m(fragments, list(range(10))) < 0.05


def test_every_further_byte_brings_the_coefficients_nearer_by_what_the_coder_tells() -> None:
    rng = np.random.default_rng(6)
    fall = 1.0 + np.add.outer(np.arange(40.0) ** 2, np.arange(30.0) ** 2)
    coefficients_m = rng.normal(size=(40, 30)) * 20.0 / fall**0.7
    encoder = Encoder()
    progress = run(bitplanes.encode_steps(coefficients_m, encoder, 600))
    code = encoder.finish()
    cuts = [*range(0, 600, 50), len(code)]
    misses = [
        float(np.sum((bitplanes.decode((40, 30), Decoder(code[:cut])) - coefficients_m) ** 2))
        for cut in cuts
    ]
    assert all(later <= earlier for earlier, later in itertools.pairwise(misses))
    assert misses[-1] < 1e-3 * misses[0]
    told = np.array([(step.code_bytes, step.missing_m2) for step in progress])
    assert misses == pytest.approx(np.interp(cuts, *told.T), rel=0.1)


def test_any_two_lattice_frames_are_as_good_as_any_other_two(
    fragments: list[SubmapFragment],
) -> None:
    assert error_m(fragments, [0, 1]) == pytest.approx(error_m(fragments, [4, 9]))


def test_one_lattice_frame_gives_no_map(fragments: list[SubmapFragment]) -> None:
    with pytest.raises(EstimationError):
        reconstruct_packets({3: fragments[3]}, ReconstructionSettings(), 0.0)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.sampled_from(["dense", "lattice"]))
def test_damaged_bodies_give_a_grid_or_one_error(seed: int, changes: int, profile: str) -> None:
    rng = np.random.default_rng(seed)
    body = bytearray(rng.integers(0, 256, 244, dtype=np.uint8).tobytes())
    body[:4] = bytes([2 << 4 | 2, 2, 255, 0])
    body[4:6] = bytes([39, 0x11])
    kind = Profile.SUBMAP_DENSE if profile == "dense" else Profile.SUBMAP_LATTICE
    header = Header(
        profile=kind,
        vehicle=1,
        boot_epoch=0,
        submap=0,
        fragment=0,
        fragment_count=changes % 15 + 1,
        tx_second=0,
        time_quarters=0,
    )
    arrived = {i: SubmapFragment(header=header, body=bytes(body)) for i in range(2)}
    try:
        found = reconstruct_packets(arrived, ReconstructionSettings(max_cells=50_000), 0.0)
    except EstimationError:
        return
    assert found.grid.depth_m.size <= 50_000


def test_cells_are_timed_by_where_the_sonar_looked_though_the_track_drifts_aside() -> None:
    times_s = np.arange(40.0)
    lost = (times_s > 14.0) & (times_s < 19.0)  # a slice
    track = Track(
        time_s=times_s[~lost],
        north_m=2.0 * times_s[~lost],
        east_m=0.1 * times_s[~lost],
        yaw_rad=np.zeros(np.count_nonzero(~lost)),
    )
    north_m, east_m = np.arange(10.0, 70.0, 2.0), np.arange(-60.0, 62.0, 2.0)
    wanted = np.ones((north_m.size, east_m.size), dtype=bool)
    found_s = times_of_cells(track, north_m, east_m, wanted)
    assert np.abs(found_s - north_m[:, None] / 2.0).max() <= 0.5
