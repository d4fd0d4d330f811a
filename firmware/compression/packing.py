"""Compressed sub-maps to packets: slices of the trajectory, points by fragment."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from firmware.compression.dense import DenseCode, DenseDraft, dense_bodies
from firmware.compression.lattice import lattice_bodies
from firmware.compression.results import (
    PAPER_FRAGMENTS,
    CompressedCode,
    CompressedPoints,
    fragment_points,
)
from firmware.compression.settings import CompressionSettings
from firmware.compression.steps import run
from firmware.compression.track_code import encode_track
from firmware.geometry import wrap_angle
from firmware.submaps import Track
from protocol.errors import EstimationError, LocalProtocolError
from protocol.packets import (
    BODY_BYTES,
    STATES_PER_FRAGMENT,
    Header,
    Profile,
    SubmapFragment,
    SubmapPacket,
)
from protocol.timestamps import QUARTERS_MODULO

_ON_TIME_S = 1e-6


def submap_header(
    *, vehicle: int = 1, boot_epoch: int = 0, submap: int = 0, time_quarters: int = 0
) -> Header:
    """Return a header for `packets_from`; by default that of a sub-map that stands alone."""
    return Header(
        profile=Profile.SUBMAP_PAPER,
        vehicle=vehicle,
        boot_epoch=boot_epoch,
        submap=submap,
        fragment=0,
        fragment_count=PAPER_FRAGMENTS,
        tx_second=0,
        time_quarters=time_quarters,
    )


def packets_from(
    compressed: CompressedPoints | CompressedCode, track: Track, header: Header
) -> list[SubmapPacket] | list[SubmapFragment]:
    """Return the packets of a sub-map, in the order of their fragments.

    header gives vehicle, boot epoch, sub-map and, in time_quarters, the time of the track's first
    state; profile, fragment, fragment_count and the slice's time are filled in here. A state goes
    to the place of its whole second since the first; places without a state are NaN.
    """
    if isinstance(compressed, CompressedCode):
        return _fragments(compressed, _bodies(compressed, track), header)
    points = fragment_points(compressed)
    states = states_by_second(track, STATES_PER_FRAGMENT * len(points))
    packets = []
    for index, fragment in enumerate(points):
        first_s = index * STATES_PER_FRAGMENT
        packets.append(
            SubmapPacket(
                header=dataclasses.replace(
                    header,
                    profile=compressed.profile,
                    fragment=index,
                    fragment_count=len(points),
                    time_quarters=(header.time_quarters + 4 * first_s) % QUARTERS_MODULO,
                ),
                trajectory=states[first_s : first_s + STATES_PER_FRAGMENT],
                points_ned_m=fragment.copy(),
                hyperparameters=compressed.hyperparameters.copy(),
            )
        )
    return packets


def filled_bytes(profile: Profile, settings: CompressionSettings) -> int:
    """Return how much of a body a code may fill; where frames are sealed, the rest stays zero."""
    return BODY_BYTES[profile.sealed if settings.sealed else profile]


def _bodies(compressed: CompressedCode, track: Track) -> list[bytes]:
    settings, frames = compressed.settings, compressed.fragment_count
    size = filled_bytes(compressed.profile, settings)
    told, code = encode_track(track, size // 2), compressed.code
    if isinstance(code, DenseDraft):
        code = _coded(code)
    if isinstance(code, DenseCode):
        return dense_bodies(code, told, size, frames)
    return lattice_bodies(code, told, size, frames, settings)


def _coded(draft: DenseDraft) -> DenseCode:
    try:
        return run(draft.code_steps())
    except EstimationError as error:
        raise LocalProtocolError(f"a fit cut short cannot be coded: {error}") from error


def _fragments(
    compressed: CompressedPoints | CompressedCode, bodies: list[bytes], header: Header
) -> list[SubmapFragment]:
    """Return opaque fragments; the header's time stays that of the whole track's first state."""
    return [
        SubmapFragment(
            header=dataclasses.replace(
                header,
                profile=compressed.profile,
                fragment=index,
                fragment_count=len(bodies),
            ),
            body=body.ljust(BODY_BYTES[compressed.profile], b"\x00"),
        )
        for index, body in enumerate(bodies)
    ]


def states_by_second(track: Track, seconds: int) -> NDArray[np.float32]:
    """Return north, east, yaw (seconds, 3) at each whole second after the first state.

    It is NaN beyond the last state, and where none is within a second.
    """
    states = np.full((seconds, 3), np.nan, dtype=np.float32)
    if track.time_s.size:
        times_s = track.time_s[0] + np.arange(seconds)
        times_s = times_s[times_s <= track.time_s[-1] + _ON_TIME_S]
        known = np.array([track.gap_s(time_s) < 1.0 for time_s in times_s])
        yaw_rad = wrap_angle(np.interp(times_s, track.time_s, np.unwrap(track.yaw_rad)))
        rows = np.column_stack([track.position_at(times_s), yaw_rad])
        states[: len(times_s)][known] = rows[known]
    return states
