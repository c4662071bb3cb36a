"""The arm: where it reaches, how it gets there, and that it enters nothing on its way."""

from __future__ import annotations

from collections.abc import Callable
from math import hypot, pi
from pathlib import Path

import numpy as np
import pytest
from arm_shape import ArmShape
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st

from cocoro.arrays import FloatArray
from cocoro.robot import Robot
from services.planning.arm import ArmController, ArmStep
from services.planning.clearance import Clearance
from services.planning.config import PlanningConfig
from services.planning.reach import HandPose, Reacher
from services.planning.reachability import Reachability

ROBOT = Robot.load()
CONFIG = PlanningConfig()
REACHER = Reacher(ROBOT, CONFIG.arm.damping)
REACHABILITY = Reachability(CONFIG.arm, REACHER)
SHAPE = ArmShape(ROBOT)
TICK_S = 0.02
CLAWS_OPEN = {claw: sign * CONFIG.hand.open_rad for claw, sign in ROBOT.claw.open_sign.items()}
PARKED = dict.fromkeys(ROBOT.joints, 0.0) | ROBOT.poses["park"] | CLAWS_OPEN
ARM, ROLL = ROBOT.arm.joints, ROBOT.arm.roll
LEVEL = {ROLL: ROBOT.claw.level_roll_rad}
READY = PARKED | LEVEL | {"arm_base": -0.087, "shoulder": 0.66, "elbow": -1.6, "wrist_pitch": 0.77}

in_reach = st.builds(
    HandPose,
    radius_m=st.floats(*CONFIG.arm.grasp_radius_range_m),
    azimuth_rad=st.floats(*CONFIG.arm.grasp_azimuth_range_rad),
    height_m=st.floats(0.045, 0.12),
    pitch_rad=st.just(CONFIG.arm.pitch_rad),
)
anywhere = st.builds(
    HandPose,
    radius_m=st.floats(0.12, 0.65),
    azimuth_rad=st.floats(-2.6, 1.4),
    height_m=st.floats(0.0, 0.9),
    pitch_rad=st.floats(-1.5, 0.7),
)


def within_limits(angles: FloatArray) -> bool:
    limits = np.array([ROBOT.joints[name].limits_rad for name in ARM])
    return bool(((angles >= limits[:, 0] - 1e-9) & (angles <= limits[:, 1] + 1e-9)).all())


class Arm:
    """An arm that follows commands exactly."""

    def __init__(self, angles: dict[str, float], robot: Robot = ROBOT) -> None:
        self.controller = ArmController(robot, CONFIG.arm, REACHER)
        self.angles = angles
        self.path = [angles]
        self.steps: list[ArmStep] = []

    def go(self, command: Callable[[], ArmStep], most_s: float = 12.0) -> ArmStep:
        """Repeat a command until the arm has arrived or is blocked."""
        for _ in range(round(most_s / TICK_S)):
            step = command()
            self.angles = self.angles | dict(zip(ARM, step.goal_rad.tolist(), strict=True)) | {ROLL: step.roll_rad}
            self.path.append(self.angles)
            self.steps.append(step)
            if step.arrived or step.blocked:
                break
        return step

    def reach(self, goal: HandPose, speed_mps: float = 0.25, swing_radps: float | None = None) -> ArmStep:
        reach = self.controller.reach
        return self.go(lambda: reach(goal, speed_mps, self.angles, TICK_S, swing_radps=swing_radps))

    def park(self) -> ArmStep:
        return self.go(lambda: self.controller.park(self.angles, TICK_S))


# --- reaching -------------------------------------------------------------------------------------


@settings(max_examples=60)
@given(goal=in_reach)
def test_wherever_a_target_can_be_grasped_the_hand_gets_there_within_the_limits(goal: HandPose) -> None:
    angles = REACHER.solve(READY | {"arm_base": READY["arm_base"] + goal.azimuth_rad}, goal)
    assert angles is not None
    assert within_limits(np.array([angles[name] for name in ARM]))
    have = REACHER.pose(READY | angles)
    assert np.linalg.norm(REACHER.point(have) - REACHER.point(goal)) < 0.005
    assert have.pitch_rad == pytest.approx(goal.pitch_rad, abs=0.05)


@settings(max_examples=30)
@given(goal=anywhere)
def test_no_step_ever_leaves_the_limits_however_far_the_goal(goal: HandPose) -> None:
    angles = dict(READY)
    for _ in range(20):
        step = REACHER.step(angles, goal)
        assert np.isfinite(step).all()
        assert within_limits(step)
        angles.update(zip(ARM, step.tolist(), strict=True))


@settings(max_examples=20)
@given(radius_m=st.floats(0.62, 2.0), azimuth_rad=st.floats(-0.4, 0.4), height_m=st.floats(0.05, 0.3))
def test_beyond_reach_there_is_no_solution(radius_m: float, azimuth_rad: float, height_m: float) -> None:
    assert REACHER.solve(READY, HandPose(radius_m, azimuth_rad, height_m, CONFIG.arm.pitch_rad)) is None


@given(goal=in_reach)
def test_a_pose_and_its_point_are_one(goal: HandPose) -> None:
    x, y, z = REACHER.point(goal).tolist()
    assert REACHER.seen_from_arm((x, y, z)) == pytest.approx(goal[:3])


@settings(max_examples=20)
@given(start=anywhere, goal=anywhere)
def test_a_waypoint_is_no_further_than_a_step_and_ends_at_the_goal(start: HandPose, goal: HandPose) -> None:
    first = start.towards(goal, 0.005, 0.02)
    assert hypot(first.radius_m - start.radius_m, first.height_m - start.height_m) <= 0.005 + 1e-9
    assert abs(first.pitch_rad - start.pitch_rad) <= 0.02 + 1e-9
    pose = start
    for _ in range(2000):
        pose = pose.towards(goal, 0.005, 0.02)
    assert REACHER.point(pose) == pytest.approx(REACHER.point(goal), abs=1e-6)


# --- reachability ---------------------------------------------------------------------------------


def seen_at(radius_m: float, azimuth_rad: float = 0.0, height_m: float = 0.06) -> tuple[float, float, float]:
    x, y, z = REACHER.point(HandPose(radius_m, azimuth_rad, height_m, 0.0)).tolist()
    return x, y, z


def test_where_a_target_should_stand_it_can_be_grasped() -> None:
    assert REACHABILITY.why_not(seen_at(CONFIG.arm.grasp_radius_m)) == ""


@pytest.mark.parametrize(
    ("place", "why"),
    [
        (seen_at(0.60), "its radius is 0.60 m"),
        (seen_at(0.40), "its radius is 0.40 m"),
        (seen_at(0.49, azimuth_rad=0.6), "its azimuth is 0.60 rad"),
        (seen_at(0.49, height_m=0.35), "it is 0.35 m high"),
    ],
)
def test_where_it_cannot_be_grasped_it_is_said_why(place: tuple[float, float, float], why: str) -> None:
    assert why in REACHABILITY.why_not(place)


@settings(max_examples=15)
@given(radius_m=st.floats(*CONFIG.arm.grasp_radius_range_m), azimuth_rad=st.floats(-0.44, 0.44))
def test_what_is_called_reachable_is_reached(radius_m: float, azimuth_rad: float) -> None:
    place = seen_at(radius_m, azimuth_rad)
    if REACHABILITY.why_not(place):
        return
    grasp = REACHABILITY.grasp(place)
    assert grasp.around[:3] == pytest.approx((radius_m, azimuth_rad, 0.06))
    arm = Arm(dict(READY))
    assert arm.reach(grasp.behind).arrived
    assert arm.reach(grasp.around, CONFIG.arm.insert_speed_mps).arrived
    assert REACHER.position(arm.angles) == pytest.approx(np.array(place), abs=0.006)


# --- the way there --------------------------------------------------------------------------------


def enters_the_mount(path: list[dict[str, float]]) -> bool:
    return any(SHAPE.depth_in_mount_m(angles) > 0.0 for angles in path[::6] + path[-1:])


@settings(max_examples=12, phases=[Phase.explicit, Phase.generate])
@given(goal=in_reach)
def test_from_the_park_pose_to_any_grasp_and_back_the_arm_enters_nothing(goal: HandPose) -> None:
    arm = Arm(dict(PARKED))
    assert arm.reach(goal).arrived
    assert arm.park().arrived
    assert arm.controller.parked(arm.angles)
    assert not enters_the_mount(arm.path)
    assert min(SHAPE.lowest_m(angles) for angles in arm.path[::8]) > 0.0


@settings(max_examples=15, phases=[Phase.explicit, Phase.generate])
@given(goals=st.lists(anywhere, min_size=1, max_size=2), park=st.booleans())
@example(goals=[HandPose(0.30, -1.8, 0.45, 0.0)], park=True)
@example(goals=[HandPose(0.12, 1.4, 0.30, 0.0)], park=True)
@example(goals=[HandPose(0.12, -2.6, 0.10, -1.5)], park=True)
def test_wherever_the_hand_is_sent_the_arm_never_enters_the_cameras_mount(goals: list[HandPose], park: bool) -> None:
    arm = Arm(dict(PARKED))
    for goal in goals:
        arm.go(lambda goal=goal: arm.controller.reach(goal, 0.25, arm.angles, TICK_S), most_s=4.0)  # type: ignore[misc]
    if park:
        arm.park()
    assert not enters_the_mount(arm.path)
    assert min(SHAPE.lowest_m(angles) for angles in arm.path[::8]) > 0.0


@given(angles=st.fixed_dictionaries({name: st.floats(*ROBOT.joints[name].limits_rad) for name in ARM}))
def test_what_the_planner_calls_clear_of_the_mount_is_clear_of_it(angles: dict[str, float]) -> None:
    posture = PARKED | angles
    if Clearance(ROBOT).of(posture) >= CONFIG.arm.clearance_m:
        assert SHAPE.depth_in_mount_m(posture) == 0.0


def test_a_measured_longer_finger_stops_the_arm_where_it_would_touch_the_floor(tmp_path: Path) -> None:
    own = tmp_path / "own.toml"
    own.write_text("[claw]\npad_length_m = 0.16\n")
    measured = Robot.load(override=own)
    pitched = HandPose(0.40, 0.0, 0.05, -0.5)
    arms = [Arm(dict(READY), robot) for robot in (ROBOT, measured)]
    steps = [arm.reach(pitched) for arm in arms]
    assert [step.blocked for step in steps] == [False, True]
    assert Clearance(measured).of(arms[0].angles) < 0.0, "with longer fingers that would be in the floor"
    assert Clearance(measured).of(arms[1].angles) >= CONFIG.arm.clearance_m


def test_the_arm_moves_smoothly_and_no_faster_than_it_may() -> None:
    arm = Arm(dict(PARKED))
    arm.reach(HandPose(0.37, 0.0, 0.06, CONFIG.arm.pitch_rad))
    path = np.array([[angles[name] for name in ARM] for angles in arm.path])
    speeds = np.abs(np.diff(path, axis=0)) / TICK_S
    assert speeds.max() <= 2.5 + 1e-6
    assert (np.array([step.speed_radps for step in arm.steps]) >= speeds - 1e-6).all(), "the servos may keep up"


@pytest.mark.parametrize("swing_radps", [None, 1.2])
def test_the_swing_to_the_front_may_be_slowed_and_nothing_else_is(swing_radps: float | None) -> None:
    arm = Arm(dict(PARKED))
    arm.reach(HandPose(0.37, 0.0, 0.2, CONFIG.arm.pitch_rad), swing_radps=swing_radps)
    swings, lifts = (
        np.abs(np.diff([angles[name] for angles in arm.path])) / TICK_S for name in ("arm_base", "wrist_pitch")
    )
    folded = np.array([angles["arm_base"] > 0.5 for angles in arm.path[1:]])
    assert swings[folded].max() == pytest.approx(swing_radps or CONFIG.arm.joint_speed_radps, abs=0.01)
    assert lifts.max() > 2.0


def test_an_arm_that_is_held_up_is_not_left_behind() -> None:
    controller = ArmController(ROBOT, CONFIG.arm, REACHER)
    for _ in range(200):
        step = controller.reach(HandPose(0.37, 0.0, 0.2, CONFIG.arm.pitch_rad), 0.25, PARKED, TICK_S)
    lead = np.abs(step.goal_rad - np.array([PARKED[name] for name in ARM]))
    assert lead.max() <= CONFIG.arm.lead_rad + 2.5 * TICK_S


def test_while_states_are_late_the_goals_of_all_joints_wait_so_that_the_hand_stays_on_its_way() -> None:
    controller = ArmController(ROBOT, CONFIG.arm, REACHER)
    late = np.array([PARKED[name] for name in ARM])

    def goals(seconds: float) -> FloatArray:
        to = HandPose(0.37, 0.0, 0.2, CONFIG.arm.pitch_rad)
        steps = [controller.reach(to, 0.25, PARKED, TICK_S) for _ in range(round(seconds / TICK_S))]
        assert not any(step.blocked for step in steps)
        gaps = np.abs(steps[-1].goal_rad - late)
        assert steps[-1].speed_radps[gaps > 0.01] / gaps[gaps > 0.01] == pytest.approx(
            steps[-1].speed_radps.max() / gaps.max()
        ), "all joints arrive at once"
        return np.array([step.goal_rad for step in steps])

    waiting = goals(CONFIG.arm.wait_s)
    assert CONFIG.arm.wait_rad < np.abs(waiting - late).max() <= CONFIG.arm.wait_rad + 2.5 * TICK_S
    assert (waiting[-5:] == waiting[-1]).all()
    assert not np.array_equal(goals(0.1)[-1], waiting[-1]), "what is held up for longer is no delay"


def test_holding_holds_what_was_commanded_last() -> None:
    arm = Arm(dict(READY))
    arm.go(lambda: arm.controller.reach(HandPose(0.45, 0.0, 0.1, CONFIG.arm.pitch_rad), 0.25, arm.angles, TICK_S), 0.2)
    reference = dict(arm.controller.reference or {})
    for _ in range(50):
        step = arm.controller.hold(arm.angles, TICK_S)
    assert dict(zip(ARM, step.goal_rad.tolist(), strict=True)) == pytest.approx({name: reference[name] for name in ARM})


def test_a_grasp_is_level_with_the_claws_beside_the_target() -> None:
    arm = Arm(dict(PARKED))
    arm.reach(HandPose(0.49, 0.0, 0.06, CONFIG.arm.pitch_rad))
    assert arm.angles[ROLL] == pytest.approx(pi / 2, abs=0.05)
    left, right = (ROBOT.chain(claw).position(arm.angles) for claw in ("claw_left", "claw_right"))
    assert left[2] == pytest.approx(right[2], abs=0.005)
    assert abs(left[1] - right[1]) == pytest.approx(2 * 0.01725, abs=0.001)


@pytest.mark.parametrize("arrive", [True, False])
def test_an_arm_that_stays_behind_is_held_up_unless_its_commands_do_not_arrive(arrive: bool) -> None:
    controller = ArmController(ROBOT, CONFIG.arm, REACHER)
    held_up = []
    for _ in range(round(3.0 / TICK_S)):
        if not arrive:
            controller.undelivered()
        controller.park(READY, TICK_S)
        held_up.append(controller.stalled)
    assert held_up[-1] == arrive
    assert not any(held_up[: round(CONFIG.arm.stall_s / TICK_S)])
