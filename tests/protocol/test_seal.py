"""Sealed frames: forged, altered, replayed and reflected ones never pass."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.codec import decode, encode
from protocol.crc import with_crc
from protocol.errors import ConfigError, LocalProtocolError, RemoteProtocolError
from protocol.packets import (
    SIZE_BYTES,
    Answer,
    ExtendedAnswer,
    Packet,
    SealedFrame,
    SubmapFragment,
    SubmapPacket,
    TrajectoryPacket,
)
from protocol.seal import WINDOW, Blake2sSuite, Keys, Opener, ReplayWindow, Sealer, Suite
from protocol.seal_state import FileMarks, ReservedCounter, load_keys
from tests.protocol.strategies import PLAIN, packets, paper_packet

KEYS = Keys(bytes(range(32)))
suites: list[Suite] = [Blake2sSuite()]
try:
    from protocol.seal_aes import AesCcmSuite

    suites.append(AesCcmSuite())
except ConfigError:  # the extra is not installed
    pass


class Count:
    def __init__(self) -> None:
        self.number = -1

    def next(self) -> int:
        self.number += 1
        return self.number


def shortened(packet: Packet) -> Packet:
    """Return the packet with the room that a seal needs, from a follower or to one."""
    if isinstance(packet, SubmapPacket):
        return replace(packet, points_ned_m=packet.points_ned_m[:14])
    if isinstance(packet, TrajectoryPacket):
        return replace(packet, states=packet.states[:-1])
    if isinstance(packet, SubmapFragment):
        return replace(packet, body=packet.body[:-12])
    return packet


def follower_packet(fragment: int = 0) -> Packet:
    return shortened(paper_packet(fragment=fragment))


def sealed_frame(fragment: int = 0) -> bytes:
    return Sealer(KEYS, Count()).seal(follower_packet(fragment))


def cause(opener: Opener, frame: bytes) -> str:
    with pytest.raises(RemoteProtocolError) as caught:
        opener.open(decode(frame))
    return caught.value.cause


@pytest.mark.parametrize("suite", suites)
@given(packet=packets(PLAIN))
def test_a_sealed_packet_opens_as_it_was(suite: Suite, packet: Packet) -> None:
    if isinstance(packet, Answer | ExtendedAnswer):
        to, header = 3, replace(packet.header, vehicle=0, fragment=3)
    else:
        to, header = 0, replace(packet.header, vehicle=2)
    packet = shortened(replace(packet, header=header))
    frame = Sealer(KEYS, Count(), suite).seal(packet)
    assert len(frame) == SIZE_BYTES[packet.header.profile.sealed]
    assert Opener(to, KEYS, suite=suite).open(decode(frame)) == packet


def test_the_aes_suite_hides_the_body() -> None:
    if len(suites) == 1:
        pytest.skip("needs the extra: pip install 'fathomlink[aes]'")
    packet = follower_packet()
    open_body = decode(sealed_frame())
    hidden = decode(Sealer(KEYS, Count(), suites[1]).seal(packet))
    assert isinstance(open_body, SealedFrame)
    assert isinstance(hidden, SealedFrame)
    assert len(hidden.body) == len(open_body.body)
    assert hidden.body != open_body.body
    assert cause(Opener(0, KEYS), encode(hidden)) == "tag"


def test_equal_packets_never_share_a_keystream() -> None:
    """In Goby equal headers used a keystream again: whoever listens gets the bodies' difference."""
    if len(suites) == 1:
        pytest.skip("needs the extra: pip install 'fathomlink[aes]'")
    sealer = Sealer(KEYS, Count(), suites[1])
    first, second = (decode(sealer.seal(follower_packet())) for _ in range(2))
    assert isinstance(first, SealedFrame)
    assert isinstance(second, SealedFrame)
    assert first.header == second.header
    pads = zip(first.body, second.body, strict=True)
    assert sum(one == other for one, other in pads) < len(first.body) // 8


@given(st.data())
def test_an_altered_frame_with_a_sound_crc_never_passes(data: st.DataObject) -> None:
    frame = bytearray(sealed_frame()[:-4])
    position = data.draw(st.integers(0, 8 * len(frame) - 1))
    frame[position // 8] ^= 1 << position % 8
    opener = Opener(0, KEYS)
    with pytest.raises(RemoteProtocolError):
        opener.open(decode(with_crc(bytes(frame))))


def forge(count: int) -> int:
    """Return how many of many forged, altered, replayed and reflected frames were accepted."""
    rng = np.random.default_rng(1)
    genuine = [Sealer(KEYS, counter).seal(follower_packet(i)) for i, counter in seals(10)]
    leader, follower = Opener(0, KEYS), Opener(1, KEYS)
    for frame in genuine:
        leader.open(decode(frame))
    accepted = 0
    for i in range(count):
        frame = genuine[i % 10]
        kind = i // 10 % 4
        opener = follower if kind == 3 else leader
        if kind == 0:  # forged: a new counter, a guessed tag
            head = frame[:-16] + (1000 + i).to_bytes(4, "big") + rng.bytes(8)
            frame = with_crc(head)
        elif kind == 1:  # altered: one byte of header, body, counter or tag
            body = bytearray(frame[:-4])
            body[int(rng.integers(1, len(body)))] ^= int(rng.integers(1, 256))
            frame = with_crc(bytes(body))
        try:
            opener.open(decode(frame))
            accepted += 1
        except RemoteProtocolError:
            pass
    return accepted


def seals(count: int) -> "list[tuple[int, Count]]":
    counter = Count()
    return [(i, counter) for i in range(count)]


def test_no_forged_altered_replayed_or_reflected_frame_is_accepted() -> None:
    assert forge(20_000) == 0


@pytest.mark.slow
def test_none_of_a_million_forged_altered_replayed_or_reflected_frames_is_accepted() -> None:
    assert forge(1_000_000) == 0


def test_rejects_tell_their_cause() -> None:
    leader, follower = Opener(0, KEYS), Opener(1, KEYS)
    frame = sealed_frame()
    leader.open(decode(frame))
    assert cause(leader, frame) == "replay"
    assert cause(leader, encode(paper_packet())) == "plain"
    assert cause(follower, frame) == "reflected"
    assert cause(Opener(2, KEYS), frame) == "elsewhere"
    assert cause(leader, with_crc(frame[:-5] + bytes([frame[-5] ^ 1]))) == "tag"
    assert cause(Opener(0, Keys(bytes(32))), frame) == "tag"


def test_each_direction_has_its_own_key() -> None:
    directions = [(a, b) for a in range(16) for b in range(16) if a != b]
    assert len({KEYS.direction(*pair) for pair in directions}) == len(directions)


def test_a_packet_without_room_for_a_seal_is_a_local_error() -> None:
    sealer = Sealer(KEYS, Count())
    with pytest.raises(LocalProtocolError, match="shape"):
        sealer.seal(paper_packet())
    with pytest.raises(LocalProtocolError, match="sealed already"):
        sealer.seal(decode(sealed_frame()))
    with pytest.raises(LocalProtocolError, match="32 bytes, not 16"):
        Keys(bytes(16))


@given(st.lists(st.integers(0, 300), max_size=200))
def test_the_window_accepts_every_counter_at_most_once(counters: list[int]) -> None:
    window = ReplayWindow()
    accepted: set[int] = set()
    for counter in counters:
        newest = max(accepted, default=-1)
        try:
            window.accept(counter)
        except RemoteProtocolError:
            assert counter in accepted or counter <= newest - WINDOW
        else:
            assert counter not in accepted
            assert counter > newest - WINDOW
            accepted.add(counter)


def test_frames_out_of_order_pass_within_the_window_only() -> None:
    window = ReplayWindow()
    window.accept(100)
    window.accept(100 - WINDOW + 1)
    with pytest.raises(RemoteProtocolError, match="behind") as caught:
        window.accept(100 - WINDOW)
    assert caught.value.cause == "stale"


def test_a_receiver_that_restarts_refuses_what_it_had_accepted(tmp_path: Path) -> None:
    marks = FileMarks(tmp_path / "marks")
    frames = [Sealer(KEYS, counter).seal(follower_packet(i)) for i, counter in seals(3)]
    before = Opener(0, KEYS, marks)
    for frame in frames[:2]:
        before.open(decode(frame))
    after = Opener(0, KEYS, FileMarks(tmp_path / "marks"))
    assert cause(after, frames[0]) == cause(after, frames[1]) == "replay"
    after.open(decode(frames[2]))


def test_marks_of_a_damaged_file_are_one_line(tmp_path: Path) -> None:
    for content in (b"[1]", b"{", b'{"1": null}', b"\xff"):
        (tmp_path / "marks").write_bytes(content)
        with pytest.raises(ConfigError, match="marks"):
            FileMarks(tmp_path / "marks").load()


def test_marks_that_cannot_be_written_are_counted(tmp_path: Path) -> None:
    marks = FileMarks(tmp_path / "nowhere" / "marks")
    marks.save({1: 5})
    assert marks.failed_writes == 1


@settings(max_examples=20, deadline=None)  # each counter reserved is a sync of the disk
@given(st.lists(st.integers(0, 20), max_size=10))
def test_counters_never_repeat_across_crashes(
    tmp_path_factory: pytest.TempPathFactory, uses: list[int]
) -> None:
    path = tmp_path_factory.mktemp("counter") / "counter"
    numbers = []
    for count in uses:
        counter = ReservedCounter(path, ahead=7)  # a crash: the last one is simply forgotten
        numbers += [counter.next() for _ in range(count)]
    assert numbers == sorted(set(numbers))


def test_counters_stop_rather_than_repeat(tmp_path: Path) -> None:
    counter = ReservedCounter(tmp_path / "nowhere" / "counter")
    with pytest.raises(LocalProtocolError, match="no counters reserved"):
        counter.next()
    (tmp_path / "counter").write_text(str(2**32 - 10))
    with pytest.raises(LocalProtocolError, match="used up; change the key"):
        ReservedCounter(tmp_path / "counter").next()
    for content in (b"", b"-1", b"12x", b"99999999999", b"\xff"):
        (tmp_path / "counter").write_bytes(content)
        with pytest.raises(ConfigError, match="counter file"):
            ReservedCounter(tmp_path / "counter")


class Files:
    """A disk in memory, on which single files can be damaged or lost."""

    def __init__(self) -> None:
        self.texts: dict[Path, str] = {}

    def read(self, path: Path) -> str:
        if path not in self.texts:
            raise FileNotFoundError(path)
        return self.texts[path]

    def write(self, path: Path, text: str) -> None:
        self.texts[path] = text


@pytest.mark.parametrize("damaged", [0, 1])
@pytest.mark.parametrize("content", ["", "x", "[" * 4000, '{"1": Infinity}', "-4"])
def test_one_damaged_file_of_counters_or_marks_stops_nobody(damaged: int, content: str) -> None:
    files = Files()
    counter, marks = ReservedCounter(Path("c"), files=files), FileMarks(Path("m"), files)
    last = [counter.next() for _ in range(200)][-1]
    marks.save({1: 77})
    for first in ("c", "m"):
        files.texts[sorted(p for p in files.texts if p.name[0] == first)[damaged]] = content
    assert ReservedCounter(Path("c"), files=files).next() > last
    assert FileMarks(Path("m"), files).load() == {1: 77}


def test_counters_of_a_lost_store_begin_at_the_clock() -> None:
    """A sender that begins at zero again would be refused until it had caught up."""
    files = Files()
    counter = ReservedCounter(Path("c"), floor=1000, files=files)
    opener = Opener(0, KEYS)
    sealer = Sealer(KEYS, counter)
    for fragment in range(9):
        opener.open(decode(sealer.seal(follower_packet(fragment))))
    files.texts.clear()
    again = Sealer(KEYS, ReservedCounter(Path("c"), floor=1040, files=files))
    opener.open(decode(again.seal(follower_packet())))


def key_file(tmp_path: Path, text: bytes, mode: int = 0o600) -> Path:
    path = tmp_path / "key"
    path.write_bytes(text)
    path.chmod(mode)
    return path


def test_a_key_file_is_read(tmp_path: Path) -> None:
    text = KEYS.master.hex().upper().encode() + b"\n"
    assert load_keys(key_file(tmp_path, text)) == KEYS


@pytest.mark.parametrize(
    ("text", "mode", "message"),
    [
        (b"00" * 32, 0o644, "has mode 0644; type: chmod 600"),
        (b"00" * 16, 0o600, "holds 32 characters, not 64 hexadecimal digits; make one"),
        (b"zz" * 32, 0o600, "not 64 hexadecimal"),
        (b"\xff" * 64, 0o600, "cannot be read"),
        (b"0" * 10_000, 0o600, "holds 4096 characters"),
    ],
)
def test_a_wrong_key_file_is_one_line_that_says_what_to_do(
    tmp_path: Path, text: bytes, mode: int, message: str
) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        load_keys(key_file(tmp_path, text, mode))
    assert "\n" not in str(caught.value)


def test_a_missing_key_file_says_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="openssl rand -hex 32"):
        load_keys(tmp_path / "key")
