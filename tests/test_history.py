"""A state read as history."""

from collections.abc import Iterable
from math import pi, radians
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cocoro.history import History

MS = 1_000_000


def filled(stamps_ms: Iterable[int], width: int = 1, **options: Any) -> History:
    history = History(width, **options)
    for stamp in stamps_ms:
        history.add(stamp * MS, [float(stamp)] * width)
    return history


def test_between_two_samples_the_value_is_interpolated() -> None:
    assert filled([0, 20]).at(5 * MS, 100 * MS) == pytest.approx([5.0])


def test_a_sample_of_exactly_that_stamp_is_returned_as_it_is() -> None:
    history = filled([0, 20, 900])
    assert history.at(20 * MS, 1) == pytest.approx([20.0])
    assert history.at(900 * MS, 1) == pytest.approx([900.0])


@settings(deadline=None)
@given(st.lists(st.integers(1, 50), min_size=2, max_size=30), st.data())
def test_a_linear_motion_is_read_exactly_at_any_time_within(steps: list[int], data: st.DataObject) -> None:
    stamps = np.cumsum(steps)
    history = filled([int(stamp) for stamp in stamps], width=2)
    when = data.draw(st.integers(int(stamps[0]) * MS, int(stamps[-1]) * MS))
    assert history.at(when, 60 * MS) == pytest.approx([when / MS] * 2)


def test_nothing_is_extrapolated() -> None:
    history = filled([10, 20])
    assert history.at(9 * MS, 100 * MS) is None
    assert history.at(21 * MS, 100 * MS) is None
    assert History(1).at(0, 100 * MS) is None


def test_a_gap_is_not_bridged() -> None:
    history = filled([0, 20, 220, 240])
    assert history.at(100 * MS, 150 * MS) is None
    assert history.at(100 * MS, 200 * MS) is not None
    assert history.at(230 * MS, 150 * MS) == pytest.approx([230.0])


def test_it_forgets_the_oldest_beyond_its_capacity() -> None:
    history = filled(range(0, 100, 10), capacity=4)
    assert len(history) == 4
    assert history.oldest_ns == 60 * MS
    assert history.at(55 * MS, 100 * MS) is None


def test_a_late_or_repeated_sample_is_refused_and_counted() -> None:
    history = filled([0, 20])
    assert not history.add(20 * MS, [99.0])
    assert not history.add(10 * MS, [99.0])
    assert history.refused == 2
    assert history.at(15 * MS, 100 * MS) == pytest.approx([15.0])


def test_a_restarted_publisher_empties_it() -> None:
    history = History(1)
    history.add(100 * MS, [1.0], incarnation=7)
    history.add(120 * MS, [2.0], incarnation=8)
    assert history.resets == 1
    assert len(history) == 1
    assert history.at(110 * MS, 100 * MS) is None


def test_a_clock_that_jumps_back_empties_it() -> None:
    history = filled([10_000, 10_020], jump_back_ns=500 * MS)
    assert history.add(0, [5.0])
    assert history.resets == 1
    assert history.newest is not None
    assert history.newest[0] == 0
    assert history.oldest_ns == 0


def test_an_angle_that_wraps_is_interpolated_the_short_way() -> None:
    history = History(2, angular=(0,))
    history.add(0, [radians(179), radians(179)])
    history.add(10 * MS, [radians(-179), radians(-179)])
    middle = history.at(5 * MS, 20 * MS)
    assert middle is not None
    angle, plain = middle
    assert angle == pytest.approx(pi)
    assert plain == pytest.approx(0.0)


def test_turning_on_and_on_unwraps_on_and_on() -> None:
    history = History(1, angular=(0,))
    for step in range(40):
        turn = step * 0.5
        history.add(step * MS, [(turn + pi) % (2 * pi) - pi])
    assert history.newest is not None
    assert history.newest[1] == pytest.approx([19.5])


def test_what_it_returns_is_the_readers_own() -> None:
    history = filled([0, 20])
    first = history.at(20 * MS, 1)
    assert first is not None
    first[0] = 99.0
    assert history.at(20 * MS, 1) == pytest.approx([20.0])


def test_wrong_widths_and_useless_capacities_are_refused() -> None:
    with pytest.raises(ValueError, match="a vector of 2"):
        History(2).add(0, [1.0])
    with pytest.raises(ValueError, match="cannot be interpolated"):
        History(1, capacity=1)
