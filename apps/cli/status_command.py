"""`cocoro status`, with its options."""

from __future__ import annotations

import asyncio
import sys

import typer

from apps.cli.options import JsonOption, RobotChoice, RobotOption, ThroughOption
from apps.cli.status import show_status

app = typer.Typer()


@app.command()
def status(robot: RobotOption = None, site: ThroughOption = None, json: JsonOption = False) -> None:
    """The running services, their health, the task and the planner's reason. Exit code 1 when a service is missing."""
    sys.exit(asyncio.run(show_status(RobotChoice(robot, site), json)))
