import socket

import pytest
from hypothesis import given
from hypothesis import strategies as st

from host_tools.processes.control import (
    Advance,
    Arrival,
    ControlLine,
    Done,
    End,
    Hello,
    Message,
    Refused,
    from_line,
    to_line,
)
from protocol.errors import RemoteProtocolError

seconds = st.floats(allow_nan=False, allow_infinity=False)
crcs = st.integers(0, 2**32 - 1)
arrivals = st.builds(Arrival, crc=crcs, toa_s=st.none() | seconds, heard_s=seconds)
messages = st.one_of(
    st.builds(Hello, vehicle=st.integers(0, 15), mission=st.text()),
    st.builds(
        Advance,
        now_s=seconds,
        arrivals=st.lists(arrivals).map(tuple),
        in_real_time=st.booleans(),
    ),
    st.builds(
        Done, now_s=seconds, frames=st.lists(crcs).map(tuple), missed=st.lists(crcs).map(tuple)
    ),
    st.builds(Refused, reason=st.text()),
    st.just(End()),
)


@given(message=messages)
def test_messages_come_back_the_same_to_the_last_bit_of_a_float(message: Message) -> None:
    line = to_line(message)
    assert line.count(b"\n") == 1
    assert from_line(line) == message


WRONG = [
    b'{"is":"done"}',
    b'{"is":"advance","now_s":1}',
    b"3",
    b'{"is":"hello","vehicle":[1],"mission":"m"}',
    b'{"is":"hello","vehicle":true,"mission":"m"}',
    b'{"is":"hello","vehicle":1,"mission":{}}',
    b'{"is":"done","now_s":"1","frames":[],"missed":[],"line_bytes":0}',
    b'{"is":"done","now_s":1,"frames":[[1]],"missed":[],"line_bytes":0}',
    b'{"is":"done","now_s":1,"frames":[],"missed":["a"],"line_bytes":0}',
    b'{"is":"done","now_s":1,"frames":[],"missed":[],"line_bytes":null}',
    b'{"is":"advance","now_s":1,"arrivals":[{"crc":1,"toa_s":"x","heard_s":1}],"in_real_time":true}',
    b'{"is":"refused","reason":3}',
    b'{"is":["hello"]}',
    b'{"a":' + b"[" * 50_000,
]


@given(line=st.binary() | st.sampled_from(WRONG))
def test_any_other_bytes_are_refused_as_the_peers_error(line: bytes) -> None:
    with pytest.raises(RemoteProtocolError):
        from_line(line)


def test_messages_are_whole_however_the_socket_cuts_them() -> None:
    ours, theirs = socket.socketpair()
    line = ControlLine(ours)
    data = to_line(End()) + to_line(Done(now_s=0.25))
    theirs.sendall(data[:7])
    assert line.receive() == []
    theirs.sendall(data[7:20])
    assert line.receive() == [End()]
    theirs.sendall(data[20:])
    assert line.receive() == [Done(now_s=0.25)]
    theirs.close()
    assert line.receive() == []
    assert not line.is_open
    line.send(End())  # to nobody: no error
    line.close()


def test_a_message_without_an_end_is_refused() -> None:
    ours, theirs = socket.socketpair()
    theirs.setblocking(False)
    line = ControlLine(ours)

    def babble() -> None:
        for _ in range(100):
            theirs.send(b"x" * 8192)
            line.receive()

    with pytest.raises(RemoteProtocolError, match="without an end"):
        babble()
    line.close()
    theirs.close()
