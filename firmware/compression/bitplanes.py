"""Cosine coefficients as one progressive code: cut it anywhere, and what is left is the best map.

Magnitudes go plane by plane, most significant first. Within a plane the coefficients likeliest to
become significant go first, then refinements of those that are, then the rest. Likelihood is told
by the neighbours in frequency in the planes before and by the distance from zero frequency, all in
integers, so that both sides agree on every machine.
"""

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

from firmware.geometry import Array
from protocol.arithmetic import CodeEnd, Contexts, Decoder, Encoder

QUANTUM_M = 2.0**-7  # of a coefficient; 0.002 m of depth if all were cut off there
PLANES = 20  # reach 8 km of a single coefficient
_RINGS = 64
_KERNEL = np.array([1, 2, 3, 3, 3, 2, 1])  # of neighbours in frequency, along each axis
_LEVELS = 225 * np.array([1.1, 1.4, 2.0, 3.0, 5.0, 8.0, 14.0, 25.0, 60.0])
_LIKELY = 4  # levels from which on new coefficients go before refinements
_ZONES = 4  # by distance from zero frequency
_REFINE = _ZONES * (len(_LEVELS) + 1)
_MIDDLE = 0.45  # of the uncertainty: where in its interval a magnitude lies on average

Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """After so many bytes of code, so much of the squared coefficients (m^2) is still missing."""

    code_bytes: int
    missing_m2: float


@dataclass(slots=True)
class _State:
    """What both sides know: magnitudes so far in quanta, signs, and the plane each stands at."""

    magnitude: Integers
    negative: Mask
    significant: Mask
    known_plane: Integers

    @classmethod
    def blank(cls, size: int) -> "_State":
        return cls(
            np.zeros(size, dtype=np.int64),
            np.zeros(size, dtype=bool),
            np.zeros(size, dtype=bool),
            np.zeros(size, dtype=np.int64),
        )

    def values_m(self, of: Integers | slice = slice(None)) -> Array:
        middle = self.magnitude[of] + _MIDDLE * np.exp2(self.known_plane[of])
        size_m = np.where(self.significant[of], middle, 0.0) * QUANTUM_M
        return np.where(self.negative[of], -size_m, size_m)


def encode_steps(
    coefficients_m: Array, encoder: Encoder, max_bytes: int
) -> Generator[None, None, list[Progress]]:
    """Code coefficients (rows, columns) until max_bytes; the generator's value is the progress."""
    shape = coefficients_m.shape
    flat_m = coefficients_m.ravel()
    quanta = np.minimum(np.abs(flat_m) / QUANTUM_M, 2.0**PLANES - 1).astype(np.int64)
    state = _State.blank(flat_m.size)
    state.negative = flat_m < 0.0
    counts = Contexts(_REFINE + 2)
    ring = rings(shape)
    first = int(quanta.max()).bit_length() - 1
    encoder.encode_number(max(first, 0), 5)
    progress = [Progress(code_bytes=len(encoder), missing_m2=float(flat_m @ flat_m))]
    missing_m2 = flat_m**2
    cutoff = 0
    for plane in range(max(first, 0), -1, -1):
        above = quanta >> plane > 0
        cutoff = max(cutoff, int(ring[above].max(initial=0)))
        encoder.encode_number(cutoff, 6)
        for index, where, refining in _passes(state, plane, cutoff, ring, shape):
            bits = quanta[index] >> plane & 1
            _encode_pass(encoder, counts, bits, where, state.negative[index], refining)
            state.magnitude[index] += bits << plane
            state.significant[index] |= bits > 0
            state.known_plane[index] = plane
            missing_m2[index] = (flat_m[index] - state.values_m(index)) ** 2
            missing = float(np.sum(missing_m2))
            progress.append(Progress(code_bytes=len(encoder), missing_m2=missing))
            yield
            if len(encoder) > max_bytes:
                return progress
    return progress


def _encode_pass(
    encoder: Encoder,
    counts: Contexts,
    bits: Integers,
    where: Integers,
    negative: Mask,
    refining: bool,
) -> None:
    if refining:
        encoder.encode_adaptive(bits.tolist(), where.tolist(), counts)
        return
    for bit, context, sign in zip(bits.tolist(), where.tolist(), negative.tolist(), strict=True):
        encoder.encode(bit, counts.share(context))
        counts.count(context, bit)
        if bit:
            encoder.encode(int(sign), 32768)


def decode(shape: tuple[int, int], decoder: Decoder) -> Array:
    """Return the coefficients (rows, columns) in m as far as the code reaches."""
    state = _State.blank(shape[0] * shape[1])
    counts = Contexts(_REFINE + 2)
    ring = rings(shape)
    try:
        first = min(decoder.decode_number(5), PLANES - 1)
        for plane in range(first, -1, -1):
            cutoff = decoder.decode_number(6)
            for index, where, refining in _passes(state, plane, cutoff, ring, shape):
                _decode_pass(decoder, counts, state, index, where, plane, refining)
    except CodeEnd:
        pass
    return state.values_m().reshape(shape)


def _decode_pass(
    decoder: Decoder,
    counts: Contexts,
    state: _State,
    index: Integers,
    where: Integers,
    plane: int,
    refining: bool,
) -> None:
    for place, context in zip(index.tolist(), where.tolist(), strict=True):
        bit = decoder.decode(counts.share(context))
        counts.count(context, bit)
        if bit and not refining:
            state.negative[place] = decoder.decode(32768)
            state.significant[place] = True
        if bit:
            state.magnitude[place] += 1 << plane
        state.known_plane[place] = plane


def rings(shape: tuple[int, int]) -> Integers:
    """Return how far each coefficient is from zero frequency, 0 to 63, flattened."""
    along = np.arange(shape[0]) / shape[0]
    across = np.arange(shape[1]) / shape[1]
    radius = np.sqrt(along[:, None] ** 2 + across[None, :] ** 2) / np.sqrt(2.0)
    return np.asarray(np.minimum(radius * _RINGS, _RINGS - 1), dtype=np.int64).ravel()


def _passes(
    state: _State, plane: int, cutoff: int, ring: Integers, shape: tuple[int, int]
) -> list[tuple[Integers, Integers, bool]]:
    """Return the passes of a plane as (indices, contexts, refining), known before the plane."""
    sure = np.minimum(state.magnitude >> plane, 255)
    energy = np.where(state.significant, 4 * sure * sure, 1).reshape(shape)
    for axis in range(2):
        energy = correlate1d(energy, _KERNEL, axis=axis, mode="reflect")
    fresh = np.flatnonzero(~state.significant & (ring <= cutoff))
    level = np.searchsorted(_LEVELS, energy.ravel()[fresh])
    order = np.argsort(-level, kind="stable")
    fresh, level = fresh[order], level[order]
    zone = np.minimum(_ZONES * ring[fresh] // max(cutoff + 1, 1), _ZONES - 1)
    where, likely = level * _ZONES + zone, level >= _LIKELY
    refine = np.flatnonzero(state.significant)
    first = (state.magnitude[refine] >> (plane + 1) == 1).astype(np.int64)
    return [
        (fresh[likely], where[likely], False),
        (refine, _REFINE + first, True),
        (fresh[~likely], where[~likely], False),
    ]
