"""The numbered tests that a modem driver earns its place by; the same for emulator and hardware."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from hil.benches import Ends
from hil.conftest import OpenEnds
from hil.mission import BenchMission
from protocol.codec import decode, encode
from protocol.modems.dialect_driver import DialectDriver
from protocol.modems.events import LinkQuality, RangeMeasured
from protocol.modems.micromodem import MicroModem
from protocol.packets import Answer, Header, Profile, SubmapFragment
from protocol.timestamps import one_way_travel_time_s, to_tx_second

Record = Callable[[str, object], None]
"""Of pytest: what --junitxml keeps of a run, as the day's record."""
READY_S = 20.0
MISSION_S = 300.0
"""Within this two sub-maps have been measured, fitted and sent, and one was answered."""
PACKET_S = 12.0
"""Within this a packet has been loaded, has waited for its second, has sounded and been told."""


def ready(ends: Ends) -> Ends:
    end_s = ends.bench.now_s + READY_S
    while ends.bench.now_s < end_s and not all(m.status().is_up for m in ends.bench.modems):
        ends.run(0.1)
    assert all(m.status().is_up for m in ends.bench.modems), dict(ends.notices)
    ends.run(
        0.0 if ends.bench.facts.kind in {"loopback", "serial"} else 4.0
    )  # clocks are being set
    return ends


def answer(ends: Ends, submap: int) -> bytes:
    """Return an answer as a vehicle makes it for a start at the present second."""
    header = Header(
        profile=Profile.ANSWER,
        vehicle=0,
        boot_epoch=0,
        submap=submap,
        fragment=0,
        fragment_count=1,
        tx_second=to_tx_second(round(ends.bench.now_s)),
        time_quarters=0,
    )
    return encode(Answer(header=header, submap=submap, north_m=1.0, east_m=2.0))


def fragment(ends: Ends, number: int, count: int) -> bytes:
    """Return a fragment of the largest size that both modems carry."""
    large = min(modem.largest_frame_bytes for modem in ends.bench.modems) >= 256
    profile = Profile.SUBMAP_LATTICE if large else Profile.SUBMAP_LATTICE_SMALL
    header = Header(
        profile=profile,
        vehicle=1,
        boot_epoch=0,
        submap=40,
        fragment=number,
        fragment_count=count,
        tx_second=to_tx_second(round(ends.bench.now_s)),
        time_quarters=160,
    )
    body = np.random.default_rng(number).bytes(244 if large else 50)
    return encode(SubmapFragment(header=header, body=body))


def test_t01_identify(open_ends: OpenEnds) -> None:
    ends = open_ends()
    ends.run(3.0)
    for modem in ends.bench.modems:
        if isinstance(modem, DialectDriver):
            assert modem.verdict is None, modem.verdict
            assert modem.core.identified


def test_t02_configure(open_ends: OpenEnds) -> None:
    ends = ready(open_ends())
    cores = [modem.core for modem in ends.bench.modems if isinstance(modem, DialectDriver)]
    for core in cores:
        assert core.status().get("settings_refused", 0) == 0
        core.lost(ends.bench.now_s)  # begins again by asking the modem what is set
    ready(ends)
    for core in cores:
        if isinstance(core, MicroModem):
            told = {key: int(core.told[key]) for key in ("SRC", "CST", "SNV")}
            assert told == {"SRC": core.settings.address, "CST": 1, "SNV": 1}


def test_t03_send(open_ends: OpenEnds) -> None:
    ends = ready(open_ends())
    for end in (0, 1):
        ends.run_to_second()
        ends.send(end, answer(ends, end))
        ends.run(PACKET_S)
        status = ends.bench.modems[end].status()
        assert (status.sent, status.queued) == (1, 0)


def test_t04_receive(open_ends: OpenEnds) -> None:
    ends = ready(open_ends())
    for end in (0, 1):
        for number in range(3):
            ends.run_to_second()
            ends.send(end, answer(ends, number))
            assert ends.wait_heard(1 - end, number + 1, PACKET_S), dict(ends.notices)
            ends.run(1.0)
        heard = [decode(event.frame) for event in ends.heard[1 - end]]
        assert [packet.header.submap for packet in heard] == [0, 1, 2]
    if ends.bench.facts.kind in {"micromodem", "nanomodem"}:
        qualities = [r for r in ends.reports[1] if isinstance(r, LinkQuality)]
        assert qualities
        assert ends.bench.modems[1].status().quality is not None


def test_t05_range(open_ends: OpenEnds, record_testsuite_property: Record) -> None:
    ends = ready(open_ends())
    if ends.bench.facts.kind == "serial":
        pytest.skip("a raw serial line measures no range")
    if ends.bench.facts.kind == "nanomodem":
        owtts_s = _ranges_by_ping(ends)
    else:
        owtts_s = _ranges_one_way(ends)
    assert len(owtts_s) == 5
    record_testsuite_property(
        f"T05 {ends.bench.facts.kind} ranges_m", [round(1500 * s, 2) for s in owtts_s]
    )
    if ends.bench.facts.range_m is not None:
        truth_s = ends.bench.facts.range_m / 1500.0
        assert max(abs(owtt_s - truth_s) for owtt_s in owtts_s) < 1e-3
    else:
        assert max(owtts_s) - min(owtts_s) < 5e-3, "modems that lie still: the range must hold"


def _ranges_one_way(ends: Ends) -> list[float]:
    for number in range(5):
        ends.run_to_second()
        ends.send(0, answer(ends, number))
        ends.wait_heard(1, number + 1, PACKET_S)
        ends.run(2.0)
    heard = [(decode(event.frame), event.toa_s) for event in ends.heard[1]]
    assert all(toa_s is not None for _, toa_s in heard), "no arrival time is vouched for: pulse?"
    return [one_way_travel_time_s(p.header.tx_second, t) for p, t in heard if t is not None]


def _ranges_by_ping(ends: Ends) -> list[float]:
    modem = ends.bench.modems[0]
    assert isinstance(modem, DialectDriver)
    for _ in range(5):
        modem.core.ping(ends.bench.facts.peer_address)
        ends.run(6.0)
    return [r.owtt_s for r in ends.reports[0] if isinstance(r, RangeMeasured)]


def test_t06_loss(open_ends: OpenEnds, record_testsuite_property: Record) -> None:
    loss, packets = 0.14, 100
    ends = ready(open_ends(loss))
    count = 20 if ends.bench.facts.is_real else packets
    gap_s = 0.1 if ends.bench.facts.kind == "serial" else 4.0
    for number in range(count):
        ends.run_to_second()
        ends.send(0, answer(ends, number))
        ends.run(gap_s)
    ends.run(PACKET_S)
    numbers = [decode(event.frame).header.submap for event in ends.heard[1]]
    record_testsuite_property(f"T06 {ends.bench.facts.kind} heard", f"{len(numbers)} of {count}")
    assert numbers == sorted(set(numbers)), "every frame at most once, in order"
    assert ends.bench.modems[0].status().sent == count
    if ends.bench.facts.is_real:
        assert numbers
        return
    expected = count * (1.0 - ends.bench.facts.loss)
    spread = math.sqrt(count * ends.bench.facts.loss * (1.0 - ends.bench.facts.loss))
    assert abs(len(numbers) - expected) <= 4.0 * spread


def test_t07_submap_and_answer(open_ends: OpenEnds) -> None:
    """What a mission is made of: ten fragments in their slots, and the answer on its way back."""
    ends = ready(open_ends())
    sent = []
    for number in range(10):
        ends.run(-ends.bench.now_s % 4.0)
        sent.append(fragment(ends, number, 10))
        ends.send(0, sent[-1])
        ends.run(0.1)
    assert ends.wait_heard(1, 10, 40.0), dict(ends.notices)
    ends.run_to_second()
    ends.send(1, answer(ends, 40))
    assert ends.wait_heard(0, 1, PACKET_S), dict(ends.notices)
    bodies = [getattr(decode(event.frame), "body", b"") for event in ends.heard[1]]
    assert bodies == [getattr(decode(frame), "body", b"") for frame in sent]
    assert decode(ends.heard[0][0].frame).header.submap == 40


def test_t08_mission(open_ends: OpenEnds, record_testsuite_property: Record) -> None:
    """The vehicles' own programs: sub-maps placed by the leader, an answer heard in return."""
    ends = ready(open_ends(0.14))
    mission, end_s = BenchMission(ends.bench), ends.bench.now_s + MISSION_S
    while ends.bench.now_s < end_s and not mission.is_done():
        mission.step()
    leader, follower = mission.status()
    told = {name: count for name, count in {**leader, **follower}.items() if count}
    record_testsuite_property(f"T08 {ends.bench.facts.kind}", told)
    assert mission.is_done(), told
    assert not any(name.endswith("_failed") for name in told), told
