"""`cocoro estop`, `stop` and `reset`: the emergency stop among the commands.

`main` runs `estop` and `stop` before it imports any of this; here they only have their place in `cocoro --help`.
"""

from __future__ import annotations

import asyncio
import sys

import typer

from apps.cli import estop as stopping
from apps.cli import exits
from apps.cli.link import Answer, joined
from apps.cli.options import JsonOption, RobotChoice, RobotOption, ThroughOption
from apps.cli.output import complain, print_json
from cocoro.errors import MeshError
from cocoro.messages import EstopReply, ResetRequest
from cocoro.topics import RESET
from deploy.processes import stoppable

app = typer.Typer()
CONTEXT = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}


@app.command(context_settings=CONTEXT)
def stop(context: typer.Context) -> None:
    """Emergency stop, now: everything that moves stands still until `reset`."""
    sys.exit(stopping.main("stop", context.args))


@app.command(context_settings=CONTEXT)
def estop(context: typer.Context) -> None:
    """Emergency stop: the same command as `stop`."""
    sys.exit(stopping.main("estop", context.args))


@app.command()
def reset(robot: RobotOption = None, site: ThroughOption = None, json: JsonOption = False) -> None:
    """Release the emergency stop. The executive may refuse; the command then prints its reason."""
    sys.exit(asyncio.run(release(RobotChoice(robot, site), json)))


async def release(choice: RobotChoice, as_json: bool = False) -> int:
    """Releases a robot's latches; returns the exit code. Raises MeshError when nothing that moves is alive.

    The executive is asked first: when it refuses, everything stays latched.
    """
    question = ResetRequest(by="operator")
    async with joined(choice) as link:
        alive = await link.alive()
        moving = {service for service in stoppable() if service in alive}
        if not moving:
            raise MeshError(f"no service that moves something is alive on {link.robot}: see `cocoro status`")
        if "executive" in alive and _refused({"executive"}, await link.call_all(RESET.of("executive"), question)):
            return exits.REFUSED
        answers = await link.call_all(RESET.of("*"), question)
        if _refused(moving, answers):
            return exits.REFUSED
    if as_json:
        print_json({"robot": link.robot, "released": sorted(moving)})
    else:
        print(f"{link.robot}: released {', '.join(sorted(moving))}")
    for answer in answers:
        if answer.reply is not None and answer.reply.text:
            complain(f"{answer.service}: {answer.reply.text}")
    return exits.DONE


def _refused(wanted: set[str], answers: list[Answer[EstopReply]]) -> bool:
    """Whether any of the `wanted` services did not release its latch; prints which and why."""
    by_service = {answer.service: answer for answer in answers}
    refused = False
    for service in sorted(wanted):
        answer = by_service.get(service, Answer(service, None, "no answer"))
        if answer.reply is None or answer.reply.latch != "released":
            why = answer.error or (answer.reply.text if answer.reply else "") or "it is still latched"
            complain(f"{service} does not release the emergency stop: {why}")
            refused = True
    return refused
