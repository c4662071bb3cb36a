"""A base with two wheels: the body's speeds and those of its wheels, and what such a base does not do."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cocoro.capture.former import todays_payload
from cocoro.clock import NS
from cocoro.messages import BaseCommand
from cocoro.robot import Robot
from services.base.driver import BaseDriver
from sim.base import MobileBase

BASE = Robot.load().base
SPEEDS = st.floats(-0.5, 0.5)


@given(left=SPEEDS, right=SPEEDS)
def test_the_wheels_of_the_command_of_two_wheels_are_these(left: float, right: float) -> None:
    command = BASE.drive.command_of((left, right))
    assert BASE.drive.wheels_of(command) == pytest.approx((left, right), abs=1e-15)
    assert BASE.drive.fastest_mps(command) == pytest.approx(max(abs(left), abs(right)), abs=1e-15)


def test_ahead_turns_both_wheels_alike_and_to_the_left_the_right_one_more() -> None:
    assert BASE.drive.wheels_of(BaseCommand(ahead_mps=0.2, turn_radps=0.0)) == (0.2, 0.2)
    left, right = BASE.drive.wheels_of(BaseCommand(ahead_mps=0.0, turn_radps=1.0))
    assert (left, right) == pytest.approx((-BASE.axle_m / 2, BASE.axle_m / 2))


ASIDE = BaseCommand(ahead_mps=0.2, turn_radps=0.0, aside_mps=0.1, stamp_ns=NS)


def test_a_base_that_cannot_move_aside_does_nothing_of_such_a_command() -> None:
    with pytest.raises(ValueError, match=r"cannot move aside, as commanded with \+0.100 m/s"):
        BASE.drive.wheels_of(ASIDE)
    simulated = MobileBase(BASE, exact=True)
    assert "cannot move aside" in simulated.command(ASIDE, NS)
    assert simulated.wheels(NS, 0.02) == (0.0, 0.0)
    driver = BaseDriver(BASE)
    driver.set_latch("released")
    driver.command(ASIDE, NS)
    assert driver.wheels(NS)[:2] == (0, 0)


def test_a_recorded_command_of_two_wheels_is_read_as_the_bodys_speeds() -> None:
    former = msgspec.msgpack.encode({"left_mps": 0.1, "right_mps": 0.2, "stamp_ns": 5, "seq": 7})
    today = msgspec.msgpack.decode(todays_payload("BaseCommand", former), type=BaseCommand)
    assert BASE.drive.wheels_of(today) == pytest.approx((0.1, 0.2))
    assert (today.stamp_ns, today.seq) == (5, 7)
    assert todays_payload("BaseCommand", msgspec.msgpack.encode(today)) == msgspec.msgpack.encode(today)
