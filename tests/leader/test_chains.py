"""The nodes of one vehicle: which is nearest, what is lost between them, what ties two chains."""

import itertools

import numpy as np
import pytest

from firmware.dead_reckoning import LOST_SIGMA_MPS
from firmware.leader.chains import Chain, shared_walk


def chain(number: int, times_s: list[float]) -> Chain:
    """Return a chain whose keys are a hundred times its number and more; it makes 2 m/s north."""
    return Chain(
        number=number,
        parameters=99,
        times_s=times_s,
        reckoned_m=[np.array([2.0 * time_s, 0.0]) for time_s in times_s],
        keys=[100 * number + k for k in range(len(times_s))],
    )


def test_the_nearest_node_is_the_earlier_of_two() -> None:
    one = chain(0, [10.0, 20.0, 30.0, 70.0])
    for time_s in np.arange(0.0, 90.0, 2.5):
        away_s = np.abs(np.array(one.times_s) - time_s)
        assert one.nearest(float(time_s)) == np.argmin(away_s)


def test_nodes_are_found_by_their_exact_time_or_the_one_before() -> None:
    one = chain(3, [10.0, 20.0, 30.0])
    keys = [one.key_at(time_s) for time_s in (5.0, 10.0, 15.0, 30.0, 35.0)]
    assert keys == [None, 300, None, 302, None]
    assert [one.before(time_s) for time_s in (5.0, 10.0, 15.0, 30.0, 35.0)] == [0, 0, 0, 2, 2]


def test_odometry_is_as_unsure_as_noise_walk_and_what_was_lost() -> None:
    one = chain(1, [10.0, 20.0, 40.0])
    one.lose(25.0, 28.0)
    record = one.odometry(1, 2, 0.2, 0.01)
    assert (record.origin, record.target, record.parameters) == (101, 102, 99)
    assert record.moved_m == pytest.approx([40.0, 0.0])
    assert record.interval_s == 20.0
    variance_m2 = 0.2**2 * 20.0 + 0.01**2 * 20.0**3 / 12.0 + (3.0 * LOST_SIGMA_MPS) ** 2
    assert record.position_sigma_m**2 == pytest.approx(variance_m2)
    assert record.bias_sigma_mps**2 == pytest.approx(0.01**2 * 20.0)


def test_a_loss_that_goes_on_is_one_span_and_grows_with_its_time() -> None:
    one = chain(0, [0.0])
    for begin_s, end_s in ((40.0, 41.0), (10.0, 12.0), (12.0, 14.0), (9.0, 15.0), (16.0, 17.0)):
        one.lose(begin_s, end_s)
    assert sorted(one.lost) == [(9.0, 15.0), (16.0, 17.0), (40.0, 41.0)]
    assert one.lost_m2(0.0, 11.0) == pytest.approx((2.0 * LOST_SIGMA_MPS) ** 2)
    grown_m2 = (36.0 - 4.0 + 1.0 + 0.25) * LOST_SIGMA_MPS**2
    assert one.lost_m2(11.0, 40.5) == pytest.approx(grown_m2)


def test_of_too_many_lost_spans_the_nearest_become_one() -> None:
    one = chain(0, [0.0])
    begins_s = list(itertools.accumulate([0.0, *(10.0 + k % 7 for k in range(1023))]))
    begins_s[500:] = [begin_s - 3.0 for begin_s in begins_s[500:]]  # the one gap below nine
    for begin_s in [*begins_s[1:], begins_s[0]]:  # a clock that was set back tells the first last
        one.lose(begin_s, begin_s + 1.0)
    assert len(one.lost) == 1024
    one.lose(1e6, 1e6 + 1.0)
    assert len(one.lost) == 1024
    assert (begins_s[499], begins_s[500] + 1.0) in one.lost
    assert one.lost_m2(-1.0, begins_s[499]) == pytest.approx(499 * LOST_SIGMA_MPS**2)


def test_two_chains_walk_together_where_both_have_nodes() -> None:
    first, other = chain(0, [0.0, 10.0, 20.0, 30.0]), chain(1, [10.0, 30.0])
    record = shared_walk(first, other, 10.0, 30.0, 0.002)
    assert record is not None
    assert (record.origins, record.targets) == ((1, 100), (3, 101))
    assert record.sigma_mps**2 == pytest.approx(0.002**2 * 20.0)
    assert shared_walk(first, other, 10.0, 20.0, 0.002) is None
    assert shared_walk(first, other, 0.0, 30.0, 0.002) is None
    assert shared_walk(first, first, 10.0, 30.0, 0.002) is None
