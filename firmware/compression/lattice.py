"""The `lattice` profile: a sub-map as one progressive stream, protected by what each part is worth.

The stream: geometry and trend (`_GEOMETRY`), then one arithmetic code of the footprint and of the
cosine coefficients. Its beginning is given by any two frames, the rest by more; how many is chosen
for the least expected error under the loss to expect (`protocol.lattice`).
"""

import struct
from collections.abc import Generator
from dataclasses import dataclass

import numpy as np

from firmware.compression import bitplanes
from firmware.compression.bitplanes import Progress
from firmware.compression.calibration import heaviness, widening, without_tail
from firmware.compression.field import Field, Surface, Trend, fitted_field_steps, fitted_trend
from firmware.compression.footprint import (
    Mask,
    block_shape,
    decode_footprint,
    encode_footprint,
    footprint,
)
from firmware.compression.lattice_frame import LatticeFrame, lattice_frame
from firmware.compression.losses import arrival_chances, frames_relied_on
from firmware.compression.settings import CompressionSettings
from firmware.submaps import BinnedSoundings
from protocol.arithmetic import CodeEnd, Decoder, Encoder
from protocol.errors import RemoteProtocolError
from protocol.lattice import PROTECTION_BYTES, Protection, bodies_of, stream_of

_GEOMETRY = struct.Struct(">iiBBBBhbbbbbBBBB")
_SHARE_STEPS = (0.0, 0.03, 0.06, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8)


@dataclass(frozen=True, slots=True, kw_only=True)
class LatticeMap(Surface):
    """A decoded surface with its footprint, and the variance of soundings about it."""

    mask: Mask
    variance_m2: float


@dataclass(frozen=True, slots=True, kw_only=True)
class LatticeCode:
    """A sub-map ready to be cut to frames: the stream's parts and what each length is worth."""

    field: Field
    mask: Mask
    code: bytes
    progress: list[Progress]
    residual_m2: float


def lattice_code_steps(
    bins: BinnedSoundings, step_m: float, max_bytes: int
) -> Generator[None, None, LatticeCode]:
    """Fit and code a sub-map in small steps; the generator's value is the code."""
    frame = lattice_frame(bins, step_m)
    trend = fitted_trend(bins, frame)
    yield
    field = yield from fitted_field_steps(bins, frame, trend)
    mask = footprint(bins, frame)
    encoder = Encoder()
    encode_footprint(mask, encoder)
    yield
    progress = yield from bitplanes.encode_steps(field.coefficients_m, encoder, max_bytes)
    return LatticeCode(
        field=field,
        mask=mask,
        code=encoder.finish(),
        progress=progress,
        residual_m2=_residual_m2(field, bins) + field.unknown_m2,
    )


def lattice_bodies(
    code: LatticeCode, track: bytes, size: int, frames: int, settings: CompressionSettings
) -> list[bytes]:
    """Return the bodies of so many frames of `size` bytes; any two give a map."""
    columns = size - PROTECTION_BYTES - len(track)
    protection = chosen_protection(code.progress, columns, frames, settings)
    lengths = [protection.stream_bytes(columns, k) for k in protection.thresholds]
    variances = [_variance_m2(code, length - _GEOMETRY.size) for length in lengths]
    stream = _geometry(code.field, variances) + code.code
    return bodies_of(track, stream, protection, size, frames)


def lattice_map(bodies: dict[int, bytes], track_bytes: int, frames: int) -> LatticeMap:
    """Return the best map that the bodies that arrived give.

    Raises
    ------
    RemoteProtocolError
        When they give none, being too few, or say what no sender says.
    """
    stream = stream_of(bodies, track_bytes, frames)
    if len(stream) < _GEOMETRY.size:
        raise RemoteProtocolError(f"{len(bodies)} of {frames} fragments give no map")
    frame, trend, variances = _from_geometry(stream)
    decoder = Decoder(stream[_GEOMETRY.size :])
    try:
        mask = decode_footprint(block_shape(frame), decoder)
    except CodeEnd as end:
        raise RemoteProtocolError("the stream ends within its footprint") from end
    protection = Protection.from_bytes(next(iter(bodies.values())))
    variance_m2 = variances[sum(k <= len(bodies) for k in protection.thresholds) - 1]
    if not np.isfinite(variance_m2):
        raise RemoteProtocolError(f"{len(bodies)} of {frames} fragments give no map")
    return LatticeMap(
        frame=frame,
        trend=trend,
        mask=mask,
        coefficients_m=bitplanes.decode(frame.shape, decoder),
        variance_m2=variance_m2,
    )


def chosen_protection(
    progress: list[Progress], columns: int, frames: int, settings: CompressionSettings
) -> Protection:
    """Return the protection of least expected error among those that a grid of shares offers.

    The first part holds geometry, footprint and, as far as a quarter of the columns allows,
    usable_bytes of coefficients. Where usable_frames give geometry and footprint only by most of
    their columns, as small frames do, more frames must come together for a map.
    """
    loss = settings.expected_loss
    arrived = np.arange(frames + 1)
    at = np.array([_GEOMETRY.size + step.code_bytes for step in progress], dtype=np.float64)
    missing = np.array([step.missing_m2 for step in progress])
    k0 = min(settings.usable_frames, frames)
    relied_on = frames_relied_on(frames, loss)
    while (needed := -(-int(at[0]) // k0)) > columns // 2 and k0 < frames:
        if needed <= columns and k0 >= relied_on:
            break
        k0 += 1
    wished = -(-(int(at[0]) + settings.usable_bytes) // k0)
    needed = min(max(needed, min(wished, columns // 4)), columns)
    choices = np.array(
        [
            (n0, k1, n1, k2)
            for n0 in _column_choices(columns, needed)
            for n1 in _column_choices(columns - n0, 0)
            for k1 in range(k0, frames + 1)
            for k2 in range(k1, frames + 1)
        ]
    )
    n0, k1, n1, k2 = choices.T[:, :, None]
    got = np.where(arrived >= k0, k0 * n0, 0) + np.where(arrived >= k1, k1 * n1, 0)
    got += np.where(arrived >= k2, k2 * (columns - n0 - n1), 0)
    error = np.interp(got, at, missing, left=4.0 * missing[0])
    best = choices[int(np.argmin(error @ arrival_chances(frames, loss)))]
    return Protection(
        thresholds=(k0, int(best[1]), int(best[3])), columns=(int(best[0]), int(best[2]))
    )


def missing_m2(
    progress: list[Progress], protection: Protection, columns: int, frames: int, loss: float
) -> float:
    """Return the squared coefficients, m^2, to be expected missing; with no map, all of them."""
    at = [_GEOMETRY.size + step.code_bytes for step in progress]
    missing = [step.missing_m2 for step in progress]
    got = [protection.stream_bytes(columns, arrived) for arrived in range(frames + 1)]
    expected = np.interp(got, at, missing, left=missing[0])
    return float(np.dot(expected, arrival_chances(frames, loss)))


def _column_choices(columns: int, fewest: int) -> list[int]:
    return sorted({min(fewest + round(share * (columns - fewest)), 255) for share in _SHARE_STEPS})


def _variance_m2(code: LatticeCode, code_bytes: int) -> float:
    """Return the variance of soundings about the map that so many bytes of code give.

    What the cut code misses is orthogonal to the residuals of the whole, so the two add up.
    """
    at = [step.code_bytes for step in code.progress]
    missing = [step.missing_m2 for step in code.progress]
    if code_bytes < at[0]:
        return float("inf")
    nodes = code.field.frame.rows * code.field.frame.columns
    return code.residual_m2 + float(np.interp(code_bytes, at, missing)) / nodes


def _residual_m2(field: Field, bins: BinnedSoundings) -> float:
    """Return the variance of soundings about the whole field, widened to hold 95 %."""
    position_m = np.column_stack([bins.north_m, bins.east_m])
    spread = bins.variance_m2 * np.maximum(bins.count - 1.0, 0.0)
    every_squared = spread + (bins.depth_m - field.depth_m(position_m)) ** 2
    squared = without_tail(every_squared)
    mean = max(float(np.average(squared, weights=bins.count)), 1e-6)
    return mean * max(widening(squared / mean, bins.count), heaviness(every_squared / mean))


def _geometry(field: Field, variances_m2: list[float]) -> bytes:
    frame, terms = field.frame, field.trend.terms
    mean, low = terms[0] >> 4, terms[0] & 15
    return _GEOMETRY.pack(
        frame.corner_north_q,
        frame.corner_east_q,
        frame.angle_code,
        min(frame.step_q, 255),
        frame.rows,
        frame.columns,
        mean,
        *terms[1:],
        min(field.trend.scale, 15) << 4 | low,
        *(_variance_code(value) for value in variances_m2),
    )


def _from_geometry(stream: bytes) -> tuple[LatticeFrame, Trend, list[float]]:
    north, east, angle, step, rows, columns, mean, *rest = _GEOMETRY.unpack_from(stream)
    *slopes, packed, first, second, third = rest
    if not rows or not columns or not step:
        raise RemoteProtocolError(f"a lattice of {rows} x {columns} nodes every {step} / 4 m")
    frame = LatticeFrame(
        corner_north_q=north,
        corner_east_q=east,
        angle_code=angle,
        step_q=step,
        rows=rows,
        columns=columns,
    )
    trend = Trend(terms=(mean << 4 | (packed & 15), *slopes), scale=packed >> 4)
    return frame, trend, [_variance_of(code) for code in (first, second, third)]


def _variance_code(variance_m2: float) -> int:
    """Return the code of a variance, 12 to an octave from 1e-4 m2: within 6 %; 255 is none."""
    if not np.isfinite(variance_m2):
        return 255
    return int(np.clip(np.ceil(12.0 * np.log2(max(variance_m2, 1e-4) / 1e-4)), 0, 254))


def _variance_of(code: int) -> float:
    return float("inf") if code == 255 else float(1e-4 * 2.0 ** (code / 12.0))
