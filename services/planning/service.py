"""The planner as a service."""

from __future__ import annotations

from cocoro.node import Node
from services.planning.config import Config
from services.planning.core import PlanningCore

__all__ = ["Config", "run"]


async def run(node: Node, config: Config) -> None:
    """Plan for ever: at a fixed rate, and at once when a new detection arrives."""
    await node.drive(PlanningCore(node.robot, config))
