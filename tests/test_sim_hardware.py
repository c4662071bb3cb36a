"""The simulated servos and base behave like the hardware, tested without the physics engine."""

from __future__ import annotations

from math import degrees, radians

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cocoro.joints import Group
from cocoro.messages import BaseCommand, ServoCommand
from cocoro.robot import Robot
from cocoro.servo_units import UNITS
from sim.base import Bumper, MobileBase
from sim.realism import Wander
from sim.seeds import stream
from sim.servos import Backlash, SimServo, SimServoGroup

ROBOT = Robot.load()
COUNT_RAD = UNITS["dynamixel"].count_rad
HZ = 240
MS = 1_000_000


# --- servos ---------------------------------------------------------------------------------------


def servo(joint: str = "elbow", angle_rad: float = 0.0, backlash_rad: float = 0.0) -> SimServo:
    return SimServo(ROBOT.joints[joint], angle_rad, backlash_rad)


def group(name: Group = "arm", backlash_deg: float = 0.0) -> SimServoGroup:
    joints = {joint: ROBOT.joints[joint] for joint in ROBOT.group_joints(name)}
    angles = dict.fromkeys(joints, 0.0)
    return SimServoGroup(joints, angles, keeps_goal=name == "hand", timeout_s=0.2, backlash_deg=backlash_deg)


def order(goal_rad: float, speed_radps: float = 1.0, joint: str = "elbow") -> ServoCommand:
    return ServoCommand(joints=(joint,), goal_rad=(goal_rad,), speed_radps=(speed_radps,))


@given(st.floats(-2.6, 2.6))
def test_goals_and_positions_come_in_counts(angle_rad: float) -> None:
    one = servo()
    one.command(angle_rad, 1.0, until_ns=0)
    one.sense(angle_rad, 0.0, 0.0, now_ns=0)
    assert abs(one.drive().target_rad - angle_rad) <= COUNT_RAD / 2 + 1e-9
    assert abs(one.position_rad - angle_rad) <= COUNT_RAD / 2 + 1e-9
    assert one.joint.to_count(one.position_rad) == one.count


def test_goals_stay_within_the_joints_limits_and_speeds_within_the_servos() -> None:
    one = servo("shoulder")
    one.command(-3.0, 100.0, until_ns=0)
    low, _ = one.joint.limits_rad
    assert one.drive().target_rad == pytest.approx(low, abs=COUNT_RAD)
    assert one.drive().max_speed_radps == one.joint.max_speed_radps
    assert one.drive().max_torque_nm == one.joint.torque_nm


def test_the_slowest_command_still_moves_and_speed_zero_holds() -> None:
    one = servo()
    one.command(1.0, 1e-6, until_ns=0)
    assert 0.0 < one.drive().max_speed_radps < 0.02
    one.sense(0.5, 1.0, 0.0, now_ns=0)
    one.command(1.0, 0.0, until_ns=0)
    assert one.drive().target_rad == pytest.approx(0.5, abs=COUNT_RAD)


def test_an_arm_joint_on_its_way_holds_when_its_command_expires() -> None:
    arm = group()
    arm.command(order(1.0), now_ns=0)
    arm.servos["elbow"].sense(0.3, 1.0, 0.0, now_ns=200 * MS)
    arm.expire(200 * MS)
    assert arm.servos["elbow"].drive().target_rad == pytest.approx(1.0, abs=COUNT_RAD)
    arm.expire(201 * MS)
    held = arm.servos["elbow"].drive().target_rad
    assert held == pytest.approx(0.3, abs=COUNT_RAD)
    # Only once: the goal does not follow the joint when something pushes it.
    arm.servos["elbow"].sense(0.2, 0.0, 0.0, now_ns=300 * MS)
    arm.expire(300 * MS)
    assert arm.servos["elbow"].drive().target_rad == pytest.approx(held)


def test_a_joint_that_is_not_named_any_more_expires_though_others_are() -> None:
    arm = group()
    arm.command(order(1.0), now_ns=0)
    arm.servos["elbow"].sense(0.3, 1.0, 0.0, now_ns=0)
    for tick in range(1, 20):
        arm.command(order(0.5, joint="neck_pan"), now_ns=tick * 20 * MS)
        arm.expire(tick * 20 * MS)
    assert arm.servos["elbow"].drive().target_rad == pytest.approx(0.3, abs=COUNT_RAD)
    assert arm.servos["neck_pan"].drive().target_rad == pytest.approx(0.5, abs=COUNT_RAD)


def test_the_hand_keeps_its_goal_when_commands_stop_and_when_stopped() -> None:
    hand = group("hand")
    hand.command(order(0.3, joint="claw_left"), now_ns=0)
    hand.servos["claw_left"].sense(0.1, 0.0, 1.0, now_ns=0)
    hand.expire(10_000 * MS)
    hand.set_latch("latched")
    goal = ROBOT.joints["claw_left"].to_angle(ROBOT.joints["claw_left"].to_count(0.3))
    assert hand.servos["claw_left"].drive().target_rad == pytest.approx(goal)


@pytest.mark.parametrize(("latch", "why"), [("latched", "estop"), ("unknown", "latch unknown")])
def test_a_stopped_arm_holds_and_refuses_and_says_why(latch: str, why: str) -> None:
    arm = group()
    arm.command(order(1.0), now_ns=0)
    arm.servos["elbow"].sense(0.3, 1.0, 0.0, now_ns=0)
    arm.set_latch(latch)  # type: ignore[arg-type]
    assert arm.servos["elbow"].drive().target_rad == pytest.approx(0.3, abs=COUNT_RAD)
    assert arm.command(order(1.0), now_ns=MS) == why
    assert arm.state(MS).stopped_by == why
    assert arm.state(MS).latch == latch
    arm.set_latch("released")
    assert arm.servos["elbow"].drive().target_rad == pytest.approx(0.3, abs=COUNT_RAD)
    assert arm.command(order(1.0), now_ns=2 * MS) == ""


def test_a_command_for_a_joint_of_another_network_is_refused_whole() -> None:
    arm = group()
    command = ServoCommand(joints=("elbow", "claw_left"), goal_rad=(1.0, 1.0), speed_radps=(1.0, 1.0))
    assert "claw_left" in arm.command(command, now_ns=0)
    assert arm.servos["elbow"].drive().target_rad == pytest.approx(0.0, abs=COUNT_RAD)


def test_pushing_at_the_limit_for_long_is_an_overload_until_it_is_reset() -> None:
    arm = group()
    elbow = arm.servos["elbow"]
    limit = elbow.joint.torque_nm
    for tick in range(51):
        elbow.sense(0.3, 0.0, -limit, now_ns=tick * 100 * MS)
    assert arm.state(0).faults == ()
    assert arm.state(0).load[arm.state(0).joints.index("elbow")] == -1.0
    elbow.sense(0.3, 0.0, -limit, now_ns=5_100 * MS)
    assert arm.state(0).faults == ("elbow: overload",)
    assert elbow.drive().max_torque_nm == limit  # what it holds up does not fall
    elbow.sense(0.3, 0.0, 0.0, now_ns=6_000 * MS)
    assert arm.state(0).faults == ("elbow: overload",)
    arm.set_latch("latched")
    arm.set_latch("released")
    assert arm.state(0).faults == ()


def test_a_moments_relief_starts_the_overload_anew_and_a_grip_is_none() -> None:
    elbow = servo()
    for tick in range(200):
        relief = tick % 40 == 39
        elbow.sense(0.3, 0.0, 0.0 if relief else elbow.joint.torque_nm, now_ns=tick * 100 * MS)
    assert not elbow.overloaded
    claw = servo("claw_left")
    for tick in range(600):
        claw.sense(0.05, 0.0, claw.joint.torque_nm, now_ns=tick * 100 * MS)
    assert not claw.overloaded


def test_a_claw_pushes_harder_the_further_it_is_from_its_goal() -> None:
    claw = servo("claw_left")
    torques = []
    for goal_deg in (0.5, 5.0, 10.0, 15.0, 40.0):
        claw.command(radians(goal_deg), 1.0, until_ns=0)
        torques.append(claw.drive().max_torque_nm)
    assert torques == sorted(torques)
    assert torques[0] == pytest.approx(0.1 * claw.joint.torque_nm)
    assert torques[2] == pytest.approx(claw.joint.torque_nm * 10.0 / claw.joint.compliance_deg, rel=0.02)
    assert torques[-1] == claw.joint.torque_nm


def test_backlash_makes_the_reading_depend_on_where_the_joint_came_from() -> None:
    play = Backlash(radians(0.5))
    up = [play.follow(radians(angle)) for angle in (0.0, 0.2, 1.0)]
    assert degrees(up[0]) == 0.0
    assert degrees(up[1]) == 0.0  # within the play
    assert degrees(up[2]) == pytest.approx(0.75)
    assert degrees(play.follow(radians(0.6))) == pytest.approx(0.75)
    assert degrees(play.follow(radians(0.0))) == pytest.approx(0.25)


@given(st.lists(st.floats(-2.0, 2.0), min_size=1, max_size=30))
def test_the_reading_is_never_further_off_than_half_the_backlash(angles_rad: list[float]) -> None:
    one = servo(backlash_rad=radians(0.5))
    for angle_rad in angles_rad:
        one.sense(angle_rad, 0.0, 0.0, now_ns=0)
        assert abs(one.position_rad - angle_rad) <= radians(0.25) + COUNT_RAD / 2 + 1e-9


def test_without_backlash_the_servo_drives_the_joint_to_its_goal_and_with_it_the_reading() -> None:
    for backlash_rad in (0.0, radians(0.5)):
        one = servo(backlash_rad=backlash_rad)
        one.command(0.5, 1.0, until_ns=0)
        angle_rad = 0.0
        for _ in range(100):
            angle_rad = min(angle_rad + 0.01, one.drive().target_rad)
            one.sense(angle_rad, 1.0, 0.0, now_ns=0)
        assert one.count == one.goal_count
        assert angle_rad - one.position_rad == pytest.approx(backlash_rad / 2, abs=1e-9)


# --- base -----------------------------------------------------------------------------------------


def run(base: MobileBase, seconds: float, command: BaseCommand | None, start_ns: int = 0) -> tuple[int, float]:
    """Drive the wheels with commands at 48 Hz. Returns the time and the largest change of speed, m/s^2."""
    steepest, before = 0.0, base.ramp.wheels_mps[0]
    for step in range(round(seconds * HZ)):
        now_ns = start_ns + step * 1_000_000_000 // HZ
        if command is not None and step % 5 == 0:
            base.command(command, now_ns)
        wheels_mps = base.wheels(now_ns, 1 / HZ)
        base.rolled([speed_mps / HZ for speed_mps in wheels_mps], now_ns, 1 / HZ)
        steepest = max(steepest, abs(wheels_mps[0] - before) * HZ)
        before = wheels_mps[0]
    return start_ns + round(seconds * 1e9), steepest


def test_wheel_speeds_are_ramped_and_clipped() -> None:
    base = MobileBase(ROBOT.base, exact=True)
    _, steepest = run(base, 1.0, ROBOT.drive.command_of((3.0, -3.0)))
    assert base.ramp.wheels_mps == (0.5, -0.5)
    assert steepest == pytest.approx(ROBOT.base.wheel_acceleration_mps2)


def test_the_base_stops_when_commands_stop() -> None:
    base = MobileBase(ROBOT.base, exact=True)
    now_ns, _ = run(base, 1.0, BaseCommand(ahead_mps=0.2, turn_radps=0.0))
    now_ns, _ = run(base, 0.7 * ROBOT.base.command_timeout_s, None, now_ns)
    assert base.ramp.wheels_mps[0] == pytest.approx(0.2)
    assert base.state(now_ns).stopped_by == ""
    now_ns, _ = run(base, 0.2, None, now_ns)
    assert base.ramp.wheels_mps[0] == 0.0
    assert base.state(now_ns).stopped_by == "no command"


def test_a_latched_base_stops_refuses_and_does_not_resume_an_old_command() -> None:
    base = MobileBase(ROBOT.base, exact=True)
    ahead = BaseCommand(ahead_mps=0.4, turn_radps=0.0)
    now_ns, _ = run(base, 1.0, ahead)
    base.set_latch("latched")
    now_ns, _ = run(base, 0.25, None, now_ns)
    assert base.ramp.wheels_mps[0] == 0.0
    assert base.command(ahead, now_ns) == "estop"
    assert base.state(now_ns).stopped_by == "estop"
    base.set_latch("released")
    now_ns, _ = run(base, 0.1, None, now_ns)
    assert base.ramp.wheels_mps[0] == 0.0


def test_a_pressed_bumper_forbids_forward_but_lets_the_base_back_off_and_turn() -> None:
    base = MobileBase(ROBOT.base, exact=True)
    base.bumper = Bumper(left=True)
    now_ns, _ = run(base, 0.5, BaseCommand(ahead_mps=0.3, turn_radps=0.0))
    assert base.ramp.wheels_mps == (0.0, 0.0)
    state = base.state(now_ns)
    assert (state.stopped_by, state.bump_left, state.bump_right) == ("bump", True, False)
    now_ns, _ = run(base, 0.5, ROBOT.drive.command_of((0.3, 0.1)), now_ns)
    assert base.ramp.wheels_mps == pytest.approx((0.1, -0.1))
    now_ns, _ = run(base, 0.5, ROBOT.drive.command_of((-0.3, -0.2)), now_ns)
    assert base.ramp.wheels_mps == pytest.approx((-0.3, -0.2))
    assert base.state(now_ns).stopped_by == ""


# --- noise ----------------------------------------------------------------------------------------


def test_noise_wanders_with_the_spread_that_it_is_given() -> None:
    noise = Wander(stream(1, "test"), 4, sigma=0.02, time_s=0.5, dt_s=1 / 60)
    values = np.array([noise.step() for _ in range(60_000)])
    assert np.abs(values.mean(axis=0)).max() < 0.002
    assert values.std(axis=0) == pytest.approx([0.02] * 4, rel=0.1)
    lag = 30  # half a second: correlated by 1 / e
    assert np.corrcoef(values[:-lag, 0], values[lag:, 0])[0, 1] == pytest.approx(0.37, abs=0.1)


def test_streams_of_one_seed_are_separate_and_repeatable() -> None:
    assert stream(5, "slip").random() == stream(5, "slip").random()
    assert stream(5, "slip").random() != stream(5, "scatter").random()
    assert stream(5, "slip").random() != stream(6, "slip").random()
