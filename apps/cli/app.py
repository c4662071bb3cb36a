"""The commands of `cocoro`, in the order in which its help lists them.

`cocoro --help` needs this file alone. A command's own file has its options and what it does; it is imported when the
command is called, so it may import whatever it needs.
"""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_group

from apps.cli.options import (
    AdaptOption,
    DescriptionOption,
    DistanceOption,
    ForOption,
    FramesOption,
    JsonOption,
    LatencyOption,
    MeasuredOption,
    MeshOption,
    ModelOption,
    ObjectsOption,
    ReachOption,
    RobotChoice,
    RobotOption,
    TimeoutOption,
)

TASKS, WATCH, RUNNING, SAFETY = "Tasks", "Watching", "Starting and stopping", "Safety"
CAPTURES, TOOLS, HARDWARE, LEARNING = "Captures", "Tools", "Hardware", "Learning"


class CommandRow(NamedTuple):
    """A command as `cocoro --help` lists it. The summary begins the command's own help, too."""

    name: str
    panel: str
    summary: str
    hidden: bool = False


COMMANDS = (
    CommandRow("status", WATCH, "What runs, its health, what the robot does and why."),
    CommandRow("objects", WATCH, "The objects that the robot knows, and where it saw each last; `learn` adds one."),
    CommandRow("snapshot", WATCH, "Write a picture of what the robot sees now, with its detections drawn in."),
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
        "What runs and what travels, live: cpu, memory, rates against nominal, ages, what was skipped, lost, rejected.",
    ),
    CommandRow(
        "echo",
        TOOLS,
        "What travels on a key, decoded, of whatever type it is; what a reader would reject is marked with its reason.",
    ),
    CommandRow("hz", TOOLS, "Rate, jitter and amount of data on a key, as it arrives here, over the last seconds."),
    CommandRow("logs", TOOLS, "What the robot's processes on this machine wrote since their start, merged by time."),
    CommandRow("new", TOOLS, "Write a component from a template: `cocoro new service NAME`."),
    CommandRow(
        "base", HARDWARE, "Show the base: mode, battery, bumpers, odometry; `recover` puts it back into its mode."
    ),
    CommandRow("servos", HARDWARE, "Find, set up, calibrate, hold and relax the servos; clear their faults."),
    CommandRow("kinect", HARDWARE, "Calibrate the Kinect; tilt it."),
    CommandRow(
        "doctor", HARDWARE, "Look over a machine and its robot before a run; each line is well, or says what to do."
    ),
    CommandRow("babble", LEARNING, "Move to learn: the arm before the eyes, the wheels before a target."),
    CommandRow("learn", LEARNING, "Learn from what babbling saw: a model that the planner loads."),
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
    CommandRow("stop", SAFETY, "The same as estop.", hidden=True),
    CommandRow("reset", SAFETY, "Release the emergency stop."),
)


def load(name: str) -> TyperCommand | TyperGroup:
    """Imports the file of a command and returns the command."""
    match name:
        case "status":
            from apps.cli.status import app
        case "objects":
            from apps.cli.objects_app import app
        case "snapshot":
            from apps.cli.snapshot import app
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
        case "echo" | "new":
            from apps.cli.tools_app import app
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
            from apps.cli.hardware_app import app
        case "babble" | "learn":
            from apps.cli.learning_app import app
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
    """The group of all commands: help comes from COMMANDS, and a command is loaded when it is called."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        for row in COMMANDS:
            listed = TyperCommand(row.name, help=row.summary, rich_help_panel=row.panel, hidden=row.hidden)
            self.add_command(listed)

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

BodyOption = Annotated[str, typer.Option(metavar="nominal|worn", help="A body as drawn, or one that differs from it.")]


# --- tasks ----------------------------------------------------------------------------------------


def _task(where: tuple[str | None, str | None], as_json: bool, snapshot: Path | None = None, **request: Any) -> None:
    """`request`: the fields of a TaskRequest."""
    from apps.cli import tasks
    from cocoro.messages import TaskRequest

    sys.exit(asyncio.run(tasks.run(RobotChoice(*where), TaskRequest(**request), as_json, snapshot)))


@app.command(rich_help_panel=TASKS)
def fetch(
    label: Annotated[str, typer.Argument(help="What to fetch; `cocoro objects` lists what the robot knows.")],
    bring: Annotated[bool, typer.Option("--bring", help="Bring it to where the task began and put it down.")] = False,
    timeout: TimeoutOption = None,
    snapshot: Annotated[
        Path | None, typer.Option(metavar="OUT.png", help="Write what the robot sees when it grasps.")
    ] = None,
    robot: RobotOption = None,
    profile: MeshOption = None,
    json: JsonOption = False,
) -> None:
    """Find an object, drive there, grasp it and lift it. Ctrl-C cancels it on the robot."""
    _task((robot, profile), json, snapshot, task="fetch", label=label, bring=bring, timeout_s=timeout)


@app.command(rich_help_panel=TASKS)
def follow(
    label: Annotated[str, typer.Argument(help="What to follow; `cocoro objects` lists what the robot knows.")],
    for_: ForOption = None,
    robot: RobotOption = None,
    profile: MeshOption = None,
    json: JsonOption = False,
) -> None:
    """Keep behind an object that moves, at a distance, until Ctrl-C or for a time."""
    _task((robot, profile), json, task="follow", label=label, for_s=for_)


@app.command(rich_help_panel=TASKS)
def touch(
    label: Annotated[str, typer.Argument(help="What to touch: something within the arm's reach.")],
    timeout: TimeoutOption = None,
    robot: RobotOption = None,
    profile: MeshOption = None,
    json: JsonOption = False,
) -> None:
    """Bring the open hand around something within reach, on the floor or in the air; the wheels stand."""
    _task((robot, profile), json, task="touch", label=label, timeout_s=timeout)


@app.command("go-to", rich_help_panel=TASKS)
def go_to(
    label: Annotated[str, typer.Argument(help="Where to go; `cocoro objects` lists what the robot knows.")],
    distance: DistanceOption = 0.2,
    timeout: TimeoutOption = None,
    robot: RobotOption = None,
    profile: MeshOption = None,
    json: JsonOption = False,
) -> None:
    """Drive to an object and stop at a distance from it. Ctrl-C cancels it on the robot."""
    _task((robot, profile), json, task="go-to", label=label, distance_m=distance, timeout_s=timeout)


@app.command(rich_help_panel=TASKS)
def park(
    timeout: TimeoutOption = None, robot: RobotOption = None, profile: MeshOption = None, json: JsonOption = False
) -> None:
    """Fold the arm. Ctrl-C cancels it on the robot."""
    _task((robot, profile), json, task="park", timeout_s=timeout)


@app.command("put-down", rich_help_panel=TASKS)
def put_down(
    timeout: TimeoutOption = None, robot: RobotOption = None, profile: MeshOption = None, json: JsonOption = False
) -> None:
    """Set down what the hand holds. Ctrl-C cancels it on the robot."""
    _task((robot, profile), json, task="put-down", timeout_s=timeout)


@app.command(rich_help_panel=TASKS)
def cancel(robot: RobotOption = None, profile: MeshOption = None) -> None:
    """End the running task; the robot stands still."""
    from apps.cli import tasks

    sys.exit(asyncio.run(tasks.cancel(RobotChoice(robot, profile))))


@app.command(rich_help_panel=TASKS)
def rehearse(
    task: Annotated[
        str, typer.Argument(help="fetch, follow, touch, go-to, park, put-down, babble-arm or babble-wheels.")
    ],
    label: Annotated[str, typer.Argument(help="What to fetch, to follow, to touch or to go to.")] = "",
    bring: Annotated[bool, typer.Option("--bring", help="Fetch: bring it to where the task began.")] = False,
    for_: ForOption = None,
    distance: DistanceOption = 0.2,
    scene: Annotated[str, typer.Option(help="A scene's name, or its file.")] = "paper",
    seed: Annotated[int, typer.Option(min=0, help="Everything that is drawn comes from it.")] = 0,
    sensors: Annotated[
        str, typer.Option(metavar="ideal|real", help="Perfect camera and body, or real ones.")
    ] = "ideal",
    body: BodyOption = "nominal",
    description: DescriptionOption = None,
    measured: MeasuredOption = None,
    model: ModelOption = None,
    reach: ReachOption = None,
    adapt: AdaptOption = False,
    bend: Annotated[
        float | None, typer.Option(min=0.0, metavar="SECONDS", help="Then somebody bends the forearm: 3 cm.")
    ] = None,
    count: Annotated[int, typer.Option(min=1, metavar="N", help="Babbling: how many samples or trials.")] = 1000,
    samples: Annotated[Path | None, typer.Option(metavar="FILE", help="Babbling: where they are kept.")] = None,
    latency: LatencyOption = None,
    lockstep: Annotated[bool, typer.Option("--lockstep", help="One serial cycle over all, as in the paper.")] = False,
    frames: FramesOption = None,
    objects: ObjectsOption = None,
    timeout: TimeoutOption = None,
    picture: Annotated[
        Path | None, typer.Option(metavar="OUT.png", help="Write what the robot saw when it grasped.")
    ] = None,
    record: Annotated[Path | None, typer.Option(metavar="OUT.mcap", help="Record everything.")] = None,
    json: JsonOption = False,
) -> None:
    """Try a task in simulation: the whole robot in one process, in virtual time."""
    from apps.cli import rehearse as rehearsing

    options = {
        "task": task, "label": label, "bring": bring, "for_s": for_, "scene": scene, "seed": seed, "sensors": sensors,
        "distance_m": distance, "adapt": adapt, "bend_s": bend,
        "body": body, "lockstep": lockstep, "timeout_s": timeout, "picture": None if picture is None else str(picture),
        "record": None if record is None else str(record), "count": count, "reach": reach or "learned",
        "model": None if model is None else str(model), "samples": None if samples is None else str(samples),
        "objects": None if objects is None else str(objects),
        "description": None if description is None else str(description),
        "measured": None if measured is None else str(measured),
    }  # fmt: skip
    sys.exit(rehearsing.rehearse(options, latency or [], frames, json))


@app.command(rich_help_panel=WATCH)
def topics(
    markdown: Annotated[bool, typer.Option("--markdown", help="The whole page of the documentation.")] = False,
    json: JsonOption = False,
) -> None:
    """What travels on the mesh: every key, its type, rate, quality of service and publisher."""
    from apps.cli import topics as listing

    print(listing.markdown() if markdown else listing.as_json() if json else listing.table(), end="")
