"""Sentences of the Micro-Modem, sound and damaged."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.modems import nmea
from protocol.modems.nmea import Sentence, SentenceReader

GOLDEN = """$CCCFG,CST,1*37 $CACFG,CST,1*35 $CCCFG,SRC,0*30 $CACYC,0,0,8,0,0,1*52 $CCTMQ,0*54
$CAREV,191605,AUV,3.9.4*19 $CACFG,info.serial_number,933*05 $CAREV,030303,AUV,2.0.27087*16
$CAREV,030303,COPROC,0.30.0.56*40 $CATMQ,2019-12-02T03:02:59Z,RTC,RTC*6E
$CACST,1,153026.0000,0,4105,30,0318,0193,10,00,00,01,01,2,004,004,3,3,3,1,154,09,08,10,-6,000,0.0,4125000,5000*5B
$CCCYC,0,1,2,4,0,1*5F $CADRQ,120000,1,2,0,256,1*75 $CCTXD,1,2,0,000102*78
$CARXD,1,2,0,1,000102*61 $CCMPC,1,2*5D $CAMPR,1,2,0.6667*7D""".split()
"""Lines of real logs and of the guides, and five built by their rules."""


def read(data: bytes, step: int = 10_000) -> tuple[list[Sentence], int]:
    reader = SentenceReader()
    for start in range(0, len(data), step):
        reader.receive_data(data[start : start + step])
    found = []
    while (sentence := reader.next_sentence()) is not None:
        found.append(sentence)
    return found, reader.damaged_count


@pytest.mark.parametrize("line", GOLDEN)
def test_golden_lines_are_read_and_written_again(line: str) -> None:
    (sentence,), damaged = read(line.encode() + b"\r\n")
    assert damaged == 0
    assert nmea.encode(sentence.name, *sentence.fields) == line.encode() + b"\r\n"


@pytest.mark.parametrize("end", [b"\r\n", b"\n", b"\r"])
@pytest.mark.parametrize("step", [1, 7, 10_000])
def test_any_terminator_in_any_chunking_gives_the_same(end: bytes, step: int) -> None:
    data = b"".join(line.encode() + end for line in GOLDEN)
    found, damaged = read(data, step)
    assert [s.name for s in found] == [line[1:6] for line in GOLDEN]
    assert damaged == 0


def test_a_line_that_lost_its_end_costs_itself_only() -> None:
    found, damaged = read(b"$CARXD,1,2,0,1,0001$CCTMQ,0*54\r\n$CARXD,1,2\r\n$CCTMQ,0*54\r\n")
    assert [s.name for s in found] == ["CCTMQ", "CCTMQ"]
    assert damaged == 1


def test_lines_without_or_with_wrong_checksum_do_not_pass() -> None:
    found, damaged = read(b"$CACFG,CST,1\r\n$CACFG,CST,1*36\r\n$CACFG,CST,1*3\r\n$CACFG,CST,1*\r\n")
    assert found == []
    assert damaged == 4


def test_hosts_may_leave_the_checksum_out_where_that_is_allowed() -> None:
    sentence = nmea.decode(b"$CCCFG,CST,1", need_checksum=False)
    assert sentence == Sentence(name="CCCFG", fields=("CST", "1"))


def test_a_line_without_end_is_dropped_at_the_cap() -> None:
    reader = SentenceReader()
    for _ in range(100):
        reader.receive_data(b"x" * 1000)
    reader.receive_data(b"\n$CCTMQ,0*54\n")
    assert reader.next_sentence() == Sentence(name="CCTMQ", fields=("0",))
    assert reader.damaged_count >= 10


@given(st.binary(max_size=400), st.integers(1, 40))
def test_any_bytes_in_any_chunking_never_raise(data: bytes, step: int) -> None:
    assert read(data, step)[0] == read(data)[0]
