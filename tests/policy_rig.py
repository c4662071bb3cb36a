"""Policies in Python, for tests of the service that runs them, and a robot in virtual time that has them.

They name no joint: what they want is said by the poses of the robot's description.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from robot_rig import SERVICES, SMALL_FRAMES, RobotRig
from spelled import asked

from cocoro.features import STATE, PolicyFeatures, names_of
from cocoro.messages import TaskState
from cocoro.policy import Observation
from cocoro.robot import Robot
from cocoro.topics import RUN

RATE_HZ = 15.0
CHUNK = 10
AHEAD = -2
"""Place of the speed ahead among the values of an action."""


class Fixed:
    """Proposes the same values again and again: what the state has, with some of them changed."""

    def __init__(self, robot: Robot, **how: Any) -> None:
        names = tuple(names_of(robot))
        self.robot = robot
        self.features = PolicyFeatures(state=names, action=names, rate_hz=RATE_HZ, chunk=CHUNK, **how)
        self.seen: list[Observation] = []
        self.resets = 0

    def reset(self) -> None:
        self.resets += 1

    def act(self, observation: Observation) -> Any:
        self.seen.append(observation)
        row = observation[STATE].astype(np.float64)
        row[AHEAD:] = 0.0
        return np.tile(self.changed(row, observation), (CHUNK, 1))

    def changed(self, row: Any, observation: Observation) -> Any:
        return row

    def set(self, row: Any, goals: Mapping[str, float]) -> Any:
        for joint, goal in goals.items():
            row[list(self.robot.joints).index(joint)] = goal
        return row


class Out(Fixed):
    """Brings the arm to the pose `upright`, by way of the plane that it parks in, then says that it has finished."""

    NEAR_RAD = 0.08

    def act(self, observation: Observation) -> Any:
        if self._away(observation, self.robot.poses["upright"]) < self.NEAR_RAD:
            return None
        return super().act(observation)

    def changed(self, row: Any, observation: Observation) -> Any:
        arm, poses = self.robot.arm, self.robot.poses
        azimuth = row[list(self.robot.joints).index(arm.azimuth)]
        unfolded = self._away(observation, poses["unfolded"]) < self.NEAR_RAD
        if azimuth > 0.6 and not unfolded:
            return self.set(row, poses["unfolded"])
        if azimuth > 0.35:
            return self.set(row, {**poses["unfolded"], arm.azimuth: poses["upright"][arm.azimuth]})
        return self.set(row, poses["upright"])

    def _away(self, observation: Observation, pose: Mapping[str, float]) -> float:
        angles = dict(zip(self.robot.joints, observation[STATE].tolist(), strict=False))
        return float(max(abs(angles[joint] - goal) for joint, goal in pose.items()))


class Into(Out):
    """Brings the arm to the front, then stretches it out and drives ahead, whatever is there."""

    out = False

    def reset(self) -> None:
        super().reset()
        self.out = False

    def act(self, observation: Observation) -> Any:
        self.out |= self._away(observation, self.robot.poses["upright"]) < self.NEAR_RAD
        return Fixed.act(self, observation)

    def changed(self, row: Any, observation: Observation) -> Any:
        if not self.out:
            return super().changed(row, observation)
        row[AHEAD] = 0.3
        _, shoulder, elbow, wrist = self.robot.arm.joints
        return self.set(row, {**self.robot.poses["upright"], shoulder: 0.2, elbow: -0.3, wrist: 0.1})


class Ahead(Fixed):
    """Drives ahead as fast as it can."""

    def changed(self, row: Any, observation: Observation) -> Any:
        row[AHEAD] = 0.5
        return row


class Impossible(Fixed):
    """Wants every joint far beyond what it can do, one way and then the other."""

    def changed(self, row: Any, observation: Observation) -> Any:
        row[:AHEAD] = 40.0 if len(self.seen) // 10 % 2 else -40.0
        row[AHEAD:] = 900.0, -900.0
        return row


class NotFinite(Fixed):
    def changed(self, row: Any, observation: Observation) -> Any:
        row[1] = np.nan
        return row


class TooShort(Fixed):
    def act(self, observation: Observation) -> Any:
        return np.zeros((CHUNK, 3))


class Broken(Fixed):
    def act(self, observation: Observation) -> Any:
        raise ZeroDivisionError("a bug")


class Other(Fixed):
    """Made for a robot with other joints."""

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot)
        names = ("third_elbow.pos", *self.features.state[1:])
        self.features = PolicyFeatures(state=names, action=names, rate_hz=RATE_HZ)


class Wide(Fixed):
    """Looks at larger pictures than the robot's."""

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot, width=1280, height=960)


class Looking(Fixed):
    """Keeps what it sees, in every picture."""

    last: Looking

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot, width=SMALL_FRAMES["width"], height=SMALL_FRAMES["height"], every=1)
        Looking.last = self

    def changed(self, row: Any, observation: Observation) -> Any:
        return self.set(row, {self.robot.head_joints[0]: 0.5})


NAMES = ("Out", "Into", "Ahead", "Impossible", "NotFinite", "TooShort", "Broken", "Other", "Wide", "Looking", "Fixed")
LISTED = {name.lower(): f"{__name__}:{name}" for name in NAMES}


async def let(robot: RobotRig, name: str, for_s: float) -> TaskState:
    """Let a policy move the robot for a time; returns the task's end."""
    await robot.begin("park")
    await robot.until(lambda: robot.now_s > 3.0)
    reply = await robot.operator.call(RUN, asked("policy", name, for_s=for_s, instead=True))
    assert reply.accepted, reply.text
    return await robot.outcome(reply.task_id)


def rig(settings: Mapping[str, Mapping[str, Any]] | None = None, *more: str, **how: Any) -> RobotRig:
    """A robot with the policies above, each under its name in small letters."""
    given = dict(settings or {})
    given["policy"] = {"policies": LISTED, **given.get("policy", {})}
    return RobotRig(services=(*more, *SERVICES, "policy"), settings={"sim": SMALL_FRAMES} | given, **how)
