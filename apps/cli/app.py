"""The commands of `cocoro`, in the order in which its help lists them.

`cocoro --help` needs this file and `task_commands`. A command's own file has its options and what it does; it is
imported when the command is called, so it may import whatever it needs. The commands of tasks (`cocoro fetch`) are made
from the types of tasks by `task_commands`; `tasks` sends the request and follows the task to its outcome.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_group

TASKS, WATCH, RUNNING, SAFETY = "Tasks", "Watching", "Starting and stopping", "Safety"
CAPTURES, TOOLS, HARDWARE, LEARNING = "Captures", "Tools", "Hardware", "Learning"


class CommandRow(NamedTuple):
    """A command as `cocoro --help` lists it. The summary begins the command's own help, too."""

    name: str
    panel: str
    summary: str
    hidden: bool = False


COMMANDS = (
    CommandRow("cancel", TASKS, "End the running task; the robot stands still."),
    CommandRow("rehearse", TASKS, "Try a task in simulation: the whole robot in one process, in virtual time."),
    CommandRow("status", WATCH, "The running services, their health, the task and the planner's reason."),
    CommandRow("objects", WATCH, "The objects that the robot knows, and where it saw each last; `learn` adds one."),
    CommandRow("snapshot", WATCH, "Write a picture of what the robot sees now, with its detections drawn in."),
    CommandRow(
        "topics",
        WATCH,
        "List the topics and requests of all installed components: type, rate, age, quality of service, publisher.",
    ),
    CommandRow("capture", CAPTURES, "Look at capture files, repair them, re-execute services on them."),
    CommandRow("record", CAPTURES, "Record what travels on the mesh into MCAP files, until Ctrl-C."),
    CommandRow("replay", CAPTURES, "Send a capture into the mesh again."),
    CommandRow(
        "export",
        CAPTURES,
        "Turn a capture into a film, tables, or a file for Foxglove or Rerun; or extract its attachments.",
    ),
    CommandRow("view", CAPTURES, "Open Rerun on a capture, or live on the mesh."),
    CommandRow(
        "top",
        TOOLS,
        "Services and topics, live: cpu, memory, rates against nominal, ages, and what was skipped, lost or rejected.",
    ),
    CommandRow(
        "echo",
        TOOLS,
        "The messages of a key, decoded, of any type; a message that a reader would reject is marked with the reason.",
    ),
    CommandRow("hz", TOOLS, "Rate, jitter and amount of data on a key, as it arrives here, over the last seconds."),
    CommandRow("logs", TOOLS, "Logs of the robot's processes on this machine since their start, merged by time."),
    CommandRow("new", TOOLS, "Write a component (`new service NAME`) or a task (`new task NAME`) from a template."),
    CommandRow(
        "base", HARDWARE, "Show the base: mode, battery, bumpers, odometry; `recover` puts it back into its mode."
    ),
    CommandRow("servos", HARDWARE, "Find, set up, calibrate, hold and relax the servos; clear their faults."),
    CommandRow("kinect", HARDWARE, "Calibrate the Kinect; tilt it."),
    CommandRow(
        "doctor", HARDWARE, "Check a machine and its robot before a run; each line is well, or says what to do."
    ),
    CommandRow(
        "babble",
        LEARNING,
        "Move to collect samples for learning: the arm with the hand in view, the wheels with a target.",
    ),
    CommandRow("learn", LEARNING, "Learn a model for the planner from the samples of babbling."),
    CommandRow(
        "experiment",
        LEARNING,
        "Run the paper's experiments in virtual time and report them beside the paper's text and baselines.",
    ),
    CommandRow(
        "up", RUNNING, "Start a robot's processes and stay until Ctrl-C (or, with --detach, until they are ready)."
    ),
    CommandRow("down", RUNNING, "Stop a robot's processes."),
    CommandRow("run", RUNNING, "Run one process in this terminal, on the mesh of the profile."),
    CommandRow("estop", SAFETY, "Emergency stop, now: everything that moves stands still until `reset`."),
    CommandRow("stop", SAFETY, "Short for estop.", hidden=True),
    CommandRow("reset", SAFETY, "Release the emergency stop."),
)


def load(name: str) -> TyperCommand | TyperGroup:
    """Imports the file of a command and returns the command."""
    match name:
        case "cancel" | "rehearse":
            from apps.cli.task_commands import app
        case "status":
            from apps.cli.status import app
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
        case "export" | "view":
            from apps.cli.export import app
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
            listed = TyperCommand(row.name, help=row.summary, rich_help_panel=row.panel, hidden=row.hidden)
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
        name, command, rest = super().resolve_command(ctx, args)
        return name, command if name is None or name not in _NAMES else load(name), rest


_NAMES = frozenset(row.name for row in COMMANDS)

app = typer.Typer(
    cls=CommandGroup,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Start, command and watch a CoCoRo robot.\n\n"
    "First `cocoro up sim --detach`, then `cocoro fetch red_can`, at last `cocoro down`.",
    epilog="Exit codes: 0 done, 1 the task failed, 2 bad usage, 3 refused or cancelled, 4 the mesh is not there.",
)
