"""Servos of wheels in a robot description, and what the tools make of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from wheels_rig import lekiwi

from apps.cli.servo_bench import ServoWorkbench
from cocoro.errors import ConfigError
from cocoro.joints import ServoPlace
from cocoro.robot import Robot
from deploy import profiles
from deploy.processes import named, stoppable
from services.servos.tools import FoundServo
from sim.wire.service import WireMotors, setup_of

BUS = ("left", 7), ("back", 8), ("right", 9)


def test_the_lekiwis_wheels_are_on_the_line_of_its_arm() -> None:
    robot = lekiwi()
    assert robot.base.servo_places == tuple(ServoPlace("wheel", name, "bus", number) for name, number in BUS)
    assert robot.wheel_line == robot.line_of("arm") == "bus"
    assert Robot.load().wheel_line is None
    assert Robot.from_data(robot.to_data()).base.servo_places == robot.base.servo_places


def wheels(data: dict[str, Any]) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = data["base"]["wheel"]
    return rows


def repeat_an_id(data: dict[str, Any]) -> None:
    wheels(data)[1]["servo"]["id"] = 6


def take_a_servo_away(data: dict[str, Any]) -> None:
    wheels(data)[2]["servo"] = None


def use_two_lines(data: dict[str, Any]) -> None:
    data["network"]["base"] = data["network"]["bus"]
    wheels(data)[0]["servo"]["network"] = "base"


def speak_dynamixel(data: dict[str, Any]) -> None:
    data["network"]["bus"]["protocol"] = "dynamixel"


def lose_the_line(data: dict[str, Any]) -> None:
    wheels(data)[0]["servo"]["network"] = "buss"


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (repeat_an_id, "wheel back: 'gripper' has the ID 6 on network 'bus', too"),
        (take_a_servo_away, "wheel right has no servo, but others have"),
        (use_two_lines, "the servos of the wheels are on several networks: base, bus"),
        (speak_dynamixel, "wheel left: no wheel is driven by a servo that speaks dynamixel"),
        (lose_the_line, "wheel left: there is no network 'buss'"),
    ],
)
def test_what_cannot_be_is_named(spoil: Callable[[dict[str, Any]], None], says: str) -> None:
    data = lekiwi().to_data()
    spoil(data)
    with pytest.raises(ConfigError, match=says):
        Robot.from_data(data)


def test_a_servo_that_was_found_is_that_of_a_wheel() -> None:
    bench = ServoWorkbench(profiles.read("lekiwi-wire"), lekiwi(), {"bus": "/dev/one"}, Path("measured.toml"))
    found = FoundServo("/dev/one", 1_000_000, 8, "feetech", "STS3215", 0, 2048, 12.0, 30, (), True)
    owner = bench.owner(found)
    assert owner is not None
    assert owner.title == "wheel back"
    assert len(bench.places) == 9


def test_one_process_serves_arm_hand_and_base_and_all_three_can_be_stopped() -> None:
    component = named("servos-base")
    assert set(component.moves) == set(stoppable()) == {"arm", "hand", "base"}
    assert profiles.read("lekiwi-wire").services().count("base") == 1


def test_wheels_without_servos_are_not_emulated() -> None:
    data = lekiwi().to_data()
    for row in wheels(data):
        row["servo"] = None
    robot, motors = Robot.from_data(data), WireMotors()
    motors.wheels = {}
    with pytest.raises(ConfigError, match=r"no \[\[base.wheel\]\] has a servo"):
        setup_of(robot, motors, 0)
