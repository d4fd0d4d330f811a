"""COBS framing: any chunking, any noise."""

from hypothesis import given
from hypothesis import strategies as st

from protocol.framing import GUARD_BYTES, QUEUED_FRAMES, LineReader, wrap

frames = st.binary(min_size=1, max_size=256)


def read_all(reader: LineReader) -> list[bytes]:
    found = []
    while (line_frame := reader.next_frame()) is not None:
        found.append(line_frame.frame)
    return found


def read(*chunks: bytes) -> list[bytes]:
    reader = LineReader()
    for chunk in chunks:
        reader.receive_data(chunk)
    return read_all(reader)


def chunked(data: bytes, sizes: list[int]) -> list[bytes]:
    chunks = []
    for size in sizes:
        chunks.append(data[:size])
        data = data[size:]
    return [*chunks, data]


@given(st.lists(frames, max_size=10), st.lists(st.integers(0, 400)))
def test_whole_chunked_and_byte_by_byte_agree(sent: list[bytes], sizes: list[int]) -> None:
    line = b"".join(map(wrap, sent))
    assert read(line) == sent
    assert read(*chunked(line, sizes)) == sent
    assert read(*(bytes([byte]) for byte in line)) == sent


@given(st.binary(max_size=3000), st.lists(st.integers(0, 700)))
def test_any_bytes_in_any_chunking_never_raise_and_agree(data: bytes, sizes: list[int]) -> None:
    assert read(*chunked(data, sizes)) == read(data)


@given(st.binary(max_size=2000), frames)
def test_a_frame_after_any_garbage_is_read(garbage: bytes, frame: bytes) -> None:
    assert read(garbage, wrap(frame))[-1] == frame


@given(frames, st.binary(max_size=600))
def test_trailing_bytes_do_not_touch_a_finished_frame(frame: bytes, trailing: bytes) -> None:
    assert read(wrap(frame) + trailing)[0] == frame


@given(frames, frames, st.data())
def test_a_half_frame_costs_only_itself(cut: bytes, whole: bytes, data: st.DataObject) -> None:
    size = data.draw(st.integers(0, len(wrap(cut)) - 1))
    found = read(wrap(cut)[:size] + wrap(whole))
    assert found[-1] == whole
    assert len(found) <= 2


def test_framing_costs_three_bytes_on_a_full_frame() -> None:
    assert len(wrap(b"\x01" * 253)) == 256
    assert len(wrap(b"\x01" * 256)) == 260  # COBS adds one byte per 254 begun
    assert len(wrap(bytes(256))) == 259


def test_a_run_without_delimiter_is_dropped_at_the_guard_and_counted() -> None:
    reader = LineReader()
    for _ in range(100):
        reader.receive_data(b"\x55" * 100)
        assert len(reader._partial) <= GUARD_BYTES
    reader.receive_data(wrap(b"after"))
    assert read_all(reader) == [b"after"]
    assert reader.overlong == 1


def test_frames_nobody_fetches_are_dropped_oldest_first_and_counted() -> None:
    reader = LineReader()
    sent = [bytes([i % 256, 1]) for i in range(QUEUED_FRAMES + 5)]
    reader.receive_data(b"".join(map(wrap, sent)))
    assert read_all(reader) == sent[5:]
    assert reader.overflowed == 5


def test_bad_code_bytes_are_counted() -> None:
    reader = LineReader()
    reader.receive_data(b"\x00\x05\x01\x00")
    assert reader.bad_frames == 1
    assert reader.next_frame() is None


def test_a_frame_carries_the_time_of_its_first_byte() -> None:
    reader = LineReader()
    line = wrap(b"abc")
    reader.receive_data(line[:3], 10.0)
    reader.receive_data(line[3:], 11.0)
    line_frame = reader.next_frame()
    assert line_frame is not None
    assert line_frame.first_byte_s == 10.0
