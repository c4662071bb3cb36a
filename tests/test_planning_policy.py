"""Following a policy in the planner: what base, arm, head and claws do with the actions that it proposes, and what they
do not."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from planner_rig import ROBOT, TICK_S, Planner, standing

from cocoro import topics
from cocoro.messages import PlannerStatus, PolicyActions
from services.planning.arm_guard import ArmGuard
from services.planning.behaviours.base import Actuators
from services.planning.behaviours.policy import row_at
from services.planning.config import PlanningConfig, PolicyConfig
from services.planning.core import PlanningCore

CONFIG = PlanningConfig()
ARM, JAWS = ROBOT.arm, ROBOT.jaws
PAN, TILT = ROBOT.head_joints
PERIOD_S = 0.1
OUT = dict.fromkeys(ROBOT.joints, 0.0) | ROBOT.poses["upright"] | {ARM.roll: ROBOT.claw.level_roll_rad}
"""The arm in front of the robot."""
REACHED = {**ROBOT.poses["upright"], ARM.joints[1]: 0.2, ARM.joints[2]: -0.3, ARM.joints[3]: 0.1}
"""The arm stretched out to the front."""


def chunk(
    planner: Planner, goals: Mapping[str, float], ahead: float = 0.0, turn: float = 0.0, rows: int = 10, **fields: Any
) -> PolicyActions:
    """The same wanted values in each row, from now on, as an answer to the present intent."""
    intent = planner.wants
    assert intent is not None
    made: dict[str, Any] = {
        "task_id": intent.task_id, "step": intent.step, "observed_ns": planner.under_test.now_ns,
        "period_s": PERIOD_S, "joints": tuple(goals), "goal_rad": (tuple(goals.values()),) * rows,
        "ahead_mps": (ahead,) * rows, "turn_radps": (turn,) * rows,
    }  # fmt: skip
    return PolicyActions(**(made | fields))


def follows(arm: Mapping[str, float] | None = None, sees: tuple[float, float, float] | None = None) -> Planner:
    """A planner that follows a policy which has said nothing yet; the arm is folded unless its angles are given."""
    planner = Planner()
    planner.sees = sees
    planner.angles.update(arm or {})
    planner.run(0.4)
    planner.want("policy", "mine")
    planner.run(0.1)
    return planner


def propose(planner: Planner, seconds: float, goals: Mapping[str, float], **how: Any) -> PlannerStatus:
    """Propose the same again and again, a chunk each 0.2 s."""
    for tick in range(round(seconds / TICK_S)):
        if tick % 10 == 0:
            planner.under_test.feed(topics.POLICY_ACTIONS, chunk(planner, goals, **how))
        status = planner.tick()
    return status


def actuators(planner: Planner) -> Actuators:
    core = planner.under_test.core
    assert isinstance(core, PlanningCore)
    return core.actuators


# --- rows -----------------------------------------------------------------------------------------


def test_joints_go_between_rows_and_the_base_has_the_row_in_force() -> None:
    actions = PolicyActions(
        task_id="", step=0, observed_ns=10**9, period_s=0.1, joints=("a",), goal_rad=((0.0,), (1.0,)),
        ahead_mps=(0.1, 0.2), turn_radps=(0.0, 0.4),
    )  # fmt: skip
    config = PolicyConfig(hold_s=0.15, oldest_s=2.0)
    found = {at_ms: row_at(actions, 10**9 + at_ms * 10**6, config) for at_ms in (-1, 0, 50, 150, 340, 360)}
    assert found[-1] is None
    assert found[360] is None
    rows = {at: (row.goals["a"], row.ahead_mps) for at, row in found.items() if row is not None}
    assert rows == {0: (0.0, 0.1), 50: (pytest.approx(0.5), 0.1), 150: (1.0, 0.2), 340: (1.0, 0.2)}
    assert row_at(actions, 10**9 + 50 * 10**6, PolicyConfig(oldest_s=0.04)) is None


# --- arm and head ---------------------------------------------------------------------------------


def test_the_arm_goes_to_its_goals_no_faster_than_it_may() -> None:
    planner = follows(OUT)
    goals = {ARM.azimuth: OUT[ARM.azimuth] - 0.8, PAN: 0.4}
    before = planner.angles[ARM.azimuth]
    propose(planner, TICK_S, goals)
    assert 0.0 < abs(planner.angles[ARM.azimuth] - before) <= CONFIG.arm.joint_speed_radps * TICK_S + 1e-6
    status = propose(planner, 1.5, goals)
    assert status.why == "doing what mine proposes"
    assert {joint: planner.angles[joint] for joint in goals} == pytest.approx(goals, abs=0.02)
    assert planner.angles[ARM.joints[1]] == pytest.approx(OUT[ARM.joints[1]], abs=1e-6)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_no_goal_is_beyond_a_joints_limits_and_no_posture_touches_the_robot(sign: float) -> None:
    planner = follows(OUT)
    guard = ArmGuard(ROBOT, CONFIG, actuators(planner).arm.clearance)
    joints = (*ARM.joints, ARM.roll, PAN, TILT, *JAWS)
    for _ in range(150):
        status = propose(planner, TICK_S, dict.fromkeys(joints, sign * 50.0))
        assert guard.own_m(planner.angles) > 0.0
        assert actuators(planner).arm.clearance.of(planner.angles) > 0.0
    assert "not beyond the limits of" in status.why
    for name, joint in ROBOT.joints.items():
        low, high = joint.limits_rad
        assert low - 1e-6 <= planner.angles[name] <= high + 1e-6
    low, high = CONFIG.head.tilt_range_rad
    assert low <= planner.angles[TILT] <= high


def test_the_arm_does_not_reach_into_a_wall() -> None:
    wall_m = 0.70
    planner = follows(OUT)
    planner.points = tuple((wall_m, y * 0.03, z) for y in range(-15, 16) for z in (0.1, 0.3))
    planner.run(0.5)
    status = propose(planner, 3.0, REACHED)
    centres, radii = actuators(planner).arm.clearance.hull(planner.angles)
    assert "something is in its way" in status.why
    assert float((centres[:, 0] + radii).max()) < wall_m
    free = follows(OUT)
    propose(free, 3.0, REACHED)
    centres, radii = actuators(free).arm.clearance.hull(free.angles)
    assert float((centres[:, 0] + radii).max()) > wall_m  # without the wall it does
    back = propose(planner, 2.0, ROBOT.poses["upright"])
    assert back.why == "doing what mine proposes"


def test_a_folded_arm_looks_at_unseen_floor_before_it_unfolds() -> None:
    planner = Planner()
    planner.sees, planner.free = None, ()
    planner.run(0.4)
    planner.want("policy", "mine")
    status = propose(planner, 0.4, ROBOT.poses["unfolded"])
    assert status.why == "looking where to unfold the arm"
    folded = {joint: planner.angles[joint] for joint in ARM.joints}
    assert folded == pytest.approx(dict(ROBOT.poses["park"]), abs=1e-6)
    assert propose(planner, 2.5, ROBOT.poses["unfolded"]).why == "doing what mine proposes"


# --- base -----------------------------------------------------------------------------------------


def test_the_base_drives_as_proposed_and_stops_before_a_wall() -> None:
    planner, way_m = follows(), 0.0
    speeds = []
    for _ in range(round(6.0 / TICK_S)):
        planner.points = tuple((1.2 - way_m, y * 0.04, z) for y in range(-10, 11) for z in (0.1, 0.3))
        planner.base = {"odometry_m": (way_m, 0.0), "speed_mps": planner.wheels.ahead_mps}
        status = propose(planner, TICK_S, {}, ahead=9.0)
        speeds.append(planner.wheels.ahead_mps)
        way_m += speeds[-1] * TICK_S
    assert 0.2 < max(speeds) <= CONFIG.navigation.max_speed_mps + 1e-6
    assert speeds[-1] == 0.0
    assert "something is in the way" in status.why
    assert way_m < 1.2 - ROBOT.base.chassis_diameter_m / 2


def test_a_turn_is_limited_and_what_is_nearly_rest_is_rest() -> None:
    planner = follows()
    propose(planner, 2.0, {}, turn=30.0)
    assert planner.wheels.turn_radps == pytest.approx(CONFIG.navigation.max_turn_radps, abs=0.01)
    propose(planner, 1.0, {}, ahead=0.004, turn=0.01)
    assert standing(planner)


# --- claws ----------------------------------------------------------------------------------------


def jaws(opening_rad: float) -> dict[str, float]:
    return {joint: ROBOT.claw.open_sign[joint] * opening_rad for joint in JAWS}


def opening(planner: Planner) -> float:
    return min(ROBOT.claw.open_sign[joint] * planner.angles[joint] for joint in JAWS)


def test_claws_open_and_close_as_far_as_proposed_and_clamp_what_they_hold() -> None:
    planner = follows(OUT)
    propose(planner, 0.2, jaws(9.0))
    assert opening(planner) == pytest.approx(CONFIG.hand.open_rad)
    propose(planner, 0.2, jaws(0.2))
    assert opening(planner) == pytest.approx(0.2)
    planner.hand_load, thing_rad = 0.6, 0.1
    for _ in range(100):
        planner.angles |= jaws(thing_rad)  # as far as the thing lets them
        propose(planner, TICK_S, jaws(-0.3))
    assert opening(planner) == pytest.approx(thing_rad - CONFIG.hand.clamp_rad)  # not the policy's goal
    planner.angles |= jaws(thing_rad)
    propose(planner, TICK_S, jaws(0.4))
    assert opening(planner) == pytest.approx(0.4)


# --- ends -----------------------------------------------------------------------------------------


def test_without_actions_that_count_all_rests_and_then_it_fails() -> None:
    planner = follows()
    propose(planner, 1.0, {}, ahead=0.3)
    assert not standing(planner)
    planner.run(PERIOD_S * 10 + CONFIG.policy.hold_s + 0.5)
    assert standing(planner)
    assert planner.status.state == "running"
    status = planner.run(CONFIG.policy.silent_s)
    assert (status.state, status.reason) == ("failed", "silent")


def test_actions_that_come_when_their_time_is_over_do_not_count() -> None:
    planner = follows()
    for _ in range(50):
        late_ns = planner.under_test.now_ns - round(1.4e9)
        planner.under_test.feed(topics.POLICY_ACTIONS, chunk(planner, {}, ahead=0.3, observed_ns=late_ns))
        status = planner.tick()
        assert standing(planner)
    assert status.why == "waiting for the first actions of mine"


def test_actions_for_another_run_do_not_count() -> None:
    planner = follows()
    propose(planner, 1.0, {}, ahead=0.3, step=77)
    assert standing(planner)
    propose(planner, 1.0, {}, ahead=0.3, task_id="other")
    assert standing(planner)


def test_a_refusal_ends_it_with_the_reason_and_an_end_is_done() -> None:
    planner = follows()
    refused = PolicyActions(task_id="task", step=planner.wants.step, state="refused", text="it is broken")  # type: ignore[union-attr]
    planner.under_test.feed(topics.POLICY_ACTIONS, refused)
    status = planner.tick()
    assert (status.state, status.reason, status.why) == ("failed", "refused", "it is broken")
    planner.want("policy", "mine")
    planner.tick()
    ended = PolicyActions(task_id="task", step=planner.wants.step, state="done")  # type: ignore[union-attr]
    planner.under_test.feed(topics.POLICY_ACTIONS, ended)
    assert planner.tick().state == "done"


def test_goals_of_joints_that_the_robot_does_not_have_are_refused() -> None:
    planner = follows(OUT)
    status = propose(planner, TICK_S, {"third_elbow": 0.1})
    assert (status.state, status.reason) == ("failed", "refused")
    assert status.why == "it proposes goals of joints that the robot does not have: third_elbow"


def test_a_message_that_is_not_whole_is_none() -> None:
    planner = follows()
    for fields in (
        {"ahead_mps": (0.0,)},
        {"goal_rad": ((0.0,),) * 10},
        {"period_s": 0.0},
        {"ahead_mps": (np.nan,) * 10},
    ):
        with pytest.raises(ValueError, match=r"ahead_mps|row 0|period|finite"):
            chunk(planner, {}, **fields)


def test_the_folded_arm_is_clear_of_the_robot() -> None:
    planner = follows(OUT)
    guard = ArmGuard(ROBOT, CONFIG, actuators(planner).arm.clearance)
    for pose in ("park", "upright"):
        assert guard.own_m(planner.angles | ROBOT.poses[pose]) > CONFIG.arm.clearance_m
