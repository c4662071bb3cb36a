"""The time for which a base turns its wheels on one command, by speed: the driver, and the simulator's base."""

from __future__ import annotations

import pytest

from cocoro.clock import NS
from cocoro.messages import BaseCommand
from cocoro.odometry import WheelRamp
from cocoro.robot import Robot
from services.base.driver import BaseDriver
from sim.base import MobileBase

BASE = Robot.load().base
SPEEDS = [(0.5, 0.5), (0.48, 0.40), (-0.5, 0.5), (0.35, 0.35), (0.15, 0.15), (0.05, -0.05), (3.0, 3.0)]
STEP_S = 1 / 240
SAID_NS = 7 * NS


def released() -> BaseDriver:
    driver = BaseDriver(BASE)
    driver.set_latch("released")
    return driver


def command(wheels: tuple[float, float]) -> BaseCommand:
    return BASE.drive.command_of(wheels, SAID_NS)


@pytest.mark.parametrize("wheels", SPEEDS)
def test_the_driver_asks_for_wheels_no_longer_than_they_could_stand_in_time(wheels: tuple[float, float]) -> None:
    driver = released()
    driver.command(command(wheels), SAID_NS)
    left, right, for_ns = driver.wheels(SAID_NS)
    ramp_s = max(abs(left), abs(right)) / 1000.0 / BASE.wheel_acceleration_mps2
    assert for_ns / NS + ramp_s <= BASE.stand_within_s - BASE.stand_reserve_s + 1e-6
    assert for_ns / NS <= BASE.command_timeout_s
    assert driver.wheels(SAID_NS + for_ns)[:2] == (left, right)
    assert driver.wheels(SAID_NS + for_ns + 1)[:2] == (0, 0)


def test_the_faster_the_sooner() -> None:
    driver = released()
    asked = []
    for wheels in ((0.1, 0.1), (0.35, 0.35), (0.5, 0.5)):
        driver.command(command(wheels), SAID_NS)
        asked.append(driver.wheels(SAID_NS)[2])
    assert asked[0] == round(BASE.command_timeout_s * NS)
    assert asked[0] > asked[1] > asked[2] > 0.04 * NS, "two commands at least"


def test_a_word_that_was_long_on_its_way_counts_from_when_it_was_said() -> None:
    driver = released()
    driver.command(command((0.5, 0.5)), SAID_NS + NS // 20)
    assert driver.wheels(SAID_NS + NS // 20)[2] == pytest.approx((BASE.patience_s(0.5) - 0.05) * NS)


@pytest.mark.parametrize("wheels", SPEEDS)
@pytest.mark.parametrize("late_s", [0.0, 0.03])
def test_the_simulators_wheels_stand_in_time_after_the_last_word(wheels: tuple[float, float], late_s: float) -> None:
    base = MobileBase(BASE, exact=True)
    base.ramp = WheelRamp(BASE)
    base.ramp.advance(wheels, 10.0)
    assert base.ramp.fastest_mps > 0.04
    base.command(command(wheels), SAID_NS + round(late_s * NS))
    steps = 0
    while steps == 0 or any(base.ramp.wheels_mps):
        steps += 1
        base.wheels(SAID_NS + round(steps * STEP_S * NS), STEP_S)
    assert base.stopped_by == "no command"
    assert steps * STEP_S <= BASE.stand_within_s - BASE.stand_reserve_s + 2 * STEP_S
