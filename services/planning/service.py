"""The planner as a service."""

from __future__ import annotations

from cocoro.component import Implementation
from cocoro.errors import ConfigError
from cocoro.learning.model import decode
from cocoro.messages import LearnedModel, ModelReply, ModelRequest
from cocoro.node import Node
from cocoro.robot import Robot
from cocoro.topics import LEARNED, MODEL
from services.planning.config import PlanningConfig
from services.planning.core import PlanningCore


def core(robot: Robot, config: PlanningConfig) -> PlanningCore:
    """The planner's maths."""
    return PlanningCore(robot, config)


async def run(node: Node, config: PlanningConfig) -> None:
    """Plan for ever: at a fixed rate, and at once when a new detection arrives."""
    await plan(node, config, core(node.robot, config))


async def plan(node: Node, config: PlanningConfig, planner: PlanningCore) -> None:
    """Drives a planner for ever, and serves it learned models."""
    if config.model:
        node.log.info("reaching: %s", planner.learned.text)

    async def take(request: ModelRequest) -> ModelReply:
        """Checked here, so that who sends it hears why not; the core takes what is published, for the record."""
        try:
            decode(request.content, node.robot, "from the mesh")
        except ConfigError as error:
            return ModelReply(accepted=False, text=f"{error}; it goes on with: {planner.learned.text}")
        node.publish(MODEL, LearnedModel(content=request.content))
        return ModelReply(accepted=True, text="taken over")

    node.serve(LEARNED, take)
    await node.drive(planner)


implementation = Implementation(PlanningConfig, run, core)
