"""The arm over a slow link: states and commands are late, and joints stop where their last command has expired."""

from __future__ import annotations

import random
from collections import deque
from typing import Any, NamedTuple

import numpy as np
import pytest

from cocoro.clock import NS
from cocoro.robot import Robot
from services.planning.arm import ArmController, ArmStep
from services.planning.clearance import Clearance
from services.planning.config import PlanningConfig
from services.planning.reach import HandPose, Reacher
from sim.servos import SimServoGroup

ROBOT = Robot.load()
ARM, ROLL = ROBOT.arm.joints, ROBOT.arm.roll
CONFIG = PlanningConfig()
REACHER = Reacher(ROBOT, CONFIG.arm.damping)
CLEARANCE = Clearance(ROBOT)
TICK_S = 0.02
PHYSICS = 5
"""Steps of the joints in one of the planner's."""
MOST_AGE_S = 0.15
"""Of states and commands."""
SERVO_S = 0.03
"""Time constant of a joint near its goal."""
CLAWS_OPEN = {claw: sign * CONFIG.hand.open_rad for claw, sign in ROBOT.claw.open_sign.items()}
PARKED = dict.fromkeys(ROBOT.joints, 0.0) | ROBOT.poses["park"] | CLAWS_OPEN
BEHIND = HandPose(0.37, 0.1, 0.06, CONFIG.arm.pitch_rad)
WAY = (
    (BEHIND, CONFIG.arm.hand_speed_mps),
    (BEHIND._replace(radius_m=0.49), CONFIG.arm.insert_speed_mps),
    (BEHIND._replace(radius_m=0.38, height_m=0.23), CONFIG.arm.lift_speed_mps),
)
"""A grasp: behind the target, around it, and up."""


class OneWay:
    """One direction of a link, as TCP makes it: what was sent after a lost packet waits until that was sent again."""

    def __init__(self, delay_s: float, loss: float, rng: random.Random) -> None:
        self._delay_s, self._loss, self._rng = delay_s, loss, rng
        self._due_s = 0.0
        self._under_way: deque[tuple[float, Any]] = deque()

    def send(self, now_s: float, message: Any) -> None:
        way_s = self._delay_s
        while self._rng.random() < self._loss:
            way_s += 2 * self._delay_s + TICK_S
        self._due_s = max(self._due_s, now_s + way_s)
        self._under_way.append((self._due_s, message))

    def arrived(self, now_s: float) -> list[Any]:
        messages = []
        while self._under_way and self._under_way[0][0] <= now_s:
            messages.append(self._under_way.popleft()[1])
        return messages


class Moved(NamedTuple):
    """How a way of the arm went."""

    seconds: float
    done: bool
    blocked: bool
    least_clearance_m: float
    """Of the true posture."""
    furthest_m: float
    """Distance of the true hand from the line between the last two poses, while it was on it."""


def moved_over(delay_s: float, loss: float, seed: int, most_s: float = 40.0) -> Moved:
    """Bring the parked arm along WAY."""
    rng = random.Random(f"arm/{seed}")
    states, commands = OneWay(delay_s, loss, rng), OneWay(delay_s, loss, rng)
    joints = {name: ROBOT.joints[name] for name in (*ARM, ROLL)}
    servos = SimServoGroup(joints, PARKED, keeps_goal=False, timeout_s=MOST_AGE_S)
    true = {name: PARKED[name] for name in joints}
    controller = ArmController(ROBOT, CONFIG.arm, REACHER)
    stage, known = 0, (0.0, dict(PARKED))
    least_m, furthest_m = float("inf"), 0.0
    for number in range(round(most_s / TICK_S)):
        now_s = number * TICK_S
        states.send(now_s, (now_s, PARKED | {name: servo.position_rad for name, servo in servos.servos.items()}))
        known = [known, *states.arrived(now_s)][-1]
        if now_s - known[0] > MOST_AGE_S:
            controller.late(TICK_S)
        else:
            step = controller.reach(*WAY[stage], known[1], TICK_S)
            stage += step.arrived
            if step.blocked or stage == len(WAY):
                return Moved(now_s, stage == len(WAY), step.blocked, least_m, furthest_m)
            commands.send(now_s, (now_s, step))
        for at_s in now_s + np.arange(PHYSICS) * TICK_S / PHYSICS:
            for sent_s, command in commands.arrived(at_s):
                if at_s - sent_s <= MOST_AGE_S:
                    obey(servos, command, at_s)
            follow(servos, true, at_s)
        least_m = min(least_m, CLEARANCE.of(PARKED | true))
        if stage == 1:
            furthest_m = max(furthest_m, abs(REACHER.pose(PARKED | true).height_m - BEHIND.height_m))
    return Moved(most_s, False, False, least_m, furthest_m)


def obey(servos: SimServoGroup, step: ArmStep, now_s: float) -> None:
    speeds = (*step.speed_radps.tolist(), 2.5)
    for name, goal_rad, speed_radps in zip((*ARM, ROLL), (*step.goal_rad.tolist(), step.roll_rad), speeds, strict=True):
        servos.servos[name].command(goal_rad, speed_radps, round((now_s + MOST_AGE_S) * NS))


def follow(servos: SimServoGroup, true: dict[str, float], now_s: float) -> None:
    """The joints go to their goals, no faster than commanded."""
    dt_s = TICK_S / PHYSICS
    servos.expire(round(now_s * NS))
    for name, servo in servos.servos.items():
        drive = servo.drive()
        most_rad = drive.max_speed_radps * dt_s
        true[name] += min(max((drive.target_rad - true[name]) * dt_s / SERVO_S, -most_rad), most_rad)
        servo.sense(true[name], 0.0, 0.0, round(now_s * NS))


@pytest.mark.parametrize(("delay_s", "loss"), [(0.001, 0.0), (0.05, 0.02), (0.05, 0.05)])
def test_over_a_slow_link_the_hand_stays_on_its_way_and_gets_there(delay_s: float, loss: float) -> None:
    moved = moved_over(delay_s, loss, seed=1)
    assert moved.done
    assert moved.least_clearance_m > CONFIG.arm.clearance_m


def ahead(controller: ArmController) -> np.ndarray[Any, Any]:
    """Send the parked arm on its way until its goals are ahead of it; returns them."""
    for _ in range(5):
        step = controller.reach(BEHIND, 0.25, PARKED, TICK_S)
    assert np.abs(step.goal_rad - np.array([PARKED[name] for name in ARM])).max() > 0.1
    return step.goal_rad


@pytest.mark.parametrize(("late_s", "stands"), [(1.0, True), (3.0, False)])
def test_a_late_state_leaves_the_goal_as_it_is_until_the_arm_may_be_anywhere(late_s: float, stands: bool) -> None:
    controller = ArmController(ROBOT, CONFIG.arm, REACHER)
    goal = ahead(controller)
    for _ in range(round(late_s / TICK_S)):
        controller.late(TICK_S)
    held = controller.hold(PARKED, TICK_S).goal_rad
    expected = goal if stands else [PARKED[name] for name in ARM]
    assert held == pytest.approx(np.array(expected))


def test_an_arm_that_waits_for_a_lagging_joint_catches_up_as_fast_as_it_went() -> None:
    controller = ArmController(ROBOT, CONFIG.arm, REACHER)
    steps = [controller.reach(BEHIND, 0.25, PARKED, TICK_S) for _ in range(20)]
    assert np.array_equal(steps[-1].goal_rad, steps[-2].goal_rad), "it waits"
    assert steps[-1].speed_radps.max() == pytest.approx(1.5 * CONFIG.arm.joint_speed_radps)
