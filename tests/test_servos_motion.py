"""The motion of a joint to its goal, and the core of a servo network, without a wire."""

from __future__ import annotations

from math import radians
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cocoro.clock import NS
from cocoro.joints import Group, Joint
from cocoro.messages import ServoCommand
from cocoro.robot import Robot
from cocoro.servo_units import UNITS, Protocol
from services.servos.dynamixel import DYNAMIXEL
from services.servos.families import FAMILIES
from services.servos.family import ServoFamily, ServoReading
from services.servos.feetech import FEETECH
from services.servos.group import ServoGroup
from services.servos.motion import LEAD_S, REACH_RAD, JointMotion
from services.servos.watch import MISSES, ServoStatus, ServoTask

ROBOT = Robot.load()
MS = 1_000_000
families = pytest.mark.parametrize("family", FAMILIES.values(), ids=FAMILIES)
ELBOW, SHOULDER, WRIST = (ROBOT.joints[name] for name in ("elbow", "shoulder", "wrist_pitch"))
COUNT = UNITS["dynamixel"].count_rad


class Led:
    """A joint whose servo gets orders 50 times a second."""

    def __init__(self, joint: Joint = ELBOW, *, keeps_goal: bool = False, blocked_at_rad: float = 10.0) -> None:
        self.motion = JointMotion(joint, keeps_goal=keeps_goal)
        self.position_rad = 0.0
        self.now_ns = NS
        self.blocked_at_rad = blocked_at_rad
        self.goals: list[float] = []
        self.speeds: list[int] = []
        self.motion.hold(0.0)

    def command(self, goal_rad: float, speed_radps: float, for_ms: int = 200) -> None:
        self.motion.command(goal_rad, speed_radps, self.position_rad, self.now_ns + for_ms * MS)

    def run(self, seconds: float, dead: bool = False) -> None:
        """`dead`: the servo gets no more orders, and goes on to its last goal."""
        for _ in range(round(seconds * 50)):
            if not dead:
                order = self.motion.order(self.position_rad, self.now_ns)
                assert order is not None
                self.goals.append(self.motion.joint.to_angle(order[0]))
                self.speeds.append(order[1])
            self.now_ns += 20 * MS
            step = self.speeds[-1] * self.motion.joint.units.speed_radps / 50
            left = self.goals[-1] - self.position_rad
            self.position_rad += min(max(left, -step), step)
            self.position_rad = min(self.position_rad, self.blocked_at_rad)


@pytest.mark.parametrize("protocol", UNITS)
def test_a_joint_goes_to_its_goal_at_the_speed_that_was_commanded(protocol: Protocol) -> None:
    led = Led(ROBOT.with_networks(protocol=protocol).joints["elbow"])
    led.command(1.0, 0.5, for_ms=10_000)
    led.run(1.0)
    assert led.position_rad == pytest.approx(0.5, abs=0.02)
    led.run(1.2)
    assert led.position_rad == pytest.approx(1.0, abs=COUNT)


@given(st.floats(-3, 3), st.floats(0.05, 6.0))
def test_whoever_tells_a_servo_may_die_and_it_stops_soon_by_itself(goal_rad: float, speed_radps: float) -> None:
    led = Led()
    led.command(goal_rad, speed_radps, for_ms=10_000)
    led.run(0.4)
    at_rad = led.position_rad
    led.run(5.0, dead=True)
    assert abs(led.position_rad - at_rad) <= speed_radps * (LEAD_S + 0.04) * 1.1 + 2 * COUNT


def test_zero_is_a_position_and_never_a_speed() -> None:
    led = Led()
    led.command(1.0, 0.5, for_ms=10_000)
    led.run(0.5)
    at_rad = led.position_rad
    led.command(1.0, 0.0)
    led.run(1.0)
    assert led.position_rad == pytest.approx(at_rad, abs=0.02)
    led.command(1.0, 1e-9)
    led.run(0.5)
    assert min(led.speeds) >= 1


def test_a_held_joint_that_is_told_to_stand_still_does_not_follow_who_pushes_it() -> None:
    led = Led()
    led.command(0.5, 1.0)
    led.command(0.5, 0.0)
    led.run(0.1)
    led.position_rad = -0.1
    led.command(0.5, 0.0)
    led.run(0.5)
    assert led.goals[-1] == pytest.approx(0.0, abs=COUNT)


def test_a_command_that_expires_on_the_way_holds_there_and_one_that_has_arrived_stays() -> None:
    led = Led()
    led.command(1.0, 1.0, for_ms=200)
    led.run(2.0)
    assert 0.15 < led.position_rad < 0.45
    led.command(0.5, 1.0, for_ms=2000)
    led.run(3.0)
    assert led.goals[-1] == pytest.approx(0.5, abs=COUNT)


def test_the_hand_keeps_its_goal() -> None:
    led = Led(ROBOT.joints["claw_left"], keeps_goal=True)
    led.command(0.5, 1.0, for_ms=200)
    led.run(2.0)
    assert led.position_rad == pytest.approx(0.5, abs=COUNT)


def test_a_blocked_joint_pushes_with_all_it_may_and_does_not_leap_when_it_is_free() -> None:
    led = Led(blocked_at_rad=0.2)
    led.command(2.0, 1.0, for_ms=60_000)
    led.run(5.0)
    assert led.goals[-1] - led.position_rad > 18.8 * 0.0174533  # beyond the softest slope
    assert led.goals[-1] - led.position_rad < REACH_RAD + LEAD_S * 1.0 + COUNT
    led.blocked_at_rad = 10.0
    led.run(0.5)
    assert led.position_rad == pytest.approx(0.7, abs=0.05)  # at the speed that was commanded


def test_goals_stay_within_the_limits_and_speeds_within_the_servos() -> None:
    led = Led(SHOULDER)
    led.command(-3.0, 100.0, for_ms=10_000)
    led.run(2.0)
    assert led.position_rad == pytest.approx(SHOULDER.limits_rad[0], abs=COUNT)
    assert max(led.speeds) == round(SHOULDER.max_speed_radps / DYNAMIXEL.units.speed_radps)


# --- groups ----------------------------------------------------------------------------------------


def reading(position: int = 512, *, error: int = 0, temperature_c: int = 40, voltage_v: float = 12.0) -> ServoReading:
    return ServoReading(position, 0, 0, voltage_v, temperature_c, error, 0)


class Net:
    """A group of servos that answer; times are in ms."""

    def __init__(self, name: Group = "arm", protocol: Protocol = "dynamixel") -> None:
        robot = ROBOT.with_networks(protocol=protocol)
        joints = [robot.joints[joint] for joint in robot.group_joints(name)]
        self.net = ServoGroup(joints, FAMILIES[protocol], keeps_goal=name == "hand", timeout_s=0.2, max_age_s=0.15)
        self.net.port_fault = ""
        self.now_ns = NS
        self.tasks: list[ServoTask] = []

    def cycle(self, ms: int = 20, **errors: int) -> None:
        """Read all servos and do all tasks."""
        self.now_ns += ms * MS
        for number, one in self.net.joints.items():
            self.net.read(number, reading(error=errors.get(one.joint.name, 0)), self.now_ns)
        while (task := self.net.next_task()) is not None:
            self.tasks.append(task)
            if task.action == "inspect":
                self.net.inspected(
                    task.number, ServoStatus(torque_enabled=False, goal=512, position=512, error=0), self.now_ns
                )
            else:
                self.net.done(task, 512, self.now_ns)

    def faults(self) -> str:
        return "; ".join(self.net.faults(self.now_ns))

    def command(self, age_ms: int = 0, **goals: float) -> str:
        command = ServoCommand(joints=tuple(goals), goal_rad=tuple(goals.values()), speed_radps=(1.0,) * len(goals))
        command.stamp_ns = self.now_ns - age_ms * MS
        return self.net.command(command, self.now_ns)


@pytest.fixture
def arm() -> Net:
    """A group whose servos were inspected, released and enabled."""
    arm = Net()
    arm.cycle()
    arm.net.set_latch("released")
    arm.cycle()
    arm.cycle(1000)
    return arm


def test_nothing_is_made_to_hold_before_the_emergency_stops_state_is_known() -> None:
    arm = Net()
    arm.cycle()
    arm.cycle()
    assert {task.action for task in arm.tasks} == {"inspect"}
    assert arm.net.orders(arm.now_ns) == {}
    arm.net.set_latch("released")
    arm.cycle()
    assert [task.action for task in arm.tasks].count("enable") == 6
    assert set(arm.net.orders(arm.now_ns)) == {1, 2, 3, 4, 5, 6}


def test_a_servo_that_holds_already_goes_on_holding_what_it_holds() -> None:
    hand = Net("hand")
    hand.net.read(8, reading(500), hand.now_ns)
    hand.net.inspected(8, ServoStatus(torque_enabled=True, goal=600, position=500, error=0), hand.now_ns)
    assert hand.net.orders(hand.now_ns)[8][0] == pytest.approx(600, abs=20)
    arm = Net()
    arm.net.read(5, reading(500), arm.now_ns)
    arm.net.inspected(5, ServoStatus(torque_enabled=True, goal=600, position=500, error=0), arm.now_ns)
    assert arm.net.orders(arm.now_ns)[5][0] == 500


def test_commands_are_taken_whole_or_not_at_all(arm: Net) -> None:
    assert "claw_left" in arm.command(elbow=1.0, claw_left=1.0)
    assert arm.command(age_ms=500, elbow=1.0) == "too old"
    assert arm.net.orders(arm.now_ns)[5][0] == 512
    assert arm.command(elbow=1.0) == ""
    assert arm.net.orders(arm.now_ns)[5][0] > 512


@pytest.mark.parametrize(("latch", "why"), [("latched", "estop"), ("unknown", "latch unknown")])
def test_a_stopped_arm_holds_and_refuses_and_says_why(arm: Net, latch: str, why: str) -> None:
    arm.command(elbow=1.0)
    arm.net.set_latch(latch)  # type: ignore[arg-type]
    assert arm.net.orders(arm.now_ns)[5][0] == 512
    assert arm.command(elbow=1.0) == why
    state = arm.net.state(arm.now_ns)
    assert state is not None
    assert (state.latch, state.stopped_by) == (latch, why)


def test_an_overload_latches_and_is_cleared_on_purpose(arm: Net) -> None:
    arm.cycle(elbow=0x20)
    assert arm.net.latched_faults() == ("elbow: overload",)
    arm.cycle()
    assert arm.net.latched_faults() == ("elbow: overload",)
    assert 5 not in arm.net.orders(arm.now_ns)
    arm.command(elbow=1.0, shoulder=1.0)
    assert set(arm.net.orders(arm.now_ns)) == {1, 2, 3, 4, 6}
    assert arm.net.clear(()) == ["elbow"]
    arm.cycle(elbow=0x20)  # it still speaks of it while it is made to hold
    assert arm.net.latched_faults() == ()
    assert 5 in arm.net.orders(arm.now_ns)
    arm.cycle(1000, elbow=0x20)
    assert arm.net.latched_faults() == ("elbow: overload",)


def test_a_reset_of_the_emergency_stop_clears_the_overloads(arm: Net) -> None:
    arm.cycle(elbow=0x24)
    assert arm.net.latched_faults() == ("elbow: overheating and overload",)
    arm.net.set_latch("latched")
    arm.net.set_latch("released")
    assert arm.net.latched_faults() == ()


def test_a_servo_that_was_shut_down_before_the_service_started_is_a_fault_too() -> None:
    arm = Net()
    arm.net.set_latch("released")
    arm.net.read(5, reading(error=0x20), arm.now_ns)
    arm.net.inspected(5, ServoStatus(torque_enabled=False, goal=512, position=512, error=0x20), arm.now_ns)
    assert arm.net.latched_faults() == ("elbow: overload",)
    assert arm.net.next_task() == ServoTask("inspect", 5)
    assert arm.net.next_task() is None


def test_a_servo_that_lost_its_settings_gets_them_again_and_it_is_told(arm: Net) -> None:
    arm.net.checked(5, as_set=True, now_ns=arm.now_ns)
    assert arm.net.next_task() is None
    arm.net.checked(5, as_set=False, now_ns=arm.now_ns)
    assert arm.net.next_task() == ServoTask("enable", 5)
    assert "elbow lost its settings" in arm.faults()
    assert arm.net.latched_faults() == ()


def test_a_servo_that_shuts_down_just_after_it_was_enabled_is_not_taken_for_one_that_lost_its_settings(
    arm: Net,
) -> None:
    arm.net.done(ServoTask("enable", 5), 512, arm.now_ns)
    arm.cycle(elbow=0x20)  # not believed so soon: it may be the word of the last shutdown
    assert arm.net.latched_faults() == ()
    arm.net.checked(5, as_set=False, now_ns=arm.now_ns)  # but that its torque is gone is
    assert arm.net.latched_faults() == ("elbow: overload",)
    assert arm.net.next_task() is None


def test_a_silent_servo_is_left_out_and_named_and_the_others_go_on(arm: Net) -> None:
    for _ in range(MISSES):
        arm.net.missed(5)
    state = arm.net.state(arm.now_ns)
    assert state is not None
    assert "elbow" not in state.joints
    assert len(state.joints) == 5
    assert arm.faults() == "elbow (ID 5) does not answer"
    assert set(arm.net.orders(arm.now_ns)) == {1, 2, 3, 4, 6}
    arm.cycle()  # back, and met again, since nobody knows what happened to it: its torque is off
    arm.cycle()
    assert arm.faults().startswith("elbow lost its settings a moment ago")
    assert 5 in arm.net.orders(arm.now_ns)


def test_a_servo_that_was_silent_and_has_held_all_the_while_is_nothing_to_tell_of(arm: Net) -> None:
    for _ in range(MISSES):
        arm.net.missed(5)
    arm.net.read(5, reading(), arm.now_ns)
    arm.net.inspected(5, ServoStatus(torque_enabled=True, goal=512, position=512, error=0), arm.now_ns)
    assert arm.faults() == ""
    assert 5 in arm.net.orders(arm.now_ns)


def test_one_missed_answer_is_no_gap_in_the_state(arm: Net) -> None:
    arm.net.missed(5)
    state = arm.net.state(arm.now_ns + 20 * MS)
    assert state is not None
    assert "elbow" in state.joints
    assert arm.net.state(arm.now_ns + 500 * MS) is None


def test_a_limp_joint_stays_limp_until_it_is_told_to_hold(arm: Net) -> None:
    assert arm.net.relax(["elbow", "shoulder"]) == ["elbow", "shoulder"]
    arm.cycle()
    arm.net.set_latch("latched")
    arm.net.set_latch("released")
    arm.cycle()
    assert arm.command(elbow=1.0) == ""
    assert {4, 5}.isdisjoint(arm.net.orders(arm.now_ns))
    assert "elbow is limp; `cocoro servos hold`" in arm.faults()
    arm.net.hold(["elbow"])
    arm.cycle()
    assert arm.net.orders(arm.now_ns)[5][0] == 512


@pytest.mark.parametrize(("protocol", "bad_v"), [("dynamixel", 8.2), ("feetech", 15.0)])
def test_heat_and_voltage_are_told(protocol: Protocol, bad_v: float) -> None:
    arm = Net(protocol=protocol)
    arm.net.read(5, reading(temperature_c=66, voltage_v=bad_v), arm.now_ns)
    faults = arm.faults()
    assert "elbow is hot: 66 C" in faults
    assert f"elbow has a bad voltage: {bad_v} V" in faults


def test_without_its_port_a_network_is_silent_and_says_why(arm: Net) -> None:
    arm.net.port_lost("/dev/arm: gone")
    assert arm.faults() == "/dev/arm: gone"
    assert arm.net.state(arm.now_ns) is None
    assert arm.net.orders(arm.now_ns) == {}


def test_a_clock_that_begins_anew_ends_what_was_commanded(arm: Net) -> None:
    arm.command(elbow=1.0)
    arm.net.new_epoch()
    arm.now_ns = 5 * MS
    arm.cycle(1)
    assert arm.net.orders(arm.now_ns)[5][0] == 512


def test_a_command_is_refused_by_the_age_of_its_own_topic() -> None:
    joint = ROBOT.joints["wrist_roll"]
    for max_age_s, answer in ((0.05, "too old"), (0.15, "")):
        net = ServoGroup([joint], DYNAMIXEL, keeps_goal=True, timeout_s=0.2, max_age_s=max_age_s)
        net.set_latch("released")
        command = ServoCommand(stamp_ns=NS, joints=(joint.name,), goal_rad=(0.1,), speed_radps=(1.0,))
        assert net.command(command, NS + 100 * MS) == answer


def test_measured_joint_limits_are_what_the_servo_line_keeps(tmp_path: Path) -> None:
    own = tmp_path / "own.toml"
    own.write_text('[[joint]]\nname = "elbow"\nlimits_deg = [-20.0, 10.0]\n')
    joint = Robot.load(override=own).joints["elbow"]
    motion = JointMotion(joint, keeps_goal=False)
    motion.command(1.0, 6.0, 0.0, until_ns=10 * NS)
    orders = [motion.order(0.17, now_ns) for now_ns in range(NS, 3 * NS, 20 * MS)]
    assert max(order[0] for order in orders if order is not None) == joint.to_count(radians(10.0))


@families
def test_direction_and_centre_of_a_joint_are_its_own_and_units_its_familys(family: ServoFamily) -> None:
    units = family.units
    joint = Joint("elbow", "arm", 5, (-150.0, 150.0), 2.5, 6.0, direction=-1, centre_count=600.0, units=units)
    net = ServoGroup([joint], family, keeps_goal=False, timeout_s=0.2, max_age_s=0.15)
    net.read(5, ServoReading(500, 10, 100, 12.0, 40, 0, 0), NS)
    state = net.state(NS)
    assert state is not None
    assert state.position_rad[0] == pytest.approx(100 * units.count_rad)
    assert state.speed_radps[0] == pytest.approx(-10 * units.speed_radps)
    assert state.load[0] == pytest.approx(-100 / units.full_torque)


@pytest.mark.parametrize("error", [0x02, 0x04, 0x08, 0x20])
def test_each_word_of_a_feetech_that_it_does_not_hold_is_a_fault_and_its_voltage_is_none(error: int) -> None:
    arm = Net(protocol="feetech")
    arm.net.set_latch("released")
    arm.cycle()
    arm.cycle()
    arm.cycle(1000, elbow=0x01)
    assert arm.net.latched_faults() == ()
    arm.cycle(elbow=error | 0x01)
    assert arm.net.latched_faults() == (f"elbow: {FEETECH.errors[error]}",)
    assert 5 not in arm.net.orders(arm.now_ns)
