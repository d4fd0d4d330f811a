"""What composing the past leaves of the closures between two of its pieces."""

import dataclasses

import numpy as np
import pytest

from firmware.geometry import Array
from firmware.leader.composition import Composition, CompositionSettings
from firmware.leader.ledger import Anchor, ClosureRecord, Entry

SETTINGS = CompositionSettings()


def told_by(*records: ClosureRecord) -> list[ClosureRecord]:
    """Return what composing leaves of closures between the nodes 1 to 3 and 11, 10 m farther on."""
    states = {key: np.zeros(4) for key in (1, 2, 3)} | {11: np.array([10.0, 0.0, 0.0, 0.0])}
    states |= {90: np.array([0.02, 0.01]), 91: np.zeros(2)}
    composition = Composition({}, {}, {1, 2, 3, 11}, states, SETTINGS)
    ledger = {k: Entry(record=record, active=True) for k, record in enumerate(records)}
    coarse = composition.coarse(ledger)
    left = [*(entry.record for entry in coarse.kept.values()), *coarse.new]
    return [record for record in left if isinstance(record, ClosureRecord)]


def closure(covariance_m2: Array, north_m: float = 10.0, key: int = 1) -> ClosureRecord:
    here = Anchor(
        key=key,
        parameters=90,
        offset_m=np.zeros(2),
        time_s=10.0 * key,
        lever_m=np.full(2, 9.0),
    )
    there = Anchor(key=11, parameters=91, offset_m=np.zeros(2), time_s=99.0)
    offset_m = np.array([north_m, 0.0])
    return ClosureRecord(origin=here, target=there, offset_m=offset_m, covariance_m2=covariance_m2)


def turned(told: ClosureRecord) -> ClosureRecord:
    return dataclasses.replace(
        told, origin=told.target, target=told.origin, offset_m=-told.offset_m
    )


def test_closures_told_from_both_ends_are_one() -> None:
    one, other = closure(np.eye(2), 10.5), closure(np.eye(2), 9.7)
    (same_way,) = told_by(one, other)
    for records in ((one, turned(other)), (turned(one), other), (turned(one), turned(other))):
        (composed,) = told_by(*records)
        assert (composed.origin.key, composed.origin.lever_m[0]) == (1, 9.0)
        np.testing.assert_allclose(composed.offset_m, same_way.offset_m)
        np.testing.assert_allclose(composed.covariance_m2, np.eye(2))


def test_closure_that_stays_alone_is_told_as_it_was() -> None:
    """Whoever knows its number takes it for the same offset."""
    for record in (closure(np.eye(2)), turned(closure(np.eye(2)))):
        (left,) = told_by(record)
        assert (left.origin.key, left.target.key) == (record.origin.key, record.target.key)
        np.testing.assert_array_equal(left.offset_m, record.offset_m)


def test_closures_with_the_oldest_pieces_stay_and_hints_where_there_is_room() -> None:
    sure_m2, hint_m2 = np.eye(2), 400.0 * np.eye(2)
    for told, stay in (
        ((sure_m2, 4.0 * sure_m2, 0.5 * sure_m2), [1, 2]),
        ((hint_m2, hint_m2, sure_m2), [1, 3]),
        ((hint_m2, 9.0 * sure_m2, sure_m2), [2, 3]),
        ((hint_m2, hint_m2, hint_m2), [1, 2]),
    ):
        left = told_by(*(closure(each, key=key) for key, each in enumerate(told, start=1)))
        assert sorted(record.origin.key for record in left) == stay


def test_closures_alike_are_as_uncertain_as_one_and_vague_ones_take_nothing_from_a_sure_one() -> (
    None
):
    sure_m2 = np.array([[1.0, 0.3], [0.3, 2.0]])
    (alike,) = told_by(*[closure(sure_m2)] * 9)
    np.testing.assert_allclose(alike.covariance_m2, sure_m2)
    (beside_hints,) = told_by(closure(sure_m2), *[closure(1e4 * np.eye(2), 60.0)] * 9)
    np.testing.assert_allclose(beside_hints.covariance_m2, sure_m2, rtol=0.01)
    assert beside_hints.offset_m == pytest.approx([10.0, 0.0], abs=0.1)
    along, across = closure(np.diag([1.0, 1e4])), closure(np.diag([1e4, 1.0]))
    (crossed,) = told_by(along, across)
    np.testing.assert_allclose(crossed.covariance_m2, 2.0 * np.eye(2), rtol=1e-3)


def test_one_axis_closures_tell_as_much_together_as_one_of_them() -> None:
    rng = np.random.default_rng(6)
    for scatter_rad in (0.0, 0.02):  # of their axes
        axes = np.array([[np.cos(a), np.sin(a)] for a in scatter_rad * rng.normal(size=20)])
        (composed,) = told_by(*[closure(one_axis(axis)) for axis in axes])
        assert np.linalg.eigvalsh(composed.covariance_m2)[0] == pytest.approx(0.64, rel=0.01)


def one_axis(axis: Array) -> Array:
    return 1e8 * np.eye(2) - (1e8 - 0.64) * np.outer(axis, axis)


def test_composed_closures_are_never_surer_than_all_together() -> None:
    rng = np.random.default_rng(5)
    for count in (2, 3, 7):
        roots_m = rng.normal(size=(count, 2, 2)) * np.geomspace(0.3, 30.0, count)[:, None, None]
        spread_m2 = roots_m @ roots_m.transpose(0, 2, 1) + 0.01 * np.eye(2)
        (composed,) = told_by(*[closure(each) for each in spread_m2])
        joint = np.linalg.inv(spread_m2).sum(axis=0)
        assert np.linalg.eigvalsh(joint - np.linalg.inv(composed.covariance_m2)).min() > -1e-6
