"""Hypothesis strategies and examples of every packet."""

from typing import cast

import numpy as np
from hypothesis import strategies as st

from protocol.packets import (
    BODY_BYTES,
    OPAQUE,
    Answer,
    Array32,
    ExtendedAnswer,
    Header,
    Packet,
    Profile,
    SealedFrame,
    SubmapFragment,
    SubmapPacket,
    TrajectoryPacket,
)

PLAIN = [profile for profile in Profile if not profile.is_sealed]
finite32 = st.floats(width=32, allow_nan=False, allow_infinity=False)
variance32 = st.floats(width=32, min_value=0.0, allow_nan=False)
u16 = st.integers(0, 65535)


@st.composite
def arrays(draw: st.DrawFn, rows: int) -> Array32:
    raw = draw(st.binary(min_size=12 * rows, max_size=12 * rows))
    return np.frombuffer(raw, np.float32).reshape(rows, 3)


@st.composite
def headers(draw: st.DrawFn, profile: Profile) -> Header:
    is_answer = profile.plain in {Profile.ANSWER, Profile.ANSWER_EXTENDED}
    count = draw(st.integers(0 if is_answer else 1, 15))
    return Header(
        profile=profile,
        vehicle=draw(st.integers(0, 15)),
        boot_epoch=draw(st.integers(0, 15)),
        submap=draw(u16),
        fragment=draw(st.integers(0, 15 if is_answer else count - 1)),
        fragment_count=count,
        tx_second=draw(st.integers(0, 15)),
        time_quarters=draw(st.integers(0, 2**20 - 1)),
    )


@st.composite
def packets(draw: st.DrawFn, profiles: list[Profile] = PLAIN) -> Packet:
    """Draw a packet, NaN and infinities of every kind included."""
    profile = draw(st.sampled_from(profiles))
    header = draw(headers(profile))
    body = draw(st.binary(min_size=BODY_BYTES[profile], max_size=BODY_BYTES[profile]))
    if profile.is_sealed:
        counter = draw(st.integers(0, 2**32 - 1))
        tag = draw(st.binary(min_size=8, max_size=8))
        if profile.plain in {Profile.TRAJECTORY, Profile.TRAJECTORY_SMALL}:
            spare = len(body) % 12
            body = body[:-spare] + bytes(spare)
        return SealedFrame(header=header, body=body, counter=counter, tag=tag)
    if profile in OPAQUE:
        return SubmapFragment(header=header, body=body)
    if profile is Profile.SUBMAP_PAPER:
        return SubmapPacket(
            header=header,
            trajectory=draw(arrays(4)),
            points_ned_m=draw(arrays(15)),
            hyperparameters=np.frombuffer(draw(st.binary(min_size=16, max_size=16)), np.float32),
        )
    if profile in {Profile.TRAJECTORY, Profile.TRAJECTORY_SMALL}:
        rows = 20 if profile is Profile.TRAJECTORY else 4
        return TrajectoryPacket(header=header, states=draw(arrays(rows)))
    if profile is Profile.ANSWER:
        return Answer(
            header=header, submap=draw(u16), north_m=draw(finite32), east_m=draw(finite32)
        )
    return ExtendedAnswer(
        header=header,
        submap=draw(u16),
        north_m=draw(finite32),
        east_m=draw(finite32),
        variance_m2=draw(variance32),
        leader_north_m=draw(finite32),
        leader_east_m=draw(finite32),
        leader_variance_m2=draw(variance32),
        repeat_submap=draw(u16),
        missing_fragments=draw(u16),
    )


def paper_packet(
    *,
    vehicle: int = 1,
    boot_epoch: int = 0,
    submap: int = 12,
    fragment: int = 0,
    time_quarters: int = 0,
    count: int = 10,
) -> SubmapPacket:
    rng = np.random.default_rng(fragment + 100 * submap)
    header = Header(
        profile=Profile.SUBMAP_PAPER,
        vehicle=vehicle,
        boot_epoch=boot_epoch,
        submap=submap,
        fragment=fragment,
        fragment_count=count,
        tx_second=fragment * 4 % 16,
        time_quarters=time_quarters,
    )

    def values(*shape: int) -> Array32:
        return cast(Array32, rng.normal(size=shape).astype(np.float32))

    return SubmapPacket(
        header=header,
        trajectory=values(4, 3),
        points_ned_m=values(15, 3),
        hyperparameters=values(4),
    )
