"""The tools of operators and of components' authors, and their options; `app` takes them in."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from typing import Annotated

import typer

from apps.cli.options import JsonOption, KeyArgument, MeshOption, RobotChoice, RobotOption

PANEL = "Tools"

new = typer.Typer(no_args_is_help=True, help="Write a component from a template: `cocoro new service NAME`.")


def add_to(app: typer.Typer) -> None:
    for command in (top, echo, hz, logs):
        app.command(rich_help_panel=PANEL)(command)
    app.add_typer(new, name="new", rich_help_panel=PANEL)


def top(
    once: Annotated[bool, typer.Option("--once", help="Show it once; exit code 1 when something is missing.")] = False,
    every: Annotated[float, typer.Option(min=0.1, max=60.0, metavar="S", help="How often it is shown anew.")] = 1.0,
    robot: RobotOption = None,
    profile: MeshOption = None,
    json: JsonOption = False,
) -> None:
    """What runs and what travels, live: cpu, memory, rates against nominal, ages, what was skipped, lost, rejected.

    Ctrl-C ends it. Counts are since the start; what is wrong now, or grows and should not, is red.
    """
    from apps.cli import top as showing

    sys.exit(asyncio.run(showing.top(RobotChoice(robot, profile), once, json, every)))


def echo(
    key: KeyArgument,
    count: Annotated[int | None, typer.Option("--count", "-n", min=1, help="End after so many messages.")] = None,
    seconds: Annotated[float | None, typer.Option("--for", min=0.1, metavar="S", help="End after so long.")] = None,
    full: Annotated[bool, typer.Option("--full", help="All elements of long lists.")] = False,
    robot: RobotOption = None,
    profile: MeshOption = None,
    json: JsonOption = False,
) -> None:
    """What travels on a key, decoded, of whatever type it is; what a reader would reject is marked with its reason."""
    from apps.cli import echo as echoing

    sys.exit(asyncio.run(echoing.echo(RobotChoice(robot, profile), key, count, seconds, json, full)))


def hz(
    key: KeyArgument,
    window: Annotated[float, typer.Option(min=0.5, max=600.0, metavar="S", help="What the figures are of.")] = 5.0,
    once: Annotated[bool, typer.Option("--once", help="Measure one window and end.")] = False,
    robot: RobotOption = None,
    profile: MeshOption = None,
    json: JsonOption = False,
) -> None:
    """How often, how evenly and how much travels on a key, as it arrives here, over the last seconds."""
    from apps.cli import hz as measuring

    sys.exit(asyncio.run(measuring.hz(RobotChoice(robot, profile), key, window, once, json)))


def logs(
    service: Annotated[str | None, typer.Argument(help="A process or a service; all when there is none.")] = None,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Go on with what comes, until Ctrl-C.")] = False,
    lines: Annotated[int, typer.Option("--lines", "-n", min=0, help="So many of the newest entries first.")] = 100,
    level: Annotated[
        str | None, typer.Option(metavar="LEVEL", help="Only these and graver: debug, info, warning, error.")
    ] = None,
    robot: Annotated[str | None, typer.Option(help="Which robot, up or not.")] = None,
) -> None:
    """What the robot's processes on this machine wrote since their start, all in one order. Works when it is down."""
    from apps.cli import logs as reading

    sys.exit(asyncio.run(reading.logs(robot, service, follow, lines, level)))


@new.callback()
def _new() -> None:
    """Has a command of its own even while there is but one."""


@new.command()
def service(
    name: Annotated[str, typer.Argument(help="Of the service, which is the first part of its keys: nearest.")],
    into: Annotated[Path, typer.Option(metavar="DIR", help="Where its folder goes.")] = Path(),
) -> None:
    """A working component with its test, as a package of your own: see docs/components.md."""
    from apps.cli import new as writing

    sys.exit(writing.service(name, into))
