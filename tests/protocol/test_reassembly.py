"""Reassembly under loss, repeats, disorder, mixed vehicles, restarts and wrapping counters."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.lattice import Protection, bodies_of, stream_of
from protocol.packets import BODY_BYTES, Profile, SubmapFragment, SubmapPacket
from protocol.reassembly import (
    FragmentArrived,
    Reassembler,
    ReassemblyEvent,
    ReassemblySettings,
    SubmapTransfer,
)
from tests.protocol.strategies import paper_packet

SETTINGS = ReassemblySettings()


def events(reassembler: Reassembler) -> list[ReassemblyEvent]:
    found = []
    while (event := reassembler.next_event()) is not None:
        found.append(event)
    return found


def transfers(reassembler: Reassembler) -> list[SubmapTransfer]:
    return [event for event in events(reassembler) if isinstance(event, SubmapTransfer)]


def submap(
    index: int, *, vehicle: int = 1, boot_epoch: int = 0, at_s: int = 0
) -> list[SubmapPacket]:
    return [
        paper_packet(
            vehicle=vehicle,
            boot_epoch=boot_epoch,
            submap=index,
            fragment=fragment,
            time_quarters=(4 * at_s + 16 * fragment) % 2**20,
        )
        for fragment in range(10)
    ]


def test_ten_fragments_make_a_complete_transfer_at_once() -> None:
    reassembler = Reassembler(SETTINGS)
    sent = submap(12)
    for i, packet in enumerate(sent):
        reassembler.receive(packet, 4.0 * i)
    *arrivals, transfer = events(reassembler)
    assert [a.fragment for a in arrivals if isinstance(a, FragmentArrived)] == sent
    assert isinstance(transfer, SubmapTransfer)
    assert transfer.is_complete
    assert transfer.reason == "complete"
    assert list(transfer.fragments.values()) == sent
    assert (transfer.first_arrival_s, transfer.last_arrival_s) == (0.0, 36.0)
    assert reassembler.counters.accepted == 10
    assert reassembler.counters.complete == 1


def test_a_newer_submap_closes_an_incomplete_one_after_a_deadline() -> None:
    reassembler = Reassembler(SETTINGS)
    for i, packet in enumerate(submap(3)):
        if i not in {2, 7}:
            reassembler.receive(packet, 4.0 * i)
    reassembler.receive(submap(4)[0], 40.0)
    assert transfers(reassembler) == []
    reassembler.advance(40.0 + SETTINGS.overtaken_s)
    (transfer,) = transfers(reassembler)
    assert set(range(10)) - set(transfer.fragments) == {2, 7}
    assert transfer.reason == "overtaken"
    assert not transfer.is_complete


def test_a_repeat_within_the_deadline_still_completes() -> None:
    reassembler = Reassembler(SETTINGS)
    sent = submap(3)
    for packet in sent[:-1]:
        reassembler.receive(packet, 0.0)
    reassembler.receive(submap(4)[0], 40.0)
    reassembler.receive(sent[-1], 41.0)
    (transfer,) = transfers(reassembler)
    assert transfer.submap == 3
    assert transfer.is_complete


def test_an_old_transfer_closes_by_age_alone() -> None:
    reassembler = Reassembler(SETTINGS)
    reassembler.receive(submap(3)[0], 0.0)
    reassembler.advance(SETTINGS.oldest_s - 0.1)
    assert transfers(reassembler) == []
    reassembler.advance(SETTINGS.oldest_s)
    assert [t.reason for t in transfers(reassembler)] == ["too-old"]


def test_a_clock_that_is_set_back_keeps_no_transfer_open() -> None:
    reassembler = Reassembler(SETTINGS)
    reassembler.receive(submap(3)[0], 4000.0)
    reassembler.receive(submap(4)[0], 4001.0)
    reassembler.advance(400.0)
    assert [t.submap for t in transfers(reassembler)] == [3, 4]


def test_duplicates_and_late_fragments_are_counted_and_change_nothing() -> None:
    reassembler = Reassembler(SETTINGS)
    sent = submap(3)
    for packet in [sent[0], sent[0], *sent[1:], sent[4]]:
        reassembler.receive(packet, 0.0)
    assert len(transfers(reassembler)) == 1
    assert reassembler.counters.duplicates == 1
    assert reassembler.counters.spare == 1
    assert events(reassembler) == []


def test_a_fragment_of_a_transfer_that_was_closed_without_it_is_late() -> None:
    reassembler = Reassembler(SETTINGS)
    sent = submap(3)
    for packet in sent[:9]:
        reassembler.receive(packet, 0.0)
    reassembler.receive(sent[9], SETTINGS.oldest_s)
    assert [sorted(t.fragments) for t in transfers(reassembler)] == [list(range(9))]
    assert (reassembler.counters.late, reassembler.counters.spare) == (1, 0)


def test_a_lattice_is_handed_on_as_soon_as_others_would_tell_nothing_new() -> None:
    """The first six frames that arrive give every column; then no more of them is asked for."""
    stream = bytes(range(200)) * 7
    protection = Protection(thresholds=(2, 4, 6), columns=(20, 60))
    bodies = bodies_of(b"", stream[:1200], protection, BODY_BYTES[Profile.SUBMAP_LATTICE], 10)
    reassembler = Reassembler(SETTINGS)
    for index in (9, 1, 3, 4, 7, 8, 2):
        header = replace(submap(5)[index].header, profile=Profile.SUBMAP_LATTICE, time_quarters=100)
        reassembler.receive(SubmapFragment(header=header, body=bodies[index]), 4.0 * index)
    (transfer,) = transfers(reassembler)
    assert (transfer.reason, sorted(transfer.fragments)) == ("enough", [1, 3, 4, 7, 8, 9])
    arrived = {
        index: fragment.body
        for index, fragment in transfer.fragments.items()
        if isinstance(fragment, SubmapFragment)
    }
    assert stream_of(arrived, 0, 10).startswith(stream[:1200])
    assert (reassembler.counters.complete, reassembler.counters.spare) == (1, 1)
    assert reassembler.counters.partial == 0
    assert reassembler.missing(1, 0) is None


@given(st.permutations(range(10)))
def test_any_order_gives_the_same_transfer(order: list[int]) -> None:
    reassembler = Reassembler(SETTINGS)
    sent = submap(5)
    for i in order:
        reassembler.receive(sent[i], 1.0)
    (transfer,) = transfers(reassembler)
    assert list(transfer.fragments.values()) == sent


def test_interleaved_vehicles_do_not_mix() -> None:
    reassembler = Reassembler(SETTINGS)
    one, two = submap(7, vehicle=1), submap(7, vehicle=2)
    for pair in zip(one, two, strict=True):
        for packet in pair:
            reassembler.receive(packet, 0.0)
    first, second = transfers(reassembler)
    assert list(first.fragments.values()) == one
    assert list(second.fragments.values()) == two


def test_reassembler_hands_on_the_oldest_when_slots_are_full() -> None:
    reassembler = Reassembler(ReassemblySettings(slots=2))
    for vehicle in (1, 2, 3):
        reassembler.receive(submap(0, vehicle=vehicle)[0], float(vehicle))
    (transfer,) = transfers(reassembler)
    assert (transfer.vehicle, transfer.reason) == (1, "evicted")
    counters = reassembler.counters
    assert (counters.evicted, counters.partial, counters.open) == (1, 1, 2)
    reassembler.flush()
    assert (counters.partial, counters.open) == (3, 0)


@pytest.mark.parametrize(("repeated", "waits_s"), [(9, SETTINGS.overtaken_s), (10, 60.0)])
def test_an_overtaken_transfer_waits_for_repeats_where_there_are_any(
    repeated: int, waits_s: float
) -> None:
    reassembler = Reassembler(ReassemblySettings(fragments_with_repeats=repeated))
    reassembler.receive(submap(3)[0], 0.0)
    reassembler.receive(submap(4)[0], 40.0)
    reassembler.advance(40.0 + waits_s - 0.1)
    assert transfers(reassembler) == []
    reassembler.advance(40.0 + waits_s)
    assert [(t.submap, t.reason) for t in transfers(reassembler)] == [(3, "overtaken")]


def test_only_so_many_closed_transfers_are_remembered() -> None:
    reassembler = Reassembler(ReassemblySettings(remembered=2))
    for index in (1, 2, 3, 2, 1):
        for packet in submap(index):
            reassembler.receive(packet, 0.0)
    assert [t.submap for t in transfers(reassembler)] == [1, 2, 3, 1]
    assert reassembler.counters.spare == 10


def test_a_restart_with_counter_zero_is_a_new_submap_of_a_new_epoch() -> None:
    reassembler = Reassembler(SETTINGS)
    before, after = submap(0), submap(0, boot_epoch=1)
    for packet in before[:5]:
        reassembler.receive(packet, 0.0)
    for packet in after:
        reassembler.receive(packet, 50.0)
    reassembler.flush()
    found = {t.boot_epoch: t for t in transfers(reassembler)}
    assert list(found[0].fragments.values()) == before[:5]
    assert list(found[1].fragments.values()) == after


@pytest.mark.parametrize("closed", [True, False])
def test_a_counter_that_begins_anew_without_an_epoch_is_seen_by_its_time(closed: bool) -> None:
    reassembler = Reassembler(SETTINGS)
    before, after = submap(0), submap(0, at_s=3000)
    for packet in before if closed else before[:5]:
        reassembler.receive(packet, 0.0)
    for packet in after:
        reassembler.receive(packet, 3000.0 if closed else 60.0)
    first, second = transfers(reassembler)
    assert list(first.fragments.values()) == (before if closed else before[:5])
    assert list(second.fragments.values()) == after
    assert reassembler.counters.restarted == 1


def test_the_counter_wraps() -> None:
    reassembler = Reassembler(SETTINGS)
    for packet in submap(65535)[:9]:
        reassembler.receive(packet, 0.0)
    reassembler.receive(submap(0, at_s=40)[0], 40.0)
    reassembler.advance(71.0)
    assert [t.submap for t in transfers(reassembler)] == [65535]


def test_a_fragment_of_an_overtaken_submap_first_heard_late_is_handed_on_soon() -> None:
    reassembler = Reassembler(SETTINGS)
    reassembler.receive(submap(9)[0], 0.0)
    reassembler.receive(submap(8)[9], 1.0)
    reassembler.advance(1.0 + SETTINGS.overtaken_s)
    assert [(t.submap, t.reason) for t in transfers(reassembler)] == [(8, "overtaken")]


def test_slices_across_the_turn_of_the_clock_belong_together() -> None:
    reassembler = Reassembler(SETTINGS)
    for packet in submap(6, at_s=2**18 - 20):
        reassembler.receive(packet, 0.0)
    assert [t.is_complete for t in transfers(reassembler)] == [True]


def test_a_fragment_that_contradicts_its_transfer_is_dropped_and_counted() -> None:
    reassembler = Reassembler(SETTINGS)
    first, second, *_ = submap(6)
    reassembler.receive(first, 0.0)
    contradicting = replace(second, header=replace(second.header, fragment_count=4))
    reassembler.receive(contradicting, 1.0)
    assert reassembler.counters.conflicting == 1
    assert len(events(reassembler)) == 1


def test_missing_fragments_are_named_once_later_ones_were_heard() -> None:
    reassembler = Reassembler(SETTINGS)
    sent = submap(6)
    assert reassembler.missing(1, 0) is None
    for i in (0, 1, 4):
        reassembler.receive(sent[i], 4.0 * i)
    reassembler.receive(submap(2, vehicle=2)[0], 17.0)
    assert reassembler.missing(1, 0) == (6, 0b1100)
    assert reassembler.missing(2, 0) is None
    reassembler.receive(submap(7)[0], 40.0)
    assert reassembler.missing(1, 0) == (6, 0b1111101100)


def test_what_a_dead_boot_left_open_hides_nothing_that_the_new_one_lacks() -> None:
    reassembler = Reassembler(SETTINGS)
    for i in (0, 2):
        reassembler.receive(submap(6)[i], 4.0 * i)
    for i in (0, 2):
        reassembler.receive(submap(0, boot_epoch=1, at_s=10)[i], 10.0 + 4.0 * i)
    assert reassembler.missing(1, 0) == (6, 0b1111111010)
    assert reassembler.missing(1, 1) == (0, 0b10)


def test_events_nobody_fetches_are_bounded_and_counted() -> None:
    reassembler = Reassembler(ReassemblySettings(queued_events=16))
    for index in range(3):
        for packet in submap(index):
            reassembler.receive(packet, 0.0)
    assert len(events(reassembler)) == 16
    assert reassembler.counters.events_dropped == 33 - 16


@given(
    st.lists(
        st.tuples(
            st.integers(0, 3),  # vehicle
            st.integers(0, 2),  # epoch
            st.sampled_from([0, 1, 2, 3, 65534, 65535]),
            st.integers(0, 9),
            st.sampled_from([0, 100, 5000, 200_000]),
            st.floats(0.0, 50.0),
        ),
        max_size=80,
    )
)
def test_whatever_comes_nothing_is_handed_on_twice_and_memory_is_bounded(
    arrivals: list[tuple[int, int, int, int, int, float]],
) -> None:
    settings = ReassemblySettings(slots=3, remembered=4)
    reassembler = Reassembler(settings)
    now_s, accepted, handed_on = 0.0, [], []
    for vehicle, epoch, index, fragment, at_s, wait_s in arrivals:
        now_s += wait_s
        packet = paper_packet(
            vehicle=vehicle,
            boot_epoch=epoch,
            submap=index,
            fragment=fragment,
            time_quarters=4 * at_s + 16 * fragment,
        )
        reassembler.receive(packet, now_s)
        assert len(reassembler._slots) <= settings.slots
        assert len(reassembler._closed) <= settings.remembered
        for event in events(reassembler):
            if isinstance(event, FragmentArrived):
                accepted.append(id(event.fragment))
            else:
                handed_on += [id(f) for f in event.fragments.values()]
    reassembler.flush()
    for transfer in transfers(reassembler):
        handed_on += [id(f) for f in transfer.fragments.values()]
    assert sorted(accepted) == sorted(handed_on)
    counters = reassembler.counters
    closed = counters.late + counters.spare
    dropped = counters.duplicates + closed + counters.conflicting
    assert counters.accepted + dropped == len(arrivals)
