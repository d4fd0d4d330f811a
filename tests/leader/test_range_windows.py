from dataclasses import replace
from unittest.mock import MagicMock

import numpy as np
import pytest

from firmware.leader.range_judge import RangeSettings
from firmware.leader.range_windows import RangeWindows, _Fate
from firmware.submaps import Track
from protocol.errors import EstimationError
from tests.protocol.strategies import paper_packet

DEPTH_M = 10.0


def test_frames_of_one_packet_give_one_range() -> None:
    ranging = RangeWindows(RangeSettings())
    header = replace(paper_packet().header, tx_second=8)
    for fragment in (0, 1):
        ranging.hold(1, replace(header, fragment=fragment), 8.4, DEPTH_M)
    ranging.hold(2, header, 8.4, DEPTH_M)  # another vehicle, though it can hardly be
    ranging.hold(1, header, 24.4, DEPTH_M)
    assert [held.chain for held in ranging._held] == [1, 2, 1]
    assert ranging.counters == {"ranges_of_one_packet": 1}


def _track(end_s: float) -> Track:
    times_s = np.arange(end_s + 1.0)
    return Track(time_s=times_s, north_m=times_s, east_m=0 * times_s, yaw_rad=0 * times_s)


def _heard(ranging: RangeWindows, begin_s: int, end_s: int) -> None:
    header = paper_packet().header
    for sent_s in range(begin_s, end_s, 8):
        ranging.hold(1, replace(header, tx_second=sent_s % 16), sent_s + 0.4, DEPTH_M)


def test_window_that_stays_undecided_does_not_hold_up_older_ones(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Bent windows wait, the next stays undecided for ever; the third frees the bent ones."""
    fates = {8: _Fate.BENT, 104: _Fate.UNDECIDED, 200: _Fate.ENTERED}
    tried: list[int] = []

    def placed(_self: RangeWindows, window: MagicMock, *_: object) -> object:
        return window.held

    def enter(_self: RangeWindows, _window: object, held: list[MagicMock], _graph: object) -> _Fate:
        begin_s = max(s for s in fates if s <= held[0].sent_s)
        tried.append(begin_s)
        return fates[begin_s]

    monkeypatch.setattr(RangeWindows, "_placed", placed)
    monkeypatch.setattr(RangeWindows, "_enter", enter)
    ranging, graph = RangeWindows(RangeSettings()), MagicMock()
    for begin_s, end_s in ((8, 60), (104, 160)):
        _heard(ranging, begin_s, end_s)
        ranging.use(1, _track(end_s), 0, _track(end_s), graph)
    fates[8] = _Fate.ENTERED
    tried.clear()
    _heard(ranging, 200, 250)
    ranging.use(1, _track(250), 0, _track(250), graph)
    assert tried == [200, 104, 8]
    assert [window.held[0].sent_s for window in ranging._waiting[1]] == [104]


def test_no_window_grows_without_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes: list[int] = []

    def enter(_self: RangeWindows, _window: object, held: list[object], _graph: object) -> _Fate:
        sizes.append(len(held))
        return _Fate.UNDECIDED

    monkeypatch.setattr(RangeWindows, "_placed", lambda _self, window, *_: window.held)
    monkeypatch.setattr(RangeWindows, "_enter", enter)
    settings = RangeSettings(waiting=3)
    ranging = RangeWindows(settings)
    for begin_s in range(0, 1600, 200):
        _heard(ranging, begin_s, begin_s + 200)
        ranging.use(1, _track(begin_s + 200), 0, _track(begin_s + 200), MagicMock())
    assert max(sizes) <= settings.joined
    assert len(ranging._waiting[1]) == 3
    assert ranging.counters["ranges_given_up"] > 0


def test_a_range_told_late_joins_no_window_of_new_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RangeWindows, "_placed", lambda _self, window, *_: window.held)
    monkeypatch.setattr(RangeWindows, "_enter", lambda *_: _Fate.UNDECIDED)
    ranging = RangeWindows(RangeSettings())
    for sent_s in (800, 8):
        _heard(ranging, sent_s, sent_s + 8)
        ranging.use(1, _track(820), 0, _track(820), MagicMock())
    waiting_s = [[held.sent_s for held in window.held] for window in ranging._waiting[1]]
    assert waiting_s == [[800], [8]]


def test_a_range_that_has_no_place_leaves_its_window_once(monkeypatch: pytest.MonkeyPatch) -> None:
    def anchor(_vehicle: int, time_s: float, _track: Track) -> MagicMock:
        if time_s < 10.0:
            raise EstimationError("no node near")
        return MagicMock()

    monkeypatch.setattr(RangeWindows, "_enter", lambda *_: _Fate.UNDECIDED)
    ranging, graph = RangeWindows(RangeSettings()), MagicMock()
    graph.anchor, graph.clock.return_value = anchor, (0.0, 0.0)
    graph.position.return_value = np.zeros(2)
    for begin_s in (8, 200, 400):
        _heard(ranging, begin_s, begin_s + 24)
        ranging.use(1, _track(begin_s + 24), 0, _track(begin_s + 24), graph)
    assert ranging.counters["ranges_unplaceable"] == 1
    assert [held.sent_s for held in ranging._waiting[1][0].held] == [16, 24]


def test_windows_wait_while_the_graph_tells_no_covariance() -> None:
    ranging, graph = RangeWindows(RangeSettings()), MagicMock()
    graph.clock.return_value, graph.position.return_value = (0.0, 0.0), np.zeros(2)
    graph.covariance.side_effect = EstimationError("the information matrix is singular")
    for begin_s in (8, 200):
        _heard(ranging, begin_s, begin_s + 24)
        ranging.use(1, _track(begin_s + 24), 0, _track(begin_s + 24), graph)
    assert [len(window.held) for window in ranging._waiting[1]] == [3, 3]


@pytest.mark.parametrize("late_s", [0.0, 0.001, 60.0])
def test_impossible_ranges_are_counted_and_not_held(late_s: float) -> None:
    ranging = RangeWindows(RangeSettings())
    ranging.hold(1, replace(paper_packet().header, tx_second=8), 8.0 + late_s, DEPTH_M)
    assert not ranging._held
    assert ranging.counters["ranges_impossible"] == 1


def test_only_a_range_that_is_held_overwrites_another() -> None:
    ranging = RangeWindows(RangeSettings(held=16))
    _heard(ranging, 8, 136)
    header = replace(paper_packet().header, tx_second=8)
    ranging.hold(1, header, 136.0, DEPTH_M)
    assert ranging.counters["ranges_overwritten"] == 0
    ranging.hold(1, header, 136.4, DEPTH_M)
    assert ranging.counters["ranges_overwritten"] == 1
