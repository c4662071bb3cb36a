"""`cocoro reset`: the emergency stop is released by hand, and only when the executive agrees."""

from __future__ import annotations

import sys

from apps.cli import exits
from apps.cli.link import Answer, joined
from apps.cli.options import RobotChoice
from cocoro.errors import MeshError
from cocoro.messages import EstopReply, EstopRequest
from cocoro.topics import ESTOP
from deploy.processes import stoppable


async def reset(where: RobotChoice) -> int:
    """The executive is asked first: when it refuses, everything stays latched."""
    question = EstopRequest(latched=False, by="operator")
    async with joined(where) as link:
        alive = await link.alive()
        moving = {service for service in stoppable() if service in alive}
        if not moving:
            raise MeshError(f"nothing that moves is alive on {link.robot}: `cocoro status` tells more")
        if "executive" in alive and _refused({"executive"}, await link.call_all(ESTOP.of("executive"), question)):
            return exits.REFUSED
        answers = await link.call_all(ESTOP.of("*"), question)
        if _refused(moving, answers):
            return exits.REFUSED
    print(f"{link.robot}: released {', '.join(sorted(moving))}")
    for answer in answers:
        if answer.reply is not None and answer.reply.text:
            print(f"cocoro: {answer.service}: {answer.reply.text}", file=sys.stderr)
    return exits.DONE


def _refused(wanted: set[str], answers: list[Answer[EstopReply]]) -> bool:
    """Whether any of these has not released; says which and why."""
    by_service = {answer.service: answer for answer in answers}
    refused = False
    for service in sorted(wanted):
        answer = by_service.get(service, Answer(service, None, "no answer"))
        if answer.reply is None or answer.reply.latch != "released":
            why = answer.error or (answer.reply.text if answer.reply else "") or "it is still latched"
            print(f"cocoro: {service} does not release the emergency stop: {why}", file=sys.stderr)
            refused = True
    return refused
