"""A robot whose arm, hand and wheels are on one serial line with a name of its own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from one_line import CALLIOPE, LINE, WHEELS, its, one_line, one_line_data
from world_operator import EMPTY

from apps.cli.servo_bench import ServoWorkbench
from apps.cli.servos import _groups_of
from cocoro import topics
from cocoro.errors import ConfigError
from cocoro.joints import GROUPS
from cocoro.messages import EstopRequest, Latch, ServoCommand, ServoState
from cocoro.robot import Robot
from cocoro.servo_units import UNITS
from cocoro.testing import ServiceUnderTest, in_virtual_time
from deploy import profiles
from services.servos.service import ServosConfig
from services.servos.tools import FoundServo
from sim.wire.firmware import firmware
from sim.wire.models import servos_on_lines
from sim.wire.service import WireMotors, setup_of
from sim.world import World

ROBOT = one_line()
ELBOW, CLAW = its("elbow"), its("claw_left")
NUMBER_OF_CLAW = ROBOT.joints[CLAW].id
COUNT_RAD = UNITS["feetech"].count_rad


# --- groups and lines -----------------------------------------------------------------------------


def test_a_joints_group_is_what_it_is_for_and_its_line_is_another_matter() -> None:
    for group in GROUPS:
        assert ROBOT.group_joints(group) == tuple(map(its, CALLIOPE.group_joints(group)))
        assert ROBOT.line_of(group) == LINE
    assert ROBOT.groups_on(LINE) == ("arm", "hand")
    assert ROBOT.network_joints(LINE) == (*ROBOT.group_joints("arm"), *ROBOT.group_joints("hand"), *WHEELS)
    assert {ROBOT.joints[wheel].group for wheel in WHEELS} == {None}


def test_on_a_calliope_each_group_has_a_line_of_its_name() -> None:
    for group in GROUPS:
        assert CALLIOPE.line_of(group) == group
        assert CALLIOPE.groups_on(group) == (group,)
        assert CALLIOPE.network_joints(group) == CALLIOPE.group_joints(group)


def test_a_joint_that_moves_neither_hand_nor_camera_is_in_no_group() -> None:
    data = one_line_data()
    turning = {**next(row for row in data["link"] if row["joint"]), "name": "rim", "joint": WHEELS[0], "parent": "body"}
    data["link"].append(turning)
    data["solid"]["part"].append({**data["solid"]["part"][0], "name": "rim", "link": "rim", "mass_kg": 0.1})
    assert Robot.from_data(data).joints[WHEELS[0]].group is None


def joint(data: dict[str, Any], name: str) -> dict[str, Any]:
    row: dict[str, Any] = next(row for row in data["joint"] if row["name"] == name)
    return row


def lose_the_line(data: dict[str, Any]) -> None:
    joint(data, ELBOW)["network"] = "buss"


def repeat_an_id(data: dict[str, Any]) -> None:
    joint(data, WHEELS[1])["id"] = joint(data, ELBOW)["id"]


def add_an_idle_line(data: dict[str, Any]) -> None:
    data["network"]["spare"] = data["network"][LINE]


def name_a_line_as_none_may_be_called(data: dict[str, Any]) -> None:
    data["network"]["../bus"] = data["network"].pop(LINE)


def give_the_whole_arm_to_the_hand(data: dict[str, Any]) -> None:
    data["claw"]["open_sign"] = {name: 1.0 for name, row in ROBOT.joints.items() if row.group is not None}


def give_a_joint_of_the_arm_to_the_hand(data: dict[str, Any]) -> None:
    data["claw"]["open_sign"][ELBOW] = 1.0


def spread_a_group_over_two_lines(data: dict[str, Any]) -> None:
    data["network"]["second"] = data["network"][LINE]
    joint(data, ELBOW)["network"] = "second"


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lose_the_line, f"joint {ELBOW}: there is no network 'buss'"),
        (repeat_an_id, f"joint {WHEELS[1]}: '{ELBOW}' has the ID 5 on network 'bus', too"),
        (add_an_idle_line, "network spare: no joint is on it"),
        (name_a_line_as_none_may_be_called, "matching regex"),
        (give_the_whole_arm_to_the_hand, "no joint is in the group 'arm'"),
        (give_a_joint_of_the_arm_to_the_hand, f"arm: the joint '{ELBOW}' is not between the body and the hand"),
        (spread_a_group_over_two_lines, "the joints of the group 'arm' are on several networks: bus, second"),
    ],
)
def test_what_contradicts_itself_is_named(spoil: Callable[[dict[str, Any]], None], says: str) -> None:
    data = one_line_data()
    spoil(data)
    with pytest.raises(ConfigError, match=says):
        Robot.from_data(data)


def test_servos_on_two_lines_may_have_one_id_but_are_not_emulated() -> None:
    data = one_line_data()
    data["network"]["base"] = data["network"][LINE]
    for number, wheel in enumerate(WHEELS):
        joint(data, wheel).update(network="base", id=1 + number)
    robot = Robot.from_data(data)
    assert robot.network_joints("base") == WHEELS
    assert robot.groups_on("base") == ()
    with pytest.raises(ConfigError, match=f"joints {its('neck_pan')} and {WHEELS[0]} have the ID 1"):
        servos_on_lines(robot)


def test_a_line_called_as_what_stands_beside_its_port_is_not_emulated() -> None:
    data = one_line_data()
    data["network"]["create"] = data["network"].pop(LINE)
    for row in data["joint"]:
        row["network"] = "create"
    with pytest.raises(ConfigError, match="network create: no line of this name can be emulated"):
        servos_on_lines(Robot.from_data(data))


# --- settings and commands ------------------------------------------------------------------------


def test_a_lines_port_is_found_by_its_name() -> None:
    assert ServosConfig().port_of(LINE) == "/dev/cocoro-bus"
    assert profiles.read("sim-wire").config("servos", ServosConfig).port_of(LINE) == "wire:bus"
    assert ServosConfig(port="wire:{line}", ports={LINE: "/dev/ttyACM0"}).port_of(LINE) == "/dev/ttyACM0"


def test_the_former_names_of_the_ports_still_count() -> None:
    former = ServosConfig(arm_port="/dev/ttyUSB0", ports={"hand": "/dev/ttyUSB1"}, hand_port="/dev/ttyUSB2")
    assert [former.port_of(line) for line in ("arm", "hand")] == ["/dev/ttyUSB0", "/dev/ttyUSB1"]


@pytest.mark.parametrize(
    ("config", "says"),
    [
        (ServosConfig(ports={"buss": "/dev/ttyACM0"}), "ports: the robot has no line 'buss'; known are bus; did you"),
        (ServosConfig(arm_port="/dev/ttyACM0"), "ports: the robot has no line 'arm'; known are bus"),
        (ServosConfig(torque={"claw": 0.4}), "torque: the robot has no joint 'claw'; known are"),
    ],
)
def test_settings_for_what_the_robot_does_not_have_are_refused(config: ServosConfig, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        config.check(ROBOT)


def test_requests_go_to_the_groups_of_the_joints() -> None:
    assert _groups_of([], ROBOT) == {"arm": [], "hand": []}
    assert _groups_of([CLAW, ELBOW], ROBOT) == {"arm": [ELBOW], "hand": [CLAW]}
    with pytest.raises(ConfigError, match=f"{WHEELS[0]} is no joint of arm or hand"):
        _groups_of([WHEELS[0]], ROBOT)


def test_of_two_joints_with_one_id_a_found_servo_is_that_of_the_line_at_its_port() -> None:
    data = one_line_data()
    data["network"]["base"] = data["network"][LINE]
    joint(data, WHEELS[0]).update(network="base", id=joint(data, ELBOW)["id"])
    ports = {LINE: "/dev/one", "base": "/dev/other"}
    bench = ServoWorkbench(profiles.read("robot"), Robot.from_data(data), ports, Path("measured.toml"))

    def owner(port: str, number: int) -> str | None:
        one = bench.owner(FoundServo(port, 1_000_000, number, "feetech", "STS3215", 0, 2048, 12.0, 30, (), False))
        return one.name if one is not None else None

    assert [owner(port, 5) for port in (*ports.values(), "/dev/third")] == [ELBOW, WHEELS[0], None]
    assert owner("/dev/third", NUMBER_OF_CLAW) == CLAW
    assert owner("/dev/one", 99) is None


# --- the simulator --------------------------------------------------------------------------------


def angle(state: ServoState, name: str) -> float:
    return state.position_rad[state.joints.index(name)]


@pytest.mark.sim
@in_virtual_time
async def test_the_simulated_robot_obeys_and_reports_by_groups() -> None:
    async def command(seconds: float, elbow_rad: float, claw_rad: float) -> None:
        for _ in range(round(seconds * 50)):
            for topic, name, goal_rad in (
                (topics.ARM_COMMAND, ELBOW, elbow_rad),
                (topics.HAND_COMMAND, CLAW, claw_rad),
            ):
                sim.feed(topic, ServoCommand(joints=(name,), goal_rad=(goal_rad,), speed_radps=(1.0,)))
            await sim.advance(0.02)

    settings = {"width": 16, "height": 16, "frame_rate_hz": 1.0}
    async with ServiceUnderTest("sim.service", settings, robot=ROBOT) as sim:
        sim.feed(topics.LATCH, Latch(state="released"))
        await sim.advance(0.1)
        begun = sim.latest(topics.ARM_STATE), sim.latest(topics.HAND_STATE)
        assert [state.joints for state in begun] == [ROBOT.group_joints(group) for group in GROUPS]
        await command(1.5, angle(begun[0], ELBOW) + 0.3, -0.4)
        arm, hand = sim.latest(topics.ARM_STATE), sim.latest(topics.HAND_STATE)
        assert angle(arm, ELBOW) - angle(begun[0], ELBOW) == pytest.approx(0.3, abs=0.03)
        assert angle(hand, CLAW) == pytest.approx(-0.4, abs=0.03)
        assert angle(arm, ELBOW) / COUNT_RAD == pytest.approx(round(angle(arm, ELBOW) / COUNT_RAD))

        await sim.ask(topics.ESTOP.of("arm"), EstopRequest(by="test"))
        await command(1.0, angle(begun[0], ELBOW), 0.0)
        assert sim.latest(topics.ARM_STATE).stopped_by == "estop"
        assert sim.latest(topics.HAND_STATE).stopped_by == ""
        assert angle(sim.latest(topics.ARM_STATE), ELBOW) == pytest.approx(angle(arm, ELBOW), abs=0.02)
        assert angle(sim.latest(topics.HAND_STATE), CLAW) == pytest.approx(0.0, abs=0.03)


@pytest.mark.sim
def test_behind_wires_one_bus_carries_the_servos_of_all_groups() -> None:
    motors = WireMotors()
    with World(ROBOT, EMPTY, motors=motors.make):
        _, lines = firmware(setup_of(ROBOT, motors, seed=3))
    assert {line: [servo.number for servo in bus.servos] for line, bus in lines.items()} == {LINE: [*range(1, 10)]}
    assert lines[LINE].by_number(5).get(56) == motors.servos[5].count
