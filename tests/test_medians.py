"""The median and the quantiles that stand in for NumPy's."""

from __future__ import annotations

import numpy as np
import pytest

from cocoro.arrays import median
from cocoro.health import quantile


@pytest.mark.parametrize("count", [1, 2, 3, 10, 101])
def test_a_median_is_that_of_numpy_to_the_bit(count: int) -> None:
    numbers = np.random.default_rng(count).normal(2.0, 1.0, (count, 3))
    assert median(numbers) == np.median(numbers)
    assert median(numbers.astype(np.float32)) == np.median(numbers.astype(np.float32))


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99, 1.0])
@pytest.mark.parametrize("count", [1, 2, 7, 120])
def test_a_quantile_is_that_of_numpy(count: int, share: float) -> None:
    numbers = np.random.default_rng(count).normal(20.0, 1.0, count)
    assert quantile(sorted(numbers.tolist()), share) == pytest.approx(np.quantile(numbers, share))


def test_the_quantile_of_nothing_is_zero() -> None:
    assert quantile([], 0.5) == 0.0
