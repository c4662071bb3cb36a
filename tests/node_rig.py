"""Nodes on a local bus in virtual time."""

from __future__ import annotations

from typing import Any

from cocoro.bus.local import LocalMesh
from cocoro.clock import Clock, VirtualClock
from cocoro.messages import BaseState, CancelRequest, TaskReply
from cocoro.robot import Robot
from cocoro.testing import Tap
from deploy.delayed import DelayedNode

ROBOT = Robot.load()
HERE: dict[str, Any] = {"odometry_m": (0.0, 0.0), "odometry_yaw_rad": 0.0, "speed_mps": 0.0, "turn_rate_radps": 0.0}


class Mesh:
    """A mesh for the nodes of a test."""

    def __init__(self, clock: Clock | None = None) -> None:
        self.mesh = LocalMesh()
        self.clock = clock or VirtualClock()

    def node(self, name: str, **options: Any) -> DelayedNode:
        return DelayedNode(name, self.mesh.join(), self.clock, ROBOT, **options)

    def tap(self) -> Tap:
        return Tap(self.mesh.join(), ROBOT.name)


def state(**fields: Any) -> BaseState:
    return BaseState(**(HERE | fields))


async def answered(question: CancelRequest) -> TaskReply:
    """A handler of a request."""
    return TaskReply(accepted=True, task_id=question.task_id)
