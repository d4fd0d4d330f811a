"""The codec: whole bytes, whole errors, and construct as the second opinion."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.codec import decode, encode, restamp
from protocol.crc import crc32c, with_crc
from protocol.errors import LocalProtocolError, RemoteProtocolError
from protocol.layouts import FRAMES, HEADER_FIELDS
from protocol.packets import (
    SIZE_BYTES,
    Answer,
    ExtendedAnswer,
    Header,
    Packet,
    Profile,
    SealedFrame,
    SubmapPacket,
    TrajectoryPacket,
    answer_count,
    usable_points,
)
from tests.protocol.strategies import packets, paper_packet


def test_crc_of_the_check_string_is_that_of_castagnoli() -> None:
    assert crc32c(b"123456789") == 0xE3069283


@pytest.mark.parametrize("profile", list(Profile))
def test_construct_and_constants_agree_on_every_size(profile: Profile) -> None:
    assert FRAMES[profile].sizeof() == SIZE_BYTES[profile]


@given(packets(list(Profile)))
def test_decode_returns_what_was_encoded(packet: Packet) -> None:
    frame = encode(packet)
    assert len(frame) == SIZE_BYTES[packet.header.profile]
    assert decode(frame) == packet
    assert encode(decode(frame)) == frame


@given(packets(list(Profile)))
def test_construct_reads_the_same_fields(packet: Packet) -> None:
    frame = encode(packet)
    layout = FRAMES[packet.header.profile]
    parsed = layout.parse(frame)
    for name, _ in HEADER_FIELDS:
        assert parsed.header[name] == getattr(packet.header, name)
    assert parsed.crc == crc32c(frame[:-4])
    if isinstance(packet, SubmapPacket):
        np.testing.assert_array_equal(parsed.trajectory, packet.trajectory.ravel())
        np.testing.assert_array_equal(parsed.points_ned_m, packet.points_ned_m.ravel())
        np.testing.assert_array_equal(parsed.hyperparameters, packet.hyperparameters)
    elif isinstance(packet, TrajectoryPacket):
        np.testing.assert_array_equal(parsed.states, packet.states.ravel())
    elif isinstance(packet, Answer | ExtendedAnswer):
        for field in fields(packet)[1:]:
            assert parsed[field.name] == getattr(packet, field.name)
    elif isinstance(packet, SealedFrame):
        assert (parsed.seal.counter, parsed.seal.tag) == (packet.counter, packet.tag)
    else:
        assert parsed.body == packet.body


@given(st.binary(max_size=300))
def test_any_bytes_give_a_packet_or_a_remote_error(data: bytes) -> None:
    for frame in (data, with_crc(data)):
        try:
            packet = decode(frame)
        except RemoteProtocolError:
            continue
        assert encode(packet) == frame


@given(packets(list(Profile)), st.data())
def test_a_turned_bit_never_passes(packet: Packet, data: st.DataObject) -> None:
    frame = bytearray(encode(packet))
    position = data.draw(st.integers(0, 8 * len(frame) - 1))
    frame[position // 8] ^= 1 << position % 8
    with pytest.raises(RemoteProtocolError, match="CRC"):
        decode(bytes(frame))


@given(packets(), st.integers(0, 15))
def test_a_repeat_changes_the_transmission_second_and_the_crc_only(
    packet: Packet, tx_second: int
) -> None:
    frame = encode(packet)
    again = restamp(frame, tx_second)
    changed = {i for i in range(len(frame)) if frame[i] != again[i]}
    assert changed <= {5, *range(len(frame) - 4, len(frame))}
    assert decode(again).header == replace(packet.header, tx_second=tx_second)


def test_message_of_a_damaged_frame_names_fragment_submap_and_both_crcs() -> None:
    frame = bytearray(encode(paper_packet(fragment=7)))
    frame[100] ^= 255
    with pytest.raises(
        RemoteProtocolError,
        match=r"vehicle 1, fragment 7 of submap 12: CRC 0x[0-9a-f]{8}, expected 0x[0-9a-f]{8}",
    ) as caught:
        decode(bytes(frame))
    assert caught.value.cause == "crc"


def test_message_of_a_truncated_frame_names_both_sizes() -> None:
    with pytest.raises(RemoteProtocolError, match=r"100 bytes, SUBMAP_PAPER has 256"):
        decode(encode(paper_packet())[:100])


@pytest.mark.parametrize("size", range(12))
def test_a_frame_shorter_than_any_is_rejected_by_size(size: int) -> None:
    with pytest.raises(RemoteProtocolError, match="smallest") as caught:
        decode(bytes(size))
    assert caught.value.cause == "size"


def test_another_version_is_named_with_what_to_do() -> None:
    frame = bytearray(encode(paper_packet())[:-4])
    frame[0] = 2 << 5 | frame[0] & 31
    with pytest.raises(RemoteProtocolError, match=r"version 2 .* speaks version 1") as caught:
        decode(with_crc(bytes(frame)))
    assert caught.value.cause == "version"


def test_an_unknown_profile_and_a_wrong_size_are_told_apart() -> None:
    with pytest.raises(RemoteProtocolError, match="profile 31") as caught:
        decode(with_crc(bytes([1 << 5 | 31]) + bytes(50)))
    assert caught.value.cause == "profile"
    with pytest.raises(RemoteProtocolError, match="62 bytes: SUBMAP_PAPER has 256") as caught:
        decode(with_crc(bytes([1 << 5 | 1]) + bytes(57)))
    assert caught.value.cause == "size"


def test_layout_errors_of_a_frame_with_a_sound_crc_are_remote() -> None:
    outside = bytearray(encode(paper_packet())[:-4])
    outside[4] = 0xA3  # fragment 10 of 3
    with pytest.raises(RemoteProtocolError, match="fragment 10 of 3"):
        decode(with_crc(bytes(outside)))
    reserved = bytes([1 << 5 | 3, 0, 0, 0, 0x01]) + bytes(246) + b"\x01"
    with pytest.raises(RemoteProtocolError, match="reserved"):
        decode(with_crc(reserved))
    nan = np.float32(np.nan).tobytes()[::-1]
    with pytest.raises(RemoteProtocolError, match="not finite"):
        decode(with_crc(bytes([1 << 5 | 2]) + bytes(9) + nan + bytes(4)))
    minus_one = np.float32(-1.0).tobytes()[::-1]
    with pytest.raises(RemoteProtocolError, match="variances"):
        decode(with_crc(bytes([1 << 5 | 7]) + bytes(17) + minus_one + bytes(16)))


def test_what_a_profile_cannot_hold_is_a_local_error() -> None:
    packet = paper_packet()
    with pytest.raises(LocalProtocolError, match="shape"):
        encode(replace(packet, points_ned_m=packet.points_ned_m[:14]))
    with pytest.raises(LocalProtocolError, match="cannot have profile ANSWER"):
        encode(replace(packet, header=replace(packet.header, profile=Profile.ANSWER)))
    with pytest.raises(LocalProtocolError, match="does not fit"):
        replace(packet.header, vehicle=16)
    header = replace(packet.header, profile=Profile.ANSWER)
    with pytest.raises(LocalProtocolError, match="does not fit"):
        encode(Answer(header=header, submap=70_000, north_m=0.0, east_m=0.0))
    with pytest.raises(LocalProtocolError, match="does not fit"):
        encode(Answer(header=header, submap=7, north_m=1e300, east_m=0.0))
    sealed = SealedFrame(
        header=replace(header, profile=Profile.SEALED_ANSWER),
        body=bytes(9),
        counter=0,
        tag=bytes(8),
    )
    with pytest.raises(LocalProtocolError, match="10 bytes, not 9"):
        encode(sealed)
    unsealed = Answer(header=sealed.header, submap=7, north_m=0.0, east_m=0.0)
    with pytest.raises(LocalProtocolError, match="only a sealed frame"):
        encode(unsealed)
    with pytest.raises(LocalProtocolError, match="never restamped"):
        restamp(encode(replace(sealed, body=bytes(10))), 3)


def test_unused_and_absurd_points_are_told_from_usable_ones() -> None:
    packet = paper_packet()
    points = packet.points_ned_m.copy()
    points[0] = np.nan
    points[1, 2] = np.inf
    points[2, 0] = 2.0e6
    points[3, 2] = 20_000.0
    packet = replace(packet, points_ned_m=points)
    assert usable_points(packet.points_ned_m).tolist() == [False] * 4 + [True] * 11


def test_packets_compare_by_bits_and_hash_alike() -> None:
    packet = paper_packet()
    same = decode(encode(packet))
    assert same == packet
    assert hash(same) == hash(packet)
    assert packet != paper_packet(fragment=1)
    assert packet != "a packet"


def test_header_fields_fill_sixty_four_bits() -> None:
    assert sum(bits for _, bits in HEADER_FIELDS) == 64
    assert {name for name, _ in HEADER_FIELDS} == {field.name for field in fields(Header)}


@given(packets([Profile.ANSWER, Profile.ANSWER_EXTENDED]))
def test_answers_name_their_vehicle_and_its_epoch(packet: Packet) -> None:
    assert isinstance(packet, Answer | ExtendedAnswer)
    assert packet.to_vehicle == packet.header.fragment
    assert packet.to_boot_epoch == packet.header.fragment_count


@pytest.mark.parametrize("sigma_m", [0.0, 0.1, 0.37, 4.0, 250.0, 1e9])
def test_answer_tells_its_sigma_rounded_up_by_four_percent_at_most(sigma_m: float) -> None:
    header = replace(_answer_header(), submap=answer_count(sigma_m, 7_777))
    answer = decode(encode(Answer(header=header, submap=1, north_m=0.0, east_m=0.0)))
    assert isinstance(answer, Answer)
    told_m = answer.sigma_m
    assert told_m is not None
    held_m = min(max(sigma_m, 0.1), 5_800.0)
    assert held_m * 0.999 <= told_m <= held_m * 1.05
    assert answer.header.submap % 256 == 7_777 % 256


def test_answer_without_a_code_tells_no_sigma() -> None:
    answer = Answer(header=_answer_header(), submap=1, north_m=0.0, east_m=0.0)
    assert answer.sigma_m is None


def _answer_header() -> Header:
    return Header(
        profile=Profile.ANSWER, vehicle=0, boot_epoch=0, submap=0, fragment=1, fragment_count=0,
        tx_second=0, time_quarters=0,
    )  # fmt: skip
