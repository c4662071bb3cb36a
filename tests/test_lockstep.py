"""The baseline in lock-step is tuned for its cycle, so that the comparison with it is fair."""

from __future__ import annotations

from math import pi

import pytest

from apps.rehearsal.lockstep import MOST_SHARE, LockstepDriver
from cocoro.robot import Robot
from services.planning.config import NavigationConfig
from services.planning.navigation import Driver, Offset


@pytest.mark.parametrize("cycle_s", [0.3, 0.5, 1.0])
@pytest.mark.parametrize("heading_rad", [-1.5, 0.4, 0.1])
def test_it_turns_no_further_in_a_cycle_than_is_left(cycle_s: float, heading_rad: float) -> None:
    driver = LockstepDriver(NavigationConfig(), Robot.load().base)
    driver.cycle_s = cycle_s
    left = heading_rad
    for _ in range(20):
        _, turn = driver.law(Offset(0.0, left))
        assert abs(turn * cycle_s) <= MOST_SHARE * abs(left) + 1e-9
        left -= turn * cycle_s
    assert abs(left) < 0.05


@pytest.mark.parametrize("cycle_s", [0.3, 1.0])
def test_it_drives_no_further_in_a_cycle_than_is_left(cycle_s: float) -> None:
    driver = LockstepDriver(NavigationConfig(), Robot.load().base)
    driver.cycle_s = cycle_s
    speed, _ = driver.law(Offset(0.1, 0.0))
    assert 0.0 < speed * cycle_s <= 0.1


def test_with_a_short_cycle_it_drives_as_the_mesh_does() -> None:
    base, offset = Robot.load().base, Offset(1.0, pi / 8)
    driver = LockstepDriver(NavigationConfig(), base)
    driver.cycle_s = 0.02
    assert driver.law(offset) == Driver(NavigationConfig(), base).law(offset)
