"""The planner as a service."""

from __future__ import annotations

from cocoro.node import Node
from cocoro.robot import Robot
from services.planning.config import Config
from services.planning.core import PlanningCore

__all__ = ["Config", "core", "run"]


def core(robot: Robot, config: Config) -> PlanningCore:
    """The planner's maths."""
    return PlanningCore(robot, config)


async def run(node: Node, config: Config) -> None:
    """Plan for ever: at a fixed rate, and at once when a new detection arrives."""
    await node.drive(core(node.robot, config))
