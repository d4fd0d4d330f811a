"""A past made coarse: the estimate stays, the graph stays small, a copy goes on the same."""

import dataclasses
import pickle
from typing import TypeVar

import numpy as np
import pytest

from firmware.geometry import Array, offset_covariance
from firmware.leader.chains import Chain
from firmware.leader.composition import CompositionSettings, kept_nodes
from firmware.leader.graph_settings import GraphSettings
from firmware.leader.ledger import (
    AbsoluteRecord,
    ClosureRecord,
    OdometryRecord,
    RangeRecord,
    Record,
    SharedWalkRecord,
)
from firmware.leader.pose_graph import PoseGraph
from firmware.submaps import Track
from protocol.errors import EstimationError

HOURS, LAP_S = 1.5, 400
SETTINGS = CompositionSettings()
_Kind = TypeVar("_Kind", bound=Record)


def sailed(rng: np.random.Generator, seconds: int, side_m: float) -> tuple[Track, Array]:
    """Return drifting dead reckoning around a square, a lap in LAP_S, and the true way (T, 2)."""
    time_s = np.arange(seconds + 1.0)
    angle = 2 * np.pi * time_s / LAP_S
    true_m = 100.0 * np.column_stack([np.cos(angle), np.sin(angle)]) + side_m
    drift_m = np.cumsum(np.array([0.1, 0.05]) + 0.2 * rng.standard_normal((seconds + 1, 2)), axis=0)
    north_m, east_m = (true_m + drift_m - drift_m[0]).T
    return Track(time_s=time_s, north_m=north_m, east_m=east_m, yaw_rad=angle), true_m


def until(track: Track, end_s: float) -> Track:
    rows = track.time_s <= end_s
    return Track(**{f.name: getattr(track, f.name)[rows] for f in dataclasses.fields(Track)})


class Voyage:
    """Two vehicles on laps, a closure with the lap before and a range every minute."""

    def __init__(
        self, settings: CompositionSettings | None, seconds: int = int(3600 * HOURS)
    ) -> None:
        self.rng, self.settings = np.random.default_rng(3), settings
        self.tracks = [sailed(self.rng, seconds, side_m) for side_m in (0.0, 30.0)]
        self.graph = PoseGraph(GraphSettings())
        for vehicle, (track, true_m) in enumerate(self.tracks):
            start_m = np.array([track.north_m[0], track.east_m[0]])
            self.graph.add_chain(vehicle, 0.0, start_m, true_m[0])
        self.nodes: list[int] = []
        self.records: list[int] = []

    def run(self, begin_s: int, end_s: int) -> "Voyage":
        """Sail on by minutes; compose as often as a leader does."""
        for now_s in range(begin_s + 60, end_s + 1, 60):
            for vehicle, (track, _) in enumerate(self.tracks):
                self.graph.extend(vehicle, until(track, now_s))
            self._close(now_s)
            self.graph.update()
            if self.settings is not None and now_s % 600 == 0:
                self.graph.compose(now_s, self.settings)
                self.nodes.append(self.graph.nodes)
                self.records.append(self.graph.records)
        return self

    def misses_m(self, vehicle: int) -> Array:
        """Return the error (T,) of the whole estimate."""
        track, true_m = self.tracks[vehicle]
        reckoned_m = np.column_stack([track.north_m, track.east_m])
        estimate_m = self.graph.trajectory(vehicle).correct(track.time_s, reckoned_m)
        return np.asarray(np.hypot(*(estimate_m - true_m).T))

    def _close(self, now_s: int) -> None:
        (own, own_m), (other, other_m) = self.tracks
        at = [
            self.graph.anchor(0, float(now_s), own),
            self.graph.anchor(1, float(now_s), other),
        ]
        range_m = float(np.hypot(*(other_m[now_s] - own_m[now_s])))
        self.graph.add_range(at[0], at[1], range_m + self.rng.standard_normal())
        for lap in (1, 2, 5):
            then_s = now_s - lap * LAP_S
            if then_s < 0:
                continue
            for vehicle, (track, true_m) in enumerate(self.tracks):
                there = self.graph.anchor(vehicle, float(then_s), track)
                offset_m = true_m[now_s] - true_m[then_s] + 0.5 * self.rng.standard_normal(2)
                self.graph.add_closure(there, at[vehicle], offset_m, 0.25 * np.eye(2), active=True)


@pytest.fixture(scope="module")
def whole() -> Voyage:
    return Voyage(None).run(0, int(3600 * HOURS))


@pytest.fixture(scope="module")
def coarse() -> Voyage:
    return Voyage(SETTINGS).run(0, int(3600 * HOURS))


def test_coarse_past_costs_little_accuracy(whole: Voyage, coarse: Voyage) -> None:
    for vehicle in (0, 1):
        assert coarse.misses_m(vehicle).mean() < 1.25 * whole.misses_m(vehicle).mean()


def test_coarse_past_keeps_one_node_a_piece(whole: Voyage, coarse: Voyage) -> None:
    hours = HOURS - SETTINGS.detail_s / 3600.0
    pieces = 2 * hours * 3600.0 / SETTINGS.piece_s
    detail = 2 * SETTINGS.detail_s / 10.0
    assert coarse.graph.nodes < 1.1 * (pieces + detail) < 0.45 * whole.graph.nodes
    assert coarse.graph.records < 0.6 * whole.graph.records


def test_covariance_stays_honest(whole: Voyage, coarse: Voyage) -> None:
    """The sigma of the newest position, where only one lap in three of closures hits a node."""
    sigmas_m = [
        np.sqrt(np.trace(v.graph.predicted_covariance(0, 3600 * HOURS))) for v in (whole, coarse)
    ]
    assert 0.8 * sigmas_m[0] < sigmas_m[1] < 1.6 * sigmas_m[0]


def test_composing_moves_the_estimate_by_less_than_its_sigma() -> None:
    voyage = Voyage(None).run(0, 3600)
    voyage.graph.solve_batch()
    sigma_m = np.sqrt(np.trace(voyage.graph.predicted_covariance(0, 3600.0)))
    before_m = [voyage.graph.trajectory(v).position_m for v in (0, 1)]
    voyage.graph.compose(3600.0, SETTINGS)
    for vehicle in (0, 1):
        after_m = voyage.graph.trajectory(vehicle).position_m
        assert len(after_m) == len(before_m[vehicle])
        assert np.hypot(*(after_m - before_m[vehicle]).T).max() < sigma_m


def test_incremental_and_batch_agree_on_a_coarse_past(coarse: Voyage) -> None:
    graph = pickle.loads(pickle.dumps(_composed(coarse)))
    before_m = graph.trajectory(0).position_m
    graph.solve_batch()
    assert np.hypot(*(graph.trajectory(0).position_m - before_m).T).max() < 0.05


def test_copy_goes_on_exactly_as_its_original() -> None:
    voyage = Voyage(SETTINGS).run(0, 3000)
    copied = Voyage(SETTINGS)
    copied.graph = pickle.loads(pickle.dumps(voyage.graph))
    voyage.rng, copied.rng = np.random.default_rng(9), np.random.default_rng(9)
    for each in (voyage, copied):
        each.run(3000, 4200)
    for vehicle in (0, 1):
        ours, theirs = (v.graph.trajectory(vehicle).position_m for v in (voyage, copied))
        np.testing.assert_array_equal(ours, theirs)


def test_graph_with_news_is_not_written_down() -> None:
    voyage = Voyage(SETTINGS).run(0, 600)
    voyage.graph.extend(0, until(voyage.tracks[0][0], 700.0))
    with pytest.raises(TypeError, match="news"):
        pickle.dumps(voyage.graph)


def test_rough_range_takes_nothing_from_the_sharp_ones_beside_it() -> None:
    voyage = Voyage(None).run(0, 600)
    (own, own_m), (other, other_m) = voyage.tracks
    graph, ends_s = voyage.graph, (301.0, 302.0, 303.0)
    apart_m = [float(np.hypot(*(other_m[int(t)] - own_m[int(t)]))) for t in ends_s]
    for time_s, true_m, miss_m, spread_m in zip(
        ends_s, apart_m, (0.0, 0.0, 60.0), (0.0, 0.0, 60.0), strict=True
    ):
        ends = graph.anchor(0, time_s, own), graph.anchor(1, time_s, other)
        graph.add_range(*ends, true_m + miss_m, spread_m)
    graph.update()
    graph.compose(3000.0, SETTINGS)
    (composed,) = [
        record for record in _records(graph, RangeRecord) if 240.0 < record.target.time_s < 480.0
    ]
    assert composed.sigma_m < 1.5
    assert abs(composed.innovation_m(graph._state)[0]) < 1.5


def test_way_between_dropped_nodes_is_no_surer_than_before(whole: Voyage, coarse: Voyage) -> None:
    """Both may hang on the same node that is left: the way between them is not known exactly."""
    pairs_s = ((613.0, 703.0), (613.0, 1205.0), (905.0, 1999.0))
    for ends_s in pairs_s:
        sigmas_m = []
        for voyage in (whole, coarse):
            track = voyage.tracks[0][0]
            ends = [voyage.graph.anchor(0, time_s, track) for time_s in ends_s]
            apart_m2 = offset_covariance(voyage.graph.covariance(ends))
            sigmas_m.append(float(np.sqrt(np.linalg.eigvalsh(apart_m2)[-1])))
        assert 0.9 * sigmas_m[0] < sigmas_m[1] < 4.0 * sigmas_m[0]


def test_anchor_in_the_composed_past_lies_on_the_estimated_track() -> None:
    voyage = Voyage(None).run(0, 3600)
    voyage.graph.compose(3600.0, SETTINGS)
    track, _ = voyage.tracks[0]
    assert np.abs(voyage.graph.parameters(0)).min() > 1e-4
    for time_s in (613.0, 905.0):
        anchor = voyage.graph.anchor(0, time_s, track)
        assert np.hypot(*anchor.offset_m) > 5.0
        lies_m = voyage.graph.trajectory(0).correct(time_s, track.position_at(time_s))
        assert voyage.graph.position(anchor) == pytest.approx(lies_m, abs=1e-6)


def test_range_into_the_composed_past_is_as_unsure_as_a_closure_there() -> None:
    voyage = Voyage(None).run(0, 3600)
    voyage.graph.compose(3600.0, SETTINGS)
    here, there = (voyage.graph.anchor(v, 613.0, voyage.tracks[v][0]) for v in (0, 1))
    between_m = voyage.graph.offset(here, there)
    along = between_m / np.hypot(*between_m)
    apart_m2 = along @ (here.apart_m2 + there.apart_m2) @ along
    record = voyage.graph.record(voyage.graph.add_range(here, there, 30.0))
    assert isinstance(record, RangeRecord)
    assert apart_m2 > 0.1
    assert record.sigma_m**2 == pytest.approx(GraphSettings().range_sigma_m ** 2 + apart_m2)


def test_fixes_of_a_piece_become_one_no_surer_than_each() -> None:
    voyage = Voyage(None, 3600)
    track, true_m = voyage.tracks[0]
    voyage.graph.extend(0, track)
    for time_s in range(0, 1200, 10):
        anchor = voyage.graph.anchor(0, float(time_s), track)
        voyage.graph.add_absolute(anchor, true_m[time_s], 9.0 * np.eye(2))
    voyage.graph.compose(3600.0, SETTINGS)
    fixes = [entry.record for entry in voyage.graph._ledger.values()]
    left = [record for record in fixes if isinstance(record, AbsoluteRecord)]
    assert 0 < len(left) <= 1200 / SETTINGS.piece_s + 1
    assert all(record.covariance_m2[0, 0] >= 9.0 for record in left)
    assert np.median(voyage.misses_m(0)[:1200]) < 3.0


def test_time_before_a_chain_has_no_anchor_in_the_composed_past() -> None:
    voyage = Voyage(SETTINGS, 3600).run(0, 3600)
    track, _ = voyage.tracks[0]
    with pytest.raises(EstimationError, match="no node near"):
        voyage.graph.anchor(0, -500.0, track)


def test_composition_that_fails_leaves_the_graph_as_it_was(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    voyage = Voyage(None, 3600).run(0, 3000)

    def fails(*_: object) -> dict[int, Array]:
        raise EstimationError("singular")

    with monkeypatch.context() as patch:
        patch.setattr(voyage.graph, "apart_m2", fails)
        with pytest.raises(EstimationError):
            voyage.graph.compose(3000.0, SETTINGS)
    assert voyage.graph.wandering.walk == GraphSettings().bias_walk
    voyage.run(3000, 3600)
    voyage.graph.compose(3600.0, SETTINGS)
    assert np.mean(voyage.misses_m(0)) < 3.0


def test_ways_to_owners_are_asked_a_few_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = Voyage(None, 3600).run(0, 3600).graph
    owners = {
        key: chain.keys[k // 6 * 6]
        for chain in graph._chains.values()
        for k, key in enumerate(chain.keys)
        if k % 6
    }
    asked, covariance = [], graph._solver.covariance

    def counted(keys: list[int], *, reckoned: bool = False) -> Array:
        asked.append(len(keys))
        return covariance(keys, reckoned=reckoned)

    with monkeypatch.context() as patch:
        patch.setattr(graph._solver, "covariance", counted)
        apart_m2 = graph.apart_m2(owners)
    assert len(owners) == 600
    assert max(asked) < 100
    assert apart_m2.keys() == owners.keys()
    for node, owner in list(owners.items())[::37]:
        alone_m2 = graph.apart_m2({node: owner})[node]
        np.testing.assert_allclose(apart_m2[node], alone_m2, rtol=1e-9, atol=1e-9)


def test_closure_beyond_its_sigmas_is_not_taken_along() -> None:
    voyage = Voyage(None).run(0, 3600)
    track, true_m = voyage.tracks[0]
    then, now = (voyage.graph.anchor(0, t, track) for t in (500.0, 1100.0))
    wrong_m = true_m[1100] - true_m[500] + 20.0
    number = voyage.graph.add_closure(then, now, wrong_m, np.eye(2), active=True)
    voyage.graph.update()
    voyage.graph.compose(3600.0, SETTINGS)
    assert number not in voyage.graph
    left = _records(voyage.graph, ClosureRecord)
    misses_m = [record.innovation_m(voyage.graph._state) for record in left]
    assert np.hypot(*np.array(misses_m).T).max() < 8.0


def test_every_kept_node_is_tied_to_the_one_before(coarse: Voyage) -> None:
    graph = coarse.graph
    for chain in graph._chains.values():
        steps = {(r.origin, r.target) for r in _records(graph, OdometryRecord)}
        assert all(pair in steps for pair in zip(chain.keys, chain.keys[1:], strict=False))
    walks = _records(graph, SharedWalkRecord)
    assert len(walks) >= SETTINGS.distant_s / SETTINGS.piece_s
    assert 0 < len(_records(graph, RangeRecord)) <= 3600 * HOURS / 60


def _records(graph: PoseGraph, kind: type[_Kind]) -> list[_Kind]:
    return [e.record for e in graph._ledger.values() if isinstance(e.record, kind)]


def _composed(voyage: Voyage) -> PoseGraph:
    voyage.graph.compose(3600 * HOURS, SETTINGS)
    return voyage.graph


def test_window_of_detail_keeps_every_node_whatever_is_called_distant() -> None:
    chain = Chain(number=0, parameters=0)
    chain.times_s = [10.0 * k for k in range(300)]
    chain.keys = list(range(300))
    settings = CompositionSettings(detail_s=3000.0, distant_s=1200.0)
    assert kept_nodes(chain, 2990.0, set(), settings).all()
