"""The `dense` profile: three times the paper's points in fewer bytes, whole from half the frames.

The stream (`protocol.lattice` cuts it to frames): `_HEAD`, then one arithmetic code of the points'
places and depths (`firmware.compression.point_code`). As few frames give it as its length allows,
and never more than nearly always arrive.
"""

import struct
from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware.compression.binning import coarsened
from firmware.compression.calibration import calibrated
from firmware.compression.decoder import NUGGET, factorised
from firmware.compression.fit import (
    Dealing,
    FitFrame,
    FittedPoints,
    fit_frame,
    fit_steps,
    moved_steps,
    spacing_of,
)
from firmware.compression.kernels import Hyperparameters, correlation, squared_distance
from firmware.compression.losses import frames_relied_on, loss_patterns
from firmware.compression.point_code import (
    coarse_to_fine,
    decode_depths,
    decode_places,
    encode_depths,
    encode_place_steps,
)
from firmware.compression.settings import CompressionSettings
from firmware.compression.smoothing import smoothed_steps
from firmware.compression.steps import Steps
from firmware.geometry import Array
from firmware.submaps import BinnedSoundings
from protocol.arithmetic import CodeEnd, Decoder, Encoder
from protocol.errors import EstimationError, LocalProtocolError, RemoteProtocolError
from protocol.lattice import PROTECTION_BYTES, Protection, bodies_of, stream_of

_HEAD = struct.Struct(">4fiiHHHBB")  # hyperparameters, corner, sides, count, exponents of the steps
_TRACK_BYTES = 46  # the longest; a straight track takes 15
_BITS = 17  # a point at most takes, with few exceptions: 10 for its place, 7 for its depth
_MOST_POINTS = 600
_MOST_PLACES = 65000.0  # along a side: two bytes
_PLACING_CELL = 1.25  # times the cells that give depths, of those that place: half a spacing
_REACH_SHARE = 0.75  # of the kernel's: forty evaluations do not find what more would tell
_PLACES_A_SPACING = 8.0  # steps: coarser costs error, finer bits
_DEPTHS_AN_ERROR = 4.0  # steps of depth in the map's expected error
_PLACE_EXPONENT, _DEPTH_EXPONENT = 8, 16  # steps are 2^(code - exponent) m


@dataclass(frozen=True, slots=True, kw_only=True)
class DenseCode:
    """The stream, and its points (M, 3) and hyperparameters as any receiver computes them."""

    stream: bytes
    points_ned_m: Array
    hyperparameters: NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class DenseDraft:
    """Points on their way to a better fit, not coded yet: coding costs as much as four evaluations.

    It is done in small steps for the last of them, and at once for those of a fit cut short.
    """

    fitted: FittedPoints
    frame: FitFrame
    bins: BinnedSoundings
    room: int

    def code_steps(self) -> Generator[None, None, DenseCode]:
        """Code the points in small steps; the generator's value is the code."""
        return _coded_steps(self.fitted, self.frame, self.bins, self.room)


def dense_code_steps(
    bins: BinnedSoundings, settings: CompressionSettings, size: int
) -> Generator[tuple[DenseCode | DenseDraft, FittedPoints] | None, None, str]:
    """Yield ever better drafts, at last a code, and None between small steps.

    size is that of a frame's body; the value says why it ended.
    """
    relied_on = frames_relied_on(settings.frames, settings.expected_loss)
    room = relied_on * (size - PROTECTION_BYTES - _TRACK_BYTES)
    targets = yield from smoothed_steps(bins, settings.lattice_step_m)
    cells = coarsened(targets, settings.fit_cell_m)
    fitting = 8 * (room - _HEAD.size) // _BITS
    count = max(3, min(settings.dense_points, fitting, cells.depth_m.size))
    frame = fit_frame(cells, settings.max_fit_rows)
    coarse = coarsened(targets, _PLACING_CELL * settings.fit_cell_m)
    placing = fit_frame(coarse, settings.max_fit_rows, frame)

    def deal(position_m: Array) -> Dealing:
        fragment = np.zeros(len(position_m), dtype=np.intp)
        return Dealing(fragment=fragment, patterns=loss_patterns(0.0, settings.frames))

    steps = Steps(
        fit_steps(placing, count, settings, deal, settings.dense_iterations, _REACH_SHARE)
    )
    draft: DenseDraft | None = None
    for step in steps:
        if step is None:
            yield None
            continue
        draft = DenseDraft(fitted=step, frame=frame, bins=bins, room=room)
        yield draft, step
    if draft is not None:
        code = yield from draft.code_steps()
        yield code, draft.fitted
    return steps.value


def _coded_steps(
    fitted: FittedPoints, frame: FitFrame, bins: BinnedSoundings, room: int
) -> Generator[None, None, DenseCode]:
    """Round places, fit the depths anew to where they lie now, and code both within the room."""
    wished_m = spacing_of(fitted.position_m) / _PLACES_A_SPACING
    least_m = 2.0 * float(np.ptp(fitted.position_m, axis=0).max()) / _MOST_PLACES
    place_code = _exponent(max(wished_m, least_m), _PLACE_EXPONENT)
    step_m = 2.0 ** (place_code - _PLACE_EXPONENT)
    corner = np.floor((fitted.position_m + frame.origin_m).min(axis=0) / step_m).astype(np.int64)
    places = np.round((fitted.position_m + frame.origin_m) / step_m).astype(np.int64) - corner
    shape = (int(places[:, 0].max()) + 1, int(places[:, 1].max()) + 1)
    encoder = Encoder()
    order = yield from encode_place_steps(places, shape, encoder)
    order = order[coarse_to_fine(len(order))]
    position_m = (places + corner) * step_m
    fitted = yield from moved_steps(fitted, position_m - frame.origin_m, frame, _REACH_SHARE)
    position_m, depth_m = position_m[order], fitted.depth_m[order]
    hyper = Hyperparameters(
        b_per_m=fitted.b_per_m,
        c_m2=1.0,
        sigma2_m2=0.0,
        mean_depth_m=frame.mean_depth_m,
        kernel=fitted.kernel,
    )
    hyper = Hyperparameters.from_wire(hyper.to_wire().astype(np.float64), 0.0)
    lower = _factor(position_m, hyper)
    yield
    error_m = float(np.sqrt(max(fitted.error_m2, 1e-8)))
    depth_code = _exponent(error_m / _DEPTHS_AN_ERROR, _DEPTH_EXPONENT)
    while True:
        trial = encoder.copied()
        sent_m = encode_depths(depth_m, lower, 2.0 ** (depth_code - _DEPTH_EXPONENT), trial)
        code = trial.finish()
        if _HEAD.size + len(code) <= room or depth_code == 2 * _DEPTH_EXPONENT:
            break
        depth_code += 1
        yield
    del lower
    points = np.column_stack([position_m, sent_m + hyper.mean_depth_m])
    hyper, _ = calibrated(points, hyper, bins)
    wire = hyper.to_wire()
    head = _HEAD.pack(*wire, *corner.tolist(), *shape, len(points), place_code, depth_code)
    return DenseCode(stream=head + code, points_ned_m=points, hyperparameters=wire)


def dense_bodies(code: DenseCode, track: bytes, size: int, frames: int) -> list[bytes]:
    """Return the bodies of so many frames; as few of them as can give the points."""
    columns = size - PROTECTION_BYTES - len(track)
    enough = -(-len(code.stream) // columns)
    if enough > frames:
        raise LocalProtocolError(f"{len(code.stream)} bytes of points in {frames} frames")
    protection = Protection(thresholds=(enough, enough, enough), columns=(0, 0))
    return bodies_of(track, code.stream, protection, size, frames)


def dense_points(
    bodies: dict[int, bytes], track_bytes: int, frames: int
) -> tuple[Array, NDArray[np.float32]]:
    """Return points (M, 3) and hyperparameters (4,) that the bodies that arrived give.

    Raises
    ------
    RemoteProtocolError
        When they give none, or say what no sender says.
    """
    stream = stream_of(bodies, track_bytes, frames)
    if len(stream) < _HEAD.size:
        raise RemoteProtocolError(f"{len(bodies)} of {frames} fragments give no points")
    *values, north, east, rows, columns, count, place_code, depth_code = _HEAD.unpack_from(stream)
    if not rows or not columns or not 1 <= count <= _MOST_POINTS:
        raise RemoteProtocolError(f"{count} points in {rows} x {columns} places")
    if place_code > 2 * _PLACE_EXPONENT or depth_code > 2 * _DEPTH_EXPONENT:
        raise RemoteProtocolError(f"steps of code {place_code} and {depth_code}")
    wire = np.array(values, dtype=np.float32)
    hyper = Hyperparameters.from_wire(wire.astype(np.float64), 0.0)
    decoder = Decoder(stream[_HEAD.size :])
    try:
        places = decode_places(count, (rows, columns), decoder)[coarse_to_fine(count)]
        position_m = (places + np.array([north, east])) * 2.0 ** (place_code - _PLACE_EXPONENT)
        lower = _factor(position_m, hyper)
        depth_m = decode_depths(lower, 2.0 ** (depth_code - _DEPTH_EXPONENT), decoder)
    except CodeEnd as end:
        raise RemoteProtocolError("the stream ends within its points") from end
    except EstimationError as error:
        raise RemoteProtocolError(str(error)) from error
    return np.column_stack([position_m, depth_m + hyper.mean_depth_m]), wire


def _factor(position_m: Array, hyper: Hyperparameters) -> Array:
    """Return the Cholesky factor of the points' correlation, which predicts their depths."""
    about_m = position_m - position_m.mean(axis=0)
    k = correlation(hyper.kernel, squared_distance(about_m, about_m, hyper.b_per_m))
    return factorised(k, NUGGET, use_up=True)[0]


def _exponent(step_m: float, offset: int) -> int:
    """Return the code of the power of two that is at most a step in m."""
    return int(np.clip(np.floor(np.log2(step_m)) + offset, 0, 2 * offset))
