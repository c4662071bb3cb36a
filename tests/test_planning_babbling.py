"""Babbling: safe postures, the arm's and the wheels' behaviours stepped by hand, and the way back to work."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from spelled import action

from cocoro import topics
from cocoro.arrays import FloatArray
from cocoro.clock import NS
from cocoro.core import Output, Sample
from cocoro.joints import GROUPS
from cocoro.learning.handmap import NominalModel
from cocoro.messages import (
    BaseCommand,
    BaseState,
    Detection,
    Detections,
    HandSample,
    Intent,
    PlannerStatus,
    ServoCommand,
    ServoState,
    WheelTrial,
)
from cocoro.robot import Robot
from services.planning.arm import ArmController
from services.planning.config import PlanningConfig
from services.planning.core import PlanningCore
from services.planning.gaze import gaze_of
from services.planning.postures import Postures, sobol
from services.planning.reach import HandPose, Reacher

TICK_NS = NS // 50
ARM, ROLL = Robot.load().arm.joints, Robot.load().arm.roll
CONFIG = PlanningConfig()


def postures_of(robot: Robot) -> Postures:
    return Postures(robot, gaze_of(robot, CONFIG.head))


@pytest.fixture(scope="module")
def postures(robot: Robot) -> Postures:
    return postures_of(robot)


@pytest.fixture(scope="module")
def safe(postures: Postures) -> list[FloatArray]:
    draws = islice(sobol(1, postures.ranges), 400)
    return [posture for _, posture in draws if postures.safe(posture)]


# --- draws and postures -------------------------------------------------------------------------------


def test_a_draw_is_known_by_its_number(postures: Postures) -> None:
    whole = list(islice(sobol(1, postures.ranges), 20))
    later = list(islice(sobol(13, postures.ranges), 8))
    assert [number for number, _ in whole] == list(range(1, 21))
    for (number, point), (again, same) in zip(whole[12:], later, strict=True):
        assert number == again
        assert np.array_equal(point, same)


def test_draws_lie_within_the_papers_range_and_the_joints_limits(postures: Postures, robot: Robot) -> None:
    points = np.array([point for _, point in islice(sobol(1, postures.ranges), 500)])
    for column, joint in enumerate(ARM):
        low, high = robot.joints[joint].limits_rad
        assert points[:, column].min() >= max(low, -2.62)
        assert points[:, column].max() <= min(high, 2.62)
    spread = (points - points.min(axis=0)) / np.ptp(points, axis=0)
    assert np.allclose(spread.mean(axis=0), 0.5, atol=0.01)


def test_about_a_quarter_of_the_draws_is_safe_and_about_half_of_those_can_be_seen(
    postures: Postures, safe: list[FloatArray]
) -> None:
    assert 0.15 < len(safe) / 400 < 0.35
    assert 0.35 < np.mean([postures.seeable(posture) for posture in safe]) < 0.75


def test_the_park_pose_beside_the_mount_is_not_babbled_into(postures: Postures, robot: Robot) -> None:
    assert not postures.safe(np.array([robot.poses["park"][name] for name in ARM]))


def test_a_hand_folded_onto_its_own_arm_is_not_safe(postures: Postures) -> None:
    assert postures.safe(np.array([-0.1, 1.2, -0.8, 0.3]))
    assert not postures.safe(np.array([-0.1, 1.2, -2.55, -2.1]))


def test_a_tube_that_a_measured_file_adds_does_not_count_as_hand(postures: Postures, tmp_path: Path) -> None:
    file = tmp_path / "measured.toml"
    file.write_text(
        '[[hull.tube]]\nname = "bracket"\nstart = "elbow"\nend = "wrist_pitch"\nradius_m = 0.02\nballs = 4\n'
    )
    bracketed = postures_of(Robot.load(override=file))  # the bracket is inside of the forearm
    draws = [posture for _, posture in islice(sobol(1, postures.ranges), 100)]
    assert [bracketed.safe(posture) for posture in draws] == [postures.safe(posture) for posture in draws]


def test_between_two_safe_postures_the_straight_way_may_not_be_clear(postures: Postures) -> None:
    low, folded_in = np.array([-0.13, 0.95, -0.37, -2.13]), np.array([0.28, 0.52, -2.60, 2.06])
    assert postures.safe(low)
    assert postures.safe(folded_in)
    assert not postures.clear_way(low, folded_in)  # on the way the arm would enter the robot or the floor
    assert postures.clear_way(low, np.array([-0.13, 0.95, -0.37, -1.80]))


# --- back to work from anywhere ----------------------------------------------------------------------


def test_from_wherever_babbling_ended_the_arm_gets_ready_and_is_folded_again(
    robot: Robot, safe: list[FloatArray]
) -> None:
    goal = HandPose(CONFIG.arm.travel_radius_m, 0.0, CONFIG.arm.travel_height_m, CONFIG.arm.pitch_rad)
    for posture in safe[::4]:
        for park in (False, True):
            arm = ArmController(robot, CONFIG.arm, Reacher(robot, CONFIG.arm.damping))
            angles = dict.fromkeys(robot.joints, 0.0) | dict(zip(ARM, posture.tolist(), strict=True))
            angles[ROLL] = robot.claw.level_roll_rad
            for _ in range(700):
                step = arm.park(angles, 0.02) if park else arm.reach(goal, 0.25, angles, 0.02)
                assert not step.blocked
                angles.update(zip(ARM, step.goal_rad.tolist(), strict=True))
                angles[ROLL] = step.roll_rad
                if step.arrived:
                    break
            assert step.arrived


# --- the behaviours, with hardware that follows commands -------------------------------------------


class Body:
    """Joints that follow immediately, wheels that roll as commanded, a camera that sees marker and target."""

    def __init__(self, robot: Robot, separation_m: float) -> None:
        self.robot = robot
        self.core = PlanningCore(robot, PlanningConfig())
        self.now_ns = NS
        self.angles = dict.fromkeys(robot.joints, 0.0) | robot.poses["park"]
        self.base = np.zeros(3)
        """x, y, yaw of the body in the world."""
        self.told_yaw_rad = 0.0
        self.reports: list[Output] = []
        self.status = PlannerStatus()
        self._separation_m = separation_m
        self._drawing = NominalModel(robot)
        self._wheels = (0.0, 0.0)

    def run(self, intent: Intent, *, ticks: int) -> PlannerStatus:
        """Follow an intent until it ends, or for so many ticks."""
        for tick in range(ticks):
            self.now_ns += TICK_NS
            self._move(TICK_NS / NS)
            intent.stamp_ns = self.now_ns
            inputs = [Sample(topics.INTENT, intent), *self._states()]
            if tick % 3 == 0:
                inputs.append(Sample(topics.DETECTIONS, self._seen()))
            for topic, message in self.core.step(inputs, self.now_ns):
                self._take(Output(topic, message))
            if self.status.state != "running":
                break
        return self.status

    def _take(self, output: Output) -> None:
        message = output.message
        if isinstance(message, ServoCommand):
            self.angles.update(zip(message.joints, message.goal_rad, strict=True))
        elif isinstance(message, BaseCommand):
            left, right = self.robot.drive.wheels_of(message)
            self._wheels = left, right
        elif isinstance(message, PlannerStatus):
            self.status = message
        elif isinstance(message, HandSample | WheelTrial):
            self.reports.append(output)

    def _move(self, dt_s: float) -> None:
        left, right = self._wheels
        turn = (right - left) * dt_s / self._separation_m
        heading = self.base[2] + turn / 2
        way = (left + right) / 2 * dt_s
        self.base += [way * np.cos(heading), way * np.sin(heading), turn]
        self.told_yaw_rad += (right - left) * dt_s / self.robot.base.axle_m

    def _states(self) -> list[Sample]:
        left, right = self._wheels
        base = BaseState(
            stamp_ns=self.now_ns, odometry_m=(float(self.base[0]), float(self.base[1])),
            odometry_yaw_rad=self.told_yaw_rad, speed_mps=(left + right) / 2,
            turn_rate_radps=(right - left) / self._separation_m, latch="released",
        )  # fmt: skip
        states = [Sample(topics.BASE_STATE, base)]
        for group, topic in zip(GROUPS, (topics.ARM_STATE, topics.HAND_STATE), strict=True):
            joints = self.robot.group_joints(group)
            state = ServoState(
                stamp_ns=self.now_ns, joints=joints, position_rad=tuple(self.angles[joint] for joint in joints),
                speed_radps=(0.0,) * len(joints), load=(0.0,) * len(joints), latch="released",
            )  # fmt: skip
            states.append(Sample(topic, state))
        return states

    def _seen(self) -> Detections:
        marker = self._drawing.at(np.array([self.angles[name] for name in ARM]))
        away = np.array([1.5, 0.0]) - self.base[:2]
        c, s = np.cos(-self.base[2]), np.sin(-self.base[2])
        can = (c * away[0] - s * away[1], s * away[0] + c * away[1], 0.06)
        rows = [("hand_marker", marker.tolist()), ("red_can", can)]
        return Detections(
            stamp_ns=self.now_ns, frame_seq=0, frame_incarnation=0, width=640, height=480,
            detections=tuple(
                Detection(label=label, u_px=320, v_px=240, area_px=300, box_px=(310, 230, 330, 250), depth_m=0.7,
                          position_m=(float(place[0]), float(place[1]), float(place[2])))
                for label, place in rows
            ),
        )  # fmt: skip


def intent(name: str, count: int, first: int = 1, label: str = "") -> Intent:
    return Intent(task_id="t", step=1, action=action(name, label, first=first, count=count))


def test_the_arm_babbles_until_there_are_samples_enough_and_comes_home(robot: Robot, postures: Postures) -> None:
    body = Body(robot, robot.base.axle_m)
    status = body.run(intent("babble-arm", 90), ticks=4000)
    assert (status.state, status.why) == ("done", "90 samples")
    samples = [output.message for output in body.reports]
    assert len(samples) == 90
    drawing = NominalModel(robot)
    for sample in samples:
        assert isinstance(sample, HandSample)
        angles = np.array([sample.angles_rad[name] for name in ARM])
        assert np.allclose(drawing.at(angles), sample.seen_m, atol=1e-6)
    stamps = np.diff([sample.stamp_ns for sample in samples])
    assert stamps.min() >= 0.1 * NS
    assert len({sample.draw for sample in samples if isinstance(sample, HandSample)}) >= 3


def test_babbling_goes_on_from_the_draw_that_it_is_told(robot: Robot) -> None:
    body = Body(robot, robot.base.axle_m)
    body.run(intent("babble-arm", 30, first=500), ticks=2500)
    draws = [output.message.draw for output in body.reports if isinstance(output.message, HandSample)]
    assert min(draws) >= 500
    assert draws == sorted(draws)


def test_all_the_way_nothing_comes_near_to_the_robot_itself(robot: Robot, postures: Postures) -> None:
    body = Body(robot, robot.base.axle_m)
    body.run(intent("babble-arm", 1000), ticks=200)  # unfolded by now
    for _ in range(1200):
        body.run(intent("babble-arm", 1000), ticks=1)
        posture = np.array([body.angles[name] for name in ARM])
        assert postures.safe(posture)


def test_the_wheels_go_to_and_fro_and_tell_their_distance(robot: Robot) -> None:
    body = Body(robot, separation_m=0.255)
    status = body.run(intent("babble-wheels", 8, first=2, label="red_can"), ticks=2500)
    assert (status.state, status.why) == ("done", "8 trials")
    trials = [output.message for output in body.reports]
    assert len(trials) == 8
    for one, other in zip(trials[::2], trials[1::2], strict=True):
        assert isinstance(one, WheelTrial)
        assert isinstance(other, WheelTrial)
        assert (other.trial, other.left_mps, other.right_mps) == (one.trial + 1, -one.left_mps, -one.right_mps)
        told_m = one.turned_rad * robot.base.axle_m
        turned = np.arctan2(one.before_m[1], one.before_m[0]) - np.arctan2(one.after_m[1], one.after_m[0])
        if abs(one.way_m) < 0.01:
            assert told_m / turned == pytest.approx(0.255, abs=0.002)
    assert np.linalg.norm(body.base[:2]) < 0.02
    assert abs(body.base[2]) < 0.02


def test_without_the_target_the_wheels_stay_still(robot: Robot) -> None:
    body = Body(robot, robot.base.axle_m)
    status = body.run(intent("babble-wheels", 8, label="green_can"), ticks=500)
    assert (status.state, status.reason) == ("failed", "lost")
    assert np.array_equal(body.base, np.zeros(3))
