"""The floor that the bench of decoupling compares with."""

from __future__ import annotations

import pytest

from bench.decoupling import ideal_off_m


def test_a_robot_without_limits_is_off_by_what_it_cannot_know() -> None:
    at_once, slow, slower = (ideal_off_m(time_s) for time_s in (0.005, 0.5, 1.0))
    assert at_once < 0.002
    assert slower == pytest.approx(2 * slow, rel=0.1)
    # At a corner it goes on for 0.5 to 1 s at 0.25 m/s, about every 8 s.
    assert 0.02 < slow < 0.25 * 1.0 * (1.0 / 8.0) ** 0.5
