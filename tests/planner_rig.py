"""Steps the planner's core by hand, with fresh inputs except those that a test withholds."""

from __future__ import annotations

from typing import Any

from spelled import action, idle

from cocoro import topics
from cocoro.joints import Group
from cocoro.messages import (
    BaseCommand,
    BaseState,
    Detection,
    Detections,
    Intent,
    Message,
    Motion,
    Obstacles,
    PlannerStatus,
    ServoCommand,
    ServoState,
)
from cocoro.robot import Robot
from cocoro.testing import CoreUnderTest
from cocoro.topics import Topic
from services.planning.config import PlanningConfig
from services.planning.core import PlanningCore

ROBOT = Robot.load()
TICK_S = 0.02
CAN_M = (1.5, 0.0, 0.06)
SHOWN = {topics.PLAN.name, topics.FLOOR_PLAN.name}
"""What it publishes that commands nothing."""


class Planner:
    """A planning core on a robot that follows all commands except to the wheels, and sees a can and free floor."""

    def __init__(
        self, config: PlanningConfig | None = None, make: type[PlanningCore] = PlanningCore, robot: Robot = ROBOT
    ) -> None:
        self.under_test = CoreUnderTest(make(robot, config or PlanningConfig()))
        self.angles = dict.fromkeys(ROBOT.joints, 0.0) | ROBOT.poses["park"]
        self.base: dict[str, Any] = {}
        self.hand_load = 0.0
        self.latch = "released"
        self.wants: Intent | None = idle()
        self.motion: Motion | None = None
        """What the operator's hand wants."""
        self.sees: tuple[float, float, float] | None = CAN_M
        self.free: tuple[tuple[float, float, float], ...] = tuple((k * 0.1, 0.2, 3.0) for k in range(-31, 32))
        """Free floor: bearings, and distances from and to."""
        self.points: tuple[tuple[float, float, float], ...] = ()
        """Obstacles, body frame."""
        self.silent: set[str] = set()
        self.incarnation = 1
        self._count = 0

    def tick(self) -> PlannerStatus:
        """One step, 20 ms later, with fresh messages of all topics that are not silent."""
        test = self.under_test
        test.now_ns += round(TICK_S * 1e9)
        here = {"odometry_m": (0.0, 0.0), "odometry_yaw_rad": 0.0, "speed_mps": 0.0, "turn_rate_radps": 0.0}
        self._feed(topics.BASE_STATE, BaseState(**(here | self.base), latch=self.latch))  # type: ignore[arg-type]
        self._feed(topics.ARM_STATE, self._servos("arm"))
        self._feed(topics.HAND_STATE, self._servos("hand"))
        if self.wants is not None:
            wants = self.wants
            self._feed(
                topics.INTENT,
                Intent(
                    task_id=wants.task_id,
                    step=wants.step,
                    action=wants.action,
                    motion=self.motion,
                    motion_until_ns=test.now_ns + round(0.2e9) if self.motion is not None else 0,
                ),
            )
        if self._count % 2 == 0:
            self._feed(topics.DETECTIONS, self._seen())
            self._feed(topics.OBSTACLES, Obstacles(free=self.free, points_m=self.points))
        self._count += 1
        test.step()
        status = self.status
        for output in test.steps[-1]:
            if isinstance(output.message, ServoCommand):
                self.angles.update(zip(output.message.joints, output.message.goal_rad, strict=True))
        return status

    def run(self, seconds: float) -> PlannerStatus:
        for _ in range(round(seconds / TICK_S)):
            status = self.tick()
        return status

    def want(self, name: str, label: str = "", **more: Any) -> None:
        step = self.wants.step + 1 if self.wants is not None else 1
        self.wants = Intent(task_id="task", step=step, action=action(name, label, **more))

    @property
    def status(self) -> PlannerStatus:
        return self.under_test.latest(topics.PLAN)

    @property
    def wheels(self) -> BaseCommand:
        return self.under_test.latest(topics.BASE_COMMAND)

    @property
    def commanded(self) -> set[str]:
        """The topics of the last step's commands."""
        return {output.topic.name for output in self.under_test.steps[-1]} - SHOWN

    def _feed(self, topic: Topic[Any], message: Message) -> None:
        if topic.name not in self.silent:
            self.under_test.feed(topic, message, incarnation=self.incarnation)

    def _servos(self, group: Group) -> ServoState:
        joints = ROBOT.group_joints(group)
        loads = {claw: -sign * self.hand_load for claw, sign in ROBOT.claw.open_sign.items()}
        return ServoState(
            joints=joints,
            position_rad=tuple(self.angles[name] for name in joints),
            speed_radps=(0.0,) * len(joints),
            load=tuple(loads.get(name, 0.0) for name in joints),
            latch=self.latch,  # type: ignore[arg-type]
        )

    def _seen(self) -> Detections:
        can = Detection(label="red_can", u_px=0, v_px=0, area_px=900, box_px=(0, 0, 9, 9), position_m=self.sees)
        found = (can,) if self.sees is not None else ()
        return Detections(frame_seq=0, frame_incarnation=1, width=640, height=480, detections=found)


def started(config: PlanningConfig | None = None, make: type[PlanningCore] = PlanningCore) -> Planner:
    """A planner that has received all inputs."""
    planner = Planner(config, make)
    planner.run(0.2)
    return planner


def standing(planner: Planner) -> bool:
    """Whether zero is commanded to the wheels, or nothing, which also stops them."""
    return planner.wheels == BaseCommand(ahead_mps=0.0, turn_radps=0.0) if "base/command" in planner.commanded else True
