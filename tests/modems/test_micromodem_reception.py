"""Statistics lines, clock modes and arrival times of the Micro-Modem."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.modems import nmea
from protocol.modems.micromodem_clock import ModemClock
from protocol.modems.micromodem_reception import (
    PacketInProgress,
    mission_time_s,
    parse_statistics,
    pulse_is_good,
    second_of_day,
)
from protocol.modems.nmea import Sentence

RUN_TOGETHER = (
    b"$CACST,1,153026.0000,0,4105,30,0318,0193,10,00,00,01,01,2,004,004,3,3,3,1,154,09,08,10,-6,"
    b"000,0.0,4125000,5000*5B"
)


def statistics(text: str) -> object:
    return parse_statistics(Sentence(name="CACST", fields=tuple(text.split(","))))


def test_real_line_with_noise_and_carrier_run_together_is_read() -> None:
    sentence = nmea.decode(RUN_TOGETHER)
    assert sentence is not None
    found = parse_statistics(sentence)
    assert found is not None
    assert found.mode == 1
    assert found.second_of_day == 15 * 3600 + 30 * 60 + 26
    assert (found.clock_mode, found.rate, found.source) == (0, 2, 4)
    assert (found.frames, found.bad_frames) == (3, 1)
    assert (found.snr_in_db, found.snr_out_db, found.quality) == (9.0, 8.0, 0)


def test_version_6_is_shifted_by_one_and_has_a_date() -> None:
    old = "0,120000.6667,3,1,2,3,4,5,6,7,8,9,4,001,002,0,3,2,0,1,20,21,3,-9,255,-0.5,40,25000,5000"
    new = "6," + old.replace("120000.6667", "20191202120000.6667")
    assert statistics(old) == statistics(new)


@pytest.mark.parametrize("count", range(30))
def test_shorter_lines_are_read_as_far_as_they_go(count: int) -> None:
    fields = "0,120000.5000,3,1,2,3,4,5,6,7,8,9,4,1,2,0,3,2,0,1,20,21,3,-9,255,0,40,25000,5000"
    text = ",".join(fields.split(",")[:count])
    found = statistics(text)
    assert (found is None) == (count == 0)


@given(st.lists(st.text(alphabet="0123456789.-+eE_xnaif ,", max_size=8), max_size=40))
def test_no_statistics_line_raises(fields: list[str]) -> None:
    parse_statistics(Sentence(name="CACST", fields=tuple(fields)))
    packet = PacketInProgress(1)
    for name in ("CARXD", "CARDP", "CAMSG"):
        packet.take(Sentence(name=name, fields=tuple(fields)), 0.0)


@pytest.mark.parametrize(
    "text", ["", "1", "1e5", "240000.0", "126000", "12000x", "120000.x", "nan"]
)
def test_a_time_that_is_none_is_none(text: str) -> None:
    assert second_of_day(text) is None


@pytest.mark.parametrize(
    ("mode", "bit_field", "good"),
    [
        (0, False, False),
        (1, False, False),
        (2, False, True),
        (3, False, True),
        (2, True, False),
        (3, True, False),
        (2 | 3 << 2, True, True),
        (3 | 3 << 2, True, True),
        (1 | 4 << 2, True, False),
        (None, True, False),
        (-1, False, False),
    ],
)
def test_only_a_good_pulse_makes_arrivals_ranges(
    mode: int | None, bit_field: bool, good: bool
) -> None:
    assert pulse_is_good(mode, bit_field=bit_field) is good


def test_mission_time_survives_midnight() -> None:
    zero = 23 * 3600.0
    assert mission_time_s(23 * 3600 + 5.25, zero, 6.0) == 5.25
    assert mission_time_s(1800.5, zero, 5400.0) == pytest.approx(5400.5)
    assert mission_time_s(23 * 3600 + 5.25, zero, 86_400.0) == pytest.approx(86_405.25)


def test_an_arrival_needs_a_set_clock_a_good_pulse_and_a_recent_time() -> None:
    clock = ModemClock("2026-01-01T00:00:00Z")
    clock.mode = 3
    assert clock.arrival_s(100.25, 103.0) is None
    clock.is_set = True
    assert clock.arrival_s(100.25, 103.0) == 100.25
    clock.mode = 1
    assert clock.arrival_s(100.25, 103.0) is None
    clock.mode = 3
    assert clock.arrival_s(500.25, 103.0) is None
    assert not clock.is_set
    assert clock.counters["unsynchronised_arrivals"] == 3
