"""The covariance's factor in the covariance's own memory."""

import numpy as np
import pytest

from firmware.compression.decoder import factorised
from protocol.errors import EstimationError


@pytest.mark.parametrize("count", [1, 2, 40])
def test_factor_in_place_is_that_of_a_copy(count: int) -> None:
    wide = np.random.default_rng(1).normal(size=(count, count + 3))
    k = wide @ wide.T
    lower, nugget, failed = factorised(k.copy(), 1e-6, use_up=True)
    np.testing.assert_array_equal(lower, factorised(k, 1e-6)[0])
    lower = np.tril(lower)
    np.testing.assert_allclose(lower @ lower.T, k + nugget * np.eye(count), rtol=1e-12, atol=1e-12)
    assert failed == 0


def test_every_failed_factorisation_is_counted_and_leaves_the_next_one_whole() -> None:
    k = np.ones((30, 30)) - 2e-3 * np.eye(30)  # indefinite until the nugget reaches 1e-2
    lower, nugget, failed = factorised(k.copy(), 1e-4, use_up=True)
    assert nugget == pytest.approx(1e-2)
    assert failed == 2
    lower = np.tril(lower)
    np.testing.assert_allclose(lower @ lower.T, k + nugget * np.eye(30), atol=1e-12)


def test_what_no_nugget_makes_definite_is_told() -> None:
    with pytest.raises(EstimationError, match="singular"):
        factorised(np.full((3, 3), np.nan), 1e-4, use_up=True)
