"""Selective repeat: in free slots only, bounded, and never a storm."""

from benchmarks.link import trial
from protocol.repeats import FragmentQueue, RepeatSettings
from tests.protocol.strategies import paper_packet

SETTINGS = RepeatSettings()


def queue_with(index: int = 3, count: int = 8) -> FragmentQueue:
    queue = FragmentQueue(SETTINGS)
    queue.add([paper_packet(submap=index, fragment=i, count=count) for i in range(count)])
    return queue


def send_all(queue: FragmentQueue, start_s: float = 0.0) -> list[tuple[int, int]]:
    sent: list[tuple[int, int]] = []
    while (fragment := queue.next_fragment(start_s + 4.0 * len(sent), 100)) is not None:
        sent.append((fragment.header.submap, fragment.header.fragment))
    return sent


def test_fresh_fragments_go_in_order_with_their_transmission_second() -> None:
    queue = queue_with()
    fragment = queue.next_fragment(37.0, 10)
    assert fragment is not None
    assert (fragment.header.fragment, fragment.header.tx_second) == (0, 5)
    assert send_all(queue) == [(3, i) for i in range(1, 8)]
    assert queue.counters["fresh"] == 8
    assert queue.next_fragment(100.0, 10) is None


def test_a_repeat_goes_first_when_the_fresh_ones_fit_without_its_slot() -> None:
    queue = queue_with()
    send_all(queue)
    queue.add([paper_packet(submap=4, fragment=i, count=8) for i in range(8)])
    queue.request(3, 0b101, asked_s=60.0)
    assert queue.wanted == 2
    order = []
    for slots_left in range(10, 0, -1):
        fragment = queue.next_fragment(100.0, slots_left)
        assert fragment is not None
        order.append((fragment.header.submap, fragment.header.fragment))
    assert order == [(3, 0), (3, 2), *((4, i) for i in range(8))]


def test_without_free_slots_nothing_is_repeated() -> None:
    queue = queue_with()
    send_all(queue)
    queue.add([paper_packet(submap=4, fragment=i, count=10) for i in range(10)])
    queue.request(3, 0b1, asked_s=60.0)
    submaps = []
    for slots_left in range(10, 0, -1):
        fragment = queue.next_fragment(100.0, slots_left)
        assert fragment is not None
        submaps.append(fragment.header.submap)
    assert submaps == [4] * 10
    assert queue.wanted == 1


def test_what_the_leader_has_closed_is_repeated_no_more() -> None:
    """Else the queue stays too long for ever: each repeat comes after its sub-map was closed."""
    queue = queue_with(index=0xFFFF)
    send_all(queue)
    queue.add([paper_packet(submap=0, fragment=i, count=8) for i in range(8)])
    send_all(queue, 40.0)
    queue.request(0xFFFF, 0b111, asked_s=100.0)
    queue.request(0, 0b1100, asked_s=110.0)
    assert send_all(queue, 120.0) == [(0, 2), (0, 3)]
    assert queue.counters["overtaken"] == 3
    queue.request(0, 0b1_0001, asked_s=200.0)
    queue.request(0, 0b1_0000, asked_s=210.0)  # fragment 0 has come meanwhile
    queue.request(1, 0, asked_s=210.0)  # an answer that asks for nothing
    assert send_all(queue, 220.0) == [(0, 4)]
    assert queue.counters["repeated"] == 3


def test_what_is_wanted_of_a_newer_submap_stays_when_an_older_one_is_asked_for() -> None:
    queue = queue_with(index=0xFFFF)
    queue.add([paper_packet(submap=0, fragment=i, count=8) for i in range(8)])
    send_all(queue)
    queue.request(0, 0b1, asked_s=100.0)
    queue.request(0xFFFF, 0b1, asked_s=110.0)
    assert send_all(queue, 120.0) == [(0, 0), (0xFFFF, 0)]


def test_a_request_made_before_the_last_copy_could_arrive_is_ignored() -> None:
    queue = queue_with()
    send_all(queue)  # fragment 7 left at 28 s
    queue.request(3, 1 << 7, asked_s=28.0 + SETTINGS.settle_s - 0.1)
    assert (queue.wanted, queue.counters["early"]) == (0, 1)
    queue.request(3, 1 << 7, asked_s=28.0 + SETTINGS.settle_s)
    assert queue.wanted == 1


def test_a_fragment_not_sent_yet_is_not_repeated() -> None:
    queue = queue_with()
    queue.request(3, 0b1, asked_s=10.0)
    assert (queue.wanted, queue.counters["early"]) == (0, 1)


def test_the_same_request_again_and_again_makes_no_storm() -> None:
    queue = queue_with()
    send_all(queue)
    repeated = 0
    for second in range(100, 10_000, 10):
        queue.request(3, 0xFFFF, asked_s=float(second))
        repeated += queue.next_fragment(float(second), 10) is not None
    assert repeated == 8 * SETTINGS.most_repeats
    assert queue.counters["exhausted"] > 0


def test_old_and_unknown_submaps_are_not_repeated() -> None:
    queue = queue_with(0)
    send_all(queue)
    queue.request(0, 0b1, asked_s=100.0)
    for index in range(1, SETTINGS.submaps_kept + 1):
        queue.add([paper_packet(submap=index, fragment=0, count=1)])
        send_all(queue)
    queue.request(0, 0b1, asked_s=200.0)
    queue.request(99, 0b11, asked_s=200.0)
    queue.request(1, 0b10, asked_s=200.0)
    assert queue.wanted == 0
    assert queue.counters["unknown"] == 4


def test_fresh_fragments_are_bounded_and_drops_counted() -> None:
    queue = FragmentQueue(SETTINGS)
    for index in range(4):
        queue.add([paper_packet(submap=index, fragment=i, count=10) for i in range(10)])
    assert queue.fresh == 30
    assert queue.counters["dropped"] == 10


def test_a_forgotten_submap_takes_its_wishes_along() -> None:
    queue = queue_with(0)
    send_all(queue)
    queue.add([paper_packet(submap=1, fragment=0, count=1)])
    send_all(queue, 40.0)
    for index in (1, 0):
        queue.request(index, 0b1, asked_s=100.0)
    assert queue.wanted == 2
    for index in range(2, SETTINGS.submaps_kept + 1):
        queue.add([paper_packet(submap=index, fragment=0, count=1)])
    assert send_all(queue, 200.0) == [(1, 0), *((index, 0) for index in range(2, 7))]


def test_at_14_percent_loss_repeats_complete_99_of_100_submaps_with_a_fifth_more_air() -> None:
    plain = trial(frames=7, repeats=False, hours=3.0)
    repeated = trial(frames=7, repeats=True, hours=3.0)
    assert plain.complete_share < 0.5
    assert repeated.complete_share >= 0.99
    assert repeated.extra_air <= 0.20


def test_the_papers_ten_frames_leave_no_air_for_repeats() -> None:
    result = trial(frames=10, repeats=True, hours=1.0)
    assert result.fresh == 900
    assert result.extra_air < 0.02
