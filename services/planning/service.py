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
    """The planner's pure core."""
    return PlanningCore(robot, config)


async def run(node: Node, config: PlanningConfig) -> None:
    """Run the planner: at a fixed rate, and when a detection arrives."""
    await plan(node, config, core(node.robot, config))


async def plan(node: Node, config: PlanningConfig, planner: PlanningCore) -> None:
    """Step a planner and serve requests to take over a learned model."""
    if config.model:
        node.log.info("reaching: %s", planner.learned.text)

    async def take(request: ModelRequest) -> ModelReply:
        """Check the model, and publish it: the core takes it from its topic, so that it is recorded."""
        try:
            decode(request.content, node.robot, "from the mesh")
        except ConfigError as error:
            return ModelReply(accepted=False, text=f"{error}; it goes on with: {planner.learned.text}")
        node.publish(MODEL, LearnedModel(content=request.content))
        return ModelReply(accepted=True, text="taken over")

    node.serve(LEARNED, take)
    await node.drive(planner)


implementation = Implementation(PlanningConfig, run, core)
