"""Whatever comes over the line, in whatever chunks and at whatever times, no core raises."""

from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.modems import nmea
from protocol.modems.dialect_driver import Core
from protocol.modems.micromodem import MicroModem
from protocol.modems.micromodem_settings import MicroModemSettings
from protocol.modems.nanomodem import Nanomodem
from protocol.modems.nanomodem_states import NanomodemSettings

NAMES = (
    "CACFG CAREV CACLK CATMS CATMQ CACYC CADRQ CATXD CATXP CATXF CAXST CAACK CARXP CARXD CAMSG"
    " CACST CAMPC CAMPA CAMPR CAMUC CAMUA CAMUR CATDP CARDP CAERR CATOA SNTTA"
).split()
FIELDS = st.one_of(
    st.sampled_from(["", "0", "1", "2", "-1", "SRC", "CST", "INIT", "AUV", "2.0.36870", "NMEA"]),
    st.sampled_from(["BAD_CRC", "000102", "1;3;000102", "120000.5000", "2026-01-01T00:00:05Z"]),
    st.text(alphabet="0123456789ABCDEF;.,-", max_size=12),
)
SENTENCES = st.builds(
    lambda name, fields: nmea.encode(name, *fields),
    st.sampled_from(NAMES),
    st.lists(FIELDS, max_size=30),
)
REPLIES = st.sampled_from(
    [
        *(b"#A001V12345\r\n", b"#A001\r\n", b"$A001\r\n", b"$B05\r\n", b"$U00205\r\n"),
        *(b"$M00205\r\n", b"#R002T00100\r\n", b"#TO\r\n", b"E\r\n", b"$C3\r\n", b"$C-\r\n"),
        *(b"#B00206V00001\r\n", b"#B00205\x02\x01abc\r\n", b"#U05\x02\x01abc\r\n"),
        *(b"#B00202\x02\x01\r\n", b"#U99"),
    ]
)
STEPS = st.lists(
    st.tuples(st.one_of(SENTENCES, REPLIES, st.binary(max_size=40)), st.floats(0.0, 7.0)),
    max_size=40,
)


def drive(core: Core, steps: list[tuple[bytes, float]], stride: int) -> list[str]:
    now_s = 0.0
    seen = []
    for number, (data, wait_s) in enumerate(steps):
        now_s += wait_s
        if number % 3 == 0:
            core.send(bytes([number]) * 8, now_s)
        if number % 7 == 0:
            core.ping(2)
        for start in range(0, len(data), stride):
            core.receive_data(data[start : start + stride], now_s)
        core.poll(now_s)
        assert core.next_wakeup_s(now_s) >= now_s
        while (event := core.next_event()) is not None:
            seen.append(repr(event))
        if number % 11 == 10:
            core.lost(now_s)
    queued = core.status()["queued"]
    status = core.status()
    assert queued == status["confirmed"] + status["dropped"] + len(core.outbox)
    return seen


@settings(max_examples=80, deadline=None)
@given(STEPS, st.integers(1, 9))
def test_micromodem_takes_anything_and_chunks_do_not_matter(
    steps: list[tuple[bytes, float]], stride: int
) -> None:
    whole = drive(MicroModem(MicroModemSettings()), steps, 10_000)
    assert drive(MicroModem(MicroModemSettings()), steps, stride) == whole


@settings(max_examples=80, deadline=None)
@given(STEPS, st.integers(1, 9))
def test_nanomodem_takes_anything_and_chunks_do_not_matter(
    steps: list[tuple[bytes, float]], stride: int
) -> None:
    whole = drive(Nanomodem(NanomodemSettings()), steps, 10_000)
    assert drive(Nanomodem(NanomodemSettings()), steps, stride) == whole
