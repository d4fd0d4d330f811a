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


class Sighted:
    """A graph that knows of two vehicles 400 m apart, and what ranges it is told.

    The clock of the second is 30 m ahead, give or take 5. The way between them is known to a metre
    along, and across as a bend of the range says.
    """

    AWAY_M = np.array([240.0, 320.0])
    SIGMA_M = float(np.hypot(1.0, 5.0))

    def __init__(self, settings: RangeSettings) -> None:
        self.graph, self.ranging = MagicMock(), RangeWindows(settings)
        self.told: list[tuple[float, float, float]] = []  # sent at, range and spread
        self.graph.anchor = lambda vehicle, time_s, _: MagicMock(vehicle=vehicle, time_s=time_s)
        self.graph.position = lambda anchor: self.AWAY_M * anchor.vehicle
        self.graph.clock.return_value = 30.0, 5.0
        self.graph.__contains__.return_value = True
        self.graph.add_range = self._add_range
        self.judge = MagicMock(wraps=self.ranging._judge)
        self.ranging._judge = self.judge

    def _add_range(
        self, here: MagicMock, there: MagicMock, range_m: float, spread_m: float, *, sender: int
    ) -> int:
        assert (here.vehicle, there.vehicle, sender) == (0, 1, 1)
        self.told.append((there.time_s, range_m, spread_m))
        return len(self.told) - 1

    def use(self, begin_s: float, bent_m: float, ranges_m: list[float]) -> None:
        """Hear ranges every four seconds and use them, while they bend so much."""
        along = self.AWAY_M / np.hypot(*self.AWAY_M)
        turn = np.column_stack([along, [-along[1], along[0]]])
        covariance_m2 = turn @ np.diag([1.0, np.sqrt(2.0) * 400.0 * bent_m]) @ turn.T
        self.graph.covariance.return_value = np.kron(np.diag([0.0, 1.0]), covariance_m2)
        for k, range_m in enumerate(ranges_m):
            sent_s = begin_s + 4.0 * k
            header = replace(paper_packet().header, tx_second=int(sent_s % 16))
            self.ranging.hold(1, header, sent_s + range_m / 1500.0, DEPTH_M)
        self.ranging.use(1, _track(begin_s + 60.0), 0, _track(begin_s + 60.0), self.graph)


@pytest.mark.parametrize(("depth_m", "across_m"), [(10.0, 400.0), (310.0, 500.0)])
def test_a_range_loses_its_stretch_and_its_slant_but_not_what_the_clock_adds(
    depth_m: float, across_m: float
) -> None:
    sighted = Sighted(RangeSettings(follower_depth_m=depth_m))
    sighted.AWAY_M = sighted.AWAY_M * across_m / 400.0
    slant_m = float(np.hypot(across_m, depth_m - DEPTH_M))
    true_m, stretched_m = 30.0 + slant_m, 30.0 + 1.1 * slant_m
    sighted.use(16.0, 0.1, [true_m, true_m, stretched_m, true_m, true_m + 300.0, true_m])
    times_s, ranges_m, spreads_m = np.transpose(sighted.told)
    assert times_s == pytest.approx([16.0, 20.0, 24.0, 28.0, 36.0])
    assert ranges_m == pytest.approx(np.full(5, 30.0 + across_m))
    bent_m, steepness = 0.1 * 400.0 / across_m, (depth_m - DEPTH_M) / across_m
    spread_m = np.hypot(bent_m, RangeSettings().sigma_m * steepness)
    assert spreads_m == pytest.approx(np.full(5, spread_m), rel=1e-3)
    fates = [sighted.ranging.counters[f"ranges_{f}"] for f in ("used", "unstretched", "rejected")]
    assert fates == [4, 1, 1]
    *_, sigma_m = sighted.judge.judge.call_args.args
    assert sigma_m == pytest.approx(np.hypot(Sighted.SIGMA_M, bent_m))


def test_a_window_is_entered_the_less_roughly_the_less_it_bends() -> None:
    """Anew once it bends half as much, and newest first; it teaches the judge once."""
    sighted, ranges_m = Sighted(RangeSettings()), [430.0] * 5
    rough = RangeSettings().bent_alike * np.sqrt(5.0)
    for begin_s, bent_m, told in (
        (16.0, 1.59, [(16.0, 1.59 * rough)]),
        (216.0, 0.7, [(216.0, 0.7 * rough), (16.0, 0.7 * rough)]),
        (416.0, 0.6, [(416.0, 0.6 * rough)]),  # 0.7 has to become less than 0.35
        (616.0, 0.45, [(616.0, 0.45), (416.0, 0.45), (216.0, 0.45), (16.0, 0.45)]),
    ):
        sighted.told.clear()
        sighted.graph.set_active.reset_mock()
        sighted.use(begin_s, bent_m, ranges_m)
        assert [time_s for time_s, *_ in sighted.told[::5]] == [time_s for time_s, _ in told]
        spreads_m = np.repeat([spread_m for _, spread_m in told], 5)
        assert [spread_m for *_, spread_m in sighted.told] == pytest.approx(spreads_m, rel=1e-3)
        assert sighted.graph.set_active.call_count == 5 * (len(told) - 1)
    assert not sighted.ranging._waiting[1]
    assert sighted.judge.learn.call_count == 4
    counters = sighted.ranging.counters
    assert (counters["ranges_used_roughly"], counters["ranges_used"]) == (15, 20)


@pytest.mark.parametrize(("bent_m", "waits"), [(7.9, False), (8.1, True)])
def test_a_window_that_bends_by_more_than_a_fiftieth_waits(bent_m: float, *, waits: bool) -> None:
    sighted = Sighted(RangeSettings())
    sighted.use(16.0, bent_m, [430.0] * 5)
    assert len(sighted.told) == (0 if waits else 5)
    assert len(sighted.ranging._waiting[1]) == 1


def test_a_rough_window_that_was_composed_with_others_stays_as_it_is() -> None:
    sighted = Sighted(RangeSettings())
    sighted.use(16.0, 1.5, [430.0] * 5)
    sighted.graph.__contains__.return_value = False
    sighted.use(216.0, 0.1, [430.0] * 5)
    assert [time_s for time_s, *_ in sighted.told[5:]] == [216.0, 220.0, 224.0, 228.0, 232.0]
    assert sighted.graph.set_active.call_count == 0
    assert sighted.ranging.counters["ranges_left_rough"] == 5
    assert not sighted.ranging._waiting[1]
