"""`cocoro estop`, `stop` and `reset`: the emergency stop among the commands.

`main` runs `estop` and `stop` before it imports any of this; here they only have their place in `cocoro --help`.
"""

from __future__ import annotations

import asyncio
import sys

import typer

from apps.cli import estop as stopping
from apps.cli import exits
from apps.cli.link import joined
from apps.cli.options import JsonOption, RobotChoice, RobotOption, ThroughOption
from apps.cli.output import complain, print_json
from apps.client import stopping as stopping_by_mesh
from apps.client.stopping import NotReleasedError

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
    async with joined(choice) as link:
        try:
            released = await stopping_by_mesh.release(link, "operator")
        except NotReleasedError as error:
            for reason in error.reasons:
                complain(reason)
            return exits.REFUSED
    if as_json:
        print_json({"robot": link.robot, "released": list(released.services)})
    else:
        print(f"{link.robot}: released {', '.join(released.services)}")
    for note in released.notes:
        complain(note)
    return exits.DONE
