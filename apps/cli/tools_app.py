"""`cocoro echo` and `cocoro new`."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from typing import Annotated

import typer

from apps.cli.options import JsonOption, KeyArgument, MeshOption, RobotChoice, RobotOption

app = typer.Typer()
new = typer.Typer(no_args_is_help=True, help="Write a component from a template: `cocoro new service NAME`.")
app.add_typer(new, name="new")


@app.command()
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
