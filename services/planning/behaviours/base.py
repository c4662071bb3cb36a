"""Input and output of every behaviour: the snapshot of one step, the actuators, and the plan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import hypot, inf
from typing import ClassVar, Literal, Protocol

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.core import Output
from cocoro.frames import Pose2
from cocoro.messages import BaseCommand, TargetEstimate
from cocoro.robot import Robot
from cocoro.units import Vec3
from services.planning.arm import ArmController, ArmStep
from services.planning.config import PlanningConfig
from services.planning.floor_map import FloorMap
from services.planning.gaze import Gaze, gaze_of
from services.planning.hand import Grip, aside_m, side_room_m, widest_m
from services.planning.head import Aim, CameraTilt
from services.planning.navigation import GENTLE, Driver
from services.planning.reach import HandPose, Reacher
from services.planning.reachability import Reachability
from services.planning.state_estimator import StateEstimator
from services.planning.surroundings import Fields, placed, swept_by

State = Literal["running", "done", "failed"]


@dataclass
class Actuators:
    """Controllers of base, arm, hand and head. The planner keeps one set, so that motion stays smooth from one
    behaviour to the next."""

    robot: Robot
    config: PlanningConfig
    driver: Driver = field(init=False)
    reacher: Reacher = field(init=False)
    arm: ArmController = field(init=False)
    grip: Grip = field(init=False)
    gaze: Gaze = field(init=False)
    reachability: Reachability = field(init=False)
    unfolding: FloatArray = field(init=False)
    """Places on the floor, (n, 2), body frame, m, over which the arm swings when it unfolds."""
    camera_tilt: CameraTilt = field(init=False)
    camera_m: float = field(init=False)
    """Height of the camera above the floor."""
    ready_on_the_way: bool = True
    """The hand gets ready for a target while the base drives. Otherwise it stays parked until the base stands."""
    grasp_height_m: float = 0.065
    """Height at which the held object was grasped, and at which it is put down."""

    def __post_init__(self) -> None:
        config, robot = self.config, self.robot
        self.driver = Driver(config.navigation, robot.base)
        self.reacher = Reacher(robot, config.arm.damping)
        self.arm = ArmController(robot, config.arm, self.reacher)
        self.grip = Grip(robot, config.hand)
        self.widest_m = widest_m(robot, config.hand)
        self.gaze = gaze_of(robot, config.head)
        self.reachability = Reachability(config.arm, self.reacher)
        self.unfolding = self._unfolding()
        self.camera_tilt = CameraTilt(robot)
        self.camera_m = float(robot.camera_chain.pose(dict.fromkeys(robot.joints, 0.0))[2, 3])

    def _unfolding(self) -> FloatArray:
        arm = ArmController(self.robot, self.config.arm, self.reacher)
        angles = dict.fromkeys(self.robot.joints, 0.0) | self.robot.poses["park"]
        travel = self.config.arm
        goal = HandPose(travel.travel_radius_m, 0.0, travel.travel_height_m, travel.pitch_rad)
        hulls = []
        for number in range(500):
            step = arm.reach(goal, travel.hand_speed_mps, angles, 0.02)
            angles.update(zip(self.robot.arm.joints, step.goal_rad.tolist(), strict=True))
            angles[self.robot.arm.roll] = step.roll_rad
            if number % 5 == 0:
                hulls.append(arm.clearance.hull(angles))
            if step.arrived:
                break
        return swept_by(hulls)


@dataclass(frozen=True)
class Snapshot:
    """State of the robot and its surroundings in one step."""

    now_ns: int
    dt_s: float
    estimator: StateEstimator
    body: Pose2
    angles: Mapping[str, float]
    actuators: Actuators

    @property
    def looks_rad(self) -> tuple[float, float]:
        """Where the camera looks: pan and tilt, as `services.planning.gaze` counts them."""
        return self.actuators.gaze.direction(self.angles, self.body)

    def target(self, label: str) -> TargetEstimate | None:
        return self.estimator.memory.estimate(label, self.body, self.now_ns)

    CONFIRMED: ClassVar[int] = 2
    CLEAR_M: ClassVar[float] = 0.03

    def confirmed(self, label: str) -> bool:
        """Whether a target was seen repeatedly: one sighting may be a mistake."""
        return self.estimator.memory.sightings(label) >= self.CONFIRMED

    def clear(self, target: TargetEstimate) -> bool:
        """Whether a target's place is known well enough to go there: its sighting was not cut off or hidden in part."""
        return target.sigma_m < self.CLEAR_M

    def fields(self, label: str, ignore: tuple[tuple[float, float, float], ...] = ()) -> Fields:
        """Distance fields of the obstacles for body and arm on the way to a label; `ignore` has circles (x, y, radius),
        odometry frame, m, in which the map is ignored."""
        known = [item for item in self.estimator.memory.all(self.body, self.now_ns, sure=True) if item.label != label]
        target = self.target(label)
        if target is not None:
            known.append(target)
        return self.estimator.around.fields(label, known, self.now_ns, ignore)

    @property
    def stands_around(self) -> tuple[FloorMap, tuple[tuple[float, float, float], ...]]:
        """The floor map, and the discs (x, y, radius), odometry frame, m, of the known objects."""
        around = self.estimator.around
        return around.floor, around.discs(self.estimator.memory.all(self.body, self.now_ns, sure=True))

    def unseen_under_swing(self) -> tuple[float, float] | None:
        """Middle of the unseen floor under the arm's swing, odometry frame, m; None when all of it was seen. The floor
        under the robot does not count."""
        places = placed(self.actuators.unfolding, self.body)
        away = places[np.hypot(places[:, 0] - self.body.x_m, places[:, 1] - self.body.y_m) > 0.33]
        hidden = away[self.estimator.around.unseen(away)]
        if len(hidden) < 4:
            return None
        x, y = hidden.mean(axis=0).tolist()
        return x, y

    @property
    def holding(self) -> bool:
        return self.actuators.grip.holding(self.now_ns)

    @property
    def standing(self) -> bool:
        base = self.estimator.base
        return base is not None and base.standing

    def stand(self) -> BaseCommand:
        return self.actuators.driver.brake(self.dt_s)

    def still(self) -> ArmStep:
        return self.actuators.arm.hold(self.angles, self.dt_s)

    def fold(self) -> ArmStep:
        return self.actuators.arm.park(self.angles, self.dt_s)

    @property
    def folded(self) -> bool:
        """Whether the arm is folded."""
        return self.actuators.arm.parked(self.angles)

    @property
    def turning_radps(self) -> float:
        """Rate at which the base turns; infinite while that is not known."""
        base = self.estimator.base
        return base.turn_rate_radps if base is not None else inf

    def turn(self, left_rad: float, most_radps: float) -> BaseCommand:
        """Turn on the spot by the rest of an angle, at most so fast."""
        rate = self.actuators.config.navigation.turn_gain_per_s * left_rad
        return self.actuators.driver.command(0.0, min(max(rate, -most_radps), most_radps), self.dt_s, pace=GENTLE)

    AHEAD_M: ClassVar[float] = 0.55

    def floor_before(self, target: TargetEstimate) -> Vec3:
        """Floor near the robot on the straight way to a target, body frame, m, which is looked at with the target."""
        x, y, _ = target.position_m
        share = min(self.AHEAD_M / max(planar_m(target), 1e-6), 1.0)
        return share * x, share * y, 0.0

    def aside_m(self, label: str) -> float:
        """How far to the left of a target's centre, m, the hand's axis goes to grasp it."""
        robot, width_m = self.actuators.robot, self.estimator.width_m(label)
        return aside_m(robot, width_m, side_room_m(robot, self.actuators.config.hand, width_m))

    def too_wide(self, label: str) -> str:
        """The reason for which the open hand does not go around a target; '' when it does."""
        width_m, most_m = self.estimator.width_m(label), self.actuators.widest_m
        return (
            f"it is {1e3 * width_m:.0f} mm wide, the open hand takes {1e3 * most_m:.0f} mm" if width_m > most_m else ""
        )

    def at_rest(self, target: TargetEstimate) -> Vec3:
        """Where a target will be, body frame, m, when the robot has braked."""
        x, y, z = target.position_m
        return x - self.actuators.driver.coast_m, y, z

    def look_at(self, point_m: Vec3, *others_m: Vec3) -> Aim:
        """Aim of the camera, with its speed, for a point in the body frame, m, and for a picture that also shows the
        first of the others that is near enough."""
        pan, tilt = self.actuators.gaze.at(point_m, others_m, self.angles, self.body)
        return Aim(pan, tilt, self.actuators.config.head.fixate_speed_radps)

    def looking(self, why: str, aim: Aim | None, distance_m: float | None = None) -> Plan:
        """The plan of a robot that stands to look; one without a neck turns there, its arm folded."""
        gaze = self.actuators.gaze
        base, arm = gaze.turn(aim, self), gaze.arm(self)
        plan = Plan(base, arm, why, aim, distance_m=distance_m)
        if arm.blocked:
            plan.base, plan.state, plan.reason = self.stand(), "failed", "blocked"
            plan.why = "the arm's way to the park pose is blocked, and the base cannot turn to look before it is folded"
        return plan


@dataclass
class Plan:
    """Commands of one step, their reason, and the state of the behaviour."""

    base: BaseCommand
    arm: ArmStep
    why: str
    head: Aim | None = None
    """What a neck turns the camera to; None leaves it at the goal before. A base that serves as the neck does what
    `base` says (`Snapshot.looking`)."""
    state: State = "running"
    reason: str = ""
    distance_m: float | None = None
    reports: list[Output] = field(default_factory=list)
    """Messages to publish beside the planner's status: samples of babbling."""


class Behaviour(Protocol):
    """Carries out one action. Made when the action is asked for, then stepped at the planner's rate until it reports
    `done` or `failed`."""

    @property
    def needs_sight(self) -> bool:
        """Whether it drives or looks for something, so that it pauses while perception is late."""

    def step(self, snapshot: Snapshot) -> Plan: ...


def planar_m(target: TargetEstimate) -> float:
    """Distance over the floor from the body's centre, m."""
    return hypot(target.position_m[0], target.position_m[1])


def hand_place(snapshot: Snapshot) -> tuple[float, float, float]:
    """Centre between the pads, body frame, m."""
    x, y, z = snapshot.actuators.reacher.position(snapshot.angles).tolist()
    return x, y, z
