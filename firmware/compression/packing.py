"""Compressed sub-maps to packets: slices of the trajectory, points by fragment."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from firmware.compression.results import CompressedPoints, fragment_points
from firmware.submaps import Track
from protocol.packets import STATES_PER_FRAGMENT, Header, SubmapPacket
from protocol.timestamps import QUARTERS_MODULO


def packets_from(compressed: CompressedPoints, track: Track, header: Header) -> list[SubmapPacket]:
    """Return the packets of a sub-map, in the order of their fragments.

    header gives vehicle, boot epoch, sub-map and, in time_quarters, the time of the track's first
    state; profile, fragment, fragment_count and the slice's time are filled in here. A state goes
    to the place of its whole second since the first; places without a state are NaN.
    """
    points = fragment_points(compressed)
    states = _by_second(track, STATES_PER_FRAGMENT * len(points))
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


def _by_second(track: Track, seconds: int) -> NDArray[np.float32]:
    """Return north, east, yaw (seconds, 3) at each whole second after the first state, or NaN."""
    states = np.full((seconds, 3), np.nan, dtype=np.float32)
    if track.time_s.size:
        second = np.round(track.time_s - track.time_s[0]).astype(int)
        kept = (second >= 0) & (second < seconds)
        rows = np.column_stack([track.north_m, track.east_m, track.yaw_rad])
        states[second[kept]] = rows[kept]
    return states
