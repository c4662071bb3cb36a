"""The commands of `cocoro`: `cocoro --help` lists them, and a call imports the file of its command.

`cocoro --help` needs this file, `listed` and `task_commands`. A command's own file has its options and what it does; it
is imported when the command is called, so it may import whatever it needs. The commands of tasks (`cocoro fetch`) are
made from the types of tasks by `task_commands`; `tasks` sends the request and follows the task to its outcome.
"""

from __future__ import annotations

import re
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_group

from apps.cli.former import taking_former
from apps.cli.listed import COMMANDS


def load(name: str) -> TyperCommand | TyperGroup:
    """Imports the file of a command and returns the command."""
    match name:
        case "cancel" | "wait" | "rehearse":
            from apps.cli.task_commands import app
        case "drive":
            from apps.cli.drive import app
        case "status":
            from apps.cli.status_command import app
        case "objects":
            from apps.cli.objects import app
        case "snapshot":
            from apps.cli.snapshot import app
        case "topics":
            from apps.cli.topics import app
        case "capture":
            from apps.cli.capture import app
        case "record":
            from apps.cli.record import app
        case "replay":
            from apps.cli.replay import app
        case "export":
            from apps.cli.export import app
        case "view":
            from apps.cli.view import app
        case "top":
            from apps.cli.top import app
        case "echo":
            from apps.cli.echo import app
        case "new":
            from apps.cli.new import app
        case "hz":
            from apps.cli.hz import app
        case "logs":
            from apps.cli.logs import app
        case "base":
            from apps.cli.base import app
        case "servos":
            from apps.cli.servos import app
        case "kinect":
            from apps.cli.kinect import app
        case "site":
            from apps.cli.site import app
        case "cockpit":
            from apps.cli.cockpit import app
        case "pki":
            from apps.cli.pki import app
        case "doctor":
            from apps.cli.doctor import app
        case "babble":
            from apps.cli.babble import app
        case "learn":
            from apps.cli.learn import app
        case "experiment":
            from apps.cli.experiment import app
        case "up" | "down" | "run":
            from apps.cli.running import app
        case "estop" | "stop" | "reset":
            from apps.cli.safety import app
        case _:
            raise KeyError(name)
    command = get_group(app).commands[name]
    assert isinstance(command, TyperCommand | TyperGroup)
    return command


class CommandGroup(TyperGroup):
    """The group of all commands: it lists COMMANDS and the tasks, and loads a command when it is called."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        for row in COMMANDS:
            listed = TyperCommand(row.name, help=row.summary, rich_help_panel=row.panel)
            self.add_command(listed)

    def list_commands(self, ctx: Any) -> list[str]:
        from apps.cli.task_commands import task_names

        return [*task_names(), *super().list_commands(ctx)]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        command = super().get_command(ctx, cmd_name)
        if command is not None:
            return command
        from apps.cli.task_commands import task_command

        return task_command(cmd_name)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        self._list_tasks(args)
        name, command, rest = super().resolve_command(ctx, args)
        if name is not None and name in _NAMES:
            command = load(name)
        return name, command if command is None else taking_former(with_brackets(command)), rest

    def _list_tasks(self, args: list[str]) -> None:
        """Makes typer suggest tasks, too, for a mistyped command; it looks into `commands` alone."""
        if not args or args[0] in self.commands:
            return
        from apps.cli.task_commands import task_command, task_names

        if task_command(args[0]) is None:
            for name in task_names():
                self.add_command(TyperCommand(name))


_TAG = re.compile(r"\[[a-z#/@][^\[]*?\]")
"""Brackets that `rich.markup` takes for a tag. That module is not imported, since a shell that completes a word would
wait for it."""


def with_brackets(command: Any) -> Any:
    """Escapes the help of a command and of what is below it: typer would take '[view]' for markup and print nothing."""
    for part in (command, *command.params):
        if text := getattr(part, "help", None):
            part.help = _TAG.sub(r"\\\g<0>", text.replace("\\[", "["))
    for below in getattr(command, "commands", {}).values():
        with_brackets(below)
    return command


_NAMES = frozenset(row.name for row in COMMANDS)

app = typer.Typer(
    cls=CommandGroup,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Start, command and watch a CoCoRo robot.\n\n"
    "First `cocoro up sim --detach`, then `cocoro fetch red_can`, at last `cocoro down`.",
    epilog="Exit codes: 0 done, 1 the task failed, 2 bad usage, 3 refused or cancelled, 4 the mesh is not there.",
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version
        from platform import python_version

        print(f"cocoro-mesh {version('cocoro-mesh')}, python {python_version()}, zenoh {version('eclipse-zenoh')}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Show the versions and exit.")
    ] = False,
) -> None:
    """The options before the name of a command."""
