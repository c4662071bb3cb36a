"""The description of a robot as its running services state it."""

from __future__ import annotations

from cocoro.errors import MeshError
from cocoro.messages import AboutRequest
from cocoro.participant import Participant
from cocoro.robot import Robot
from cocoro.topics import ABOUT


async def stated_robot(participant: Participant) -> Robot:
    """The robot that the services of a mesh compute with. Raises MeshError where none of them states it, ConfigError
    for a description that this version cannot read."""
    for answer in await participant.call_all(ABOUT.of("*"), AboutRequest()):
        if answer.reply is not None and answer.reply.description is not None:
            name = participant.robot_name
            return Robot.from_data(answer.reply.description, f"description of {name}")
    raise MeshError(f"no service of {participant.robot_name} states the robot's description: see `cocoro status`")
