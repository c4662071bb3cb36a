"""The commands of tasks, made from their types: `cocoro NAME` on a robot, and `cocoro rehearse NAME`.

`cocoro --help` needs this file, so the functions import what they need themselves.
"""

from __future__ import annotations

import asyncio
import inspect
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import msgspec
import typer
from msgspec import NODEFAULT, Meta
from typer.core import TyperCommand, TyperGroup
from typer.main import get_group

from apps.cli import completions
from apps.cli.former import taking_former
from apps.cli.listed import COMMANDS
from apps.cli.options import (
    AdaptOption,
    AnyRobotOption,
    BodyOption,
    CameraOption,
    FramesOption,
    InsteadOption,
    JsonOption,
    LatencyOption,
    MeasuredOption,
    ModelOption,
    ObjectsOption,
    ReachOption,
    RobotChoice,
    RobotOption,
    ThroughOption,
    TimeoutOption,
    name_option,
)
from cocoro.errors import CocoroError, ConfigError, choice_of
from cocoro.tasks import Task
from services.executive.tasks import TASKS

PANEL = "Tasks"
_NAMES = frozenset(row.name for row in COMMANDS)
UNITS = {"_s": "SECONDS", "_m": "METRES", "_rad": "RADIANS", "_mps": "M/S"}
"""Metavar by the unit that a field's name ends with."""

_ANNOTATED: Any = Annotated
"""`Annotated` for types that are only known at run time."""
Shared = Callable[..., None]
"""Carries out a task; its parameters after the first, the task, are the options that all its commands have."""


# --- what the commands do -------------------------------------------------------------------------


def operate(
    task: Task,
    timeout: TimeoutOption = None,
    detach: Annotated[
        bool,
        typer.Option("--detach", "-d", help="Print the task's id and end; the task goes on. See `wait`, `cancel`."),
    ] = False,
    snapshot: Annotated[
        Path | None, typer.Option(metavar="OUT.png", help="Write what the robot sees when it grasps.")
    ] = None,
    instead: InsteadOption = False,
    robot: RobotOption = None,
    site: ThroughOption = None,
    json: JsonOption = False,
) -> None:
    """Ctrl-C cancels it on the robot, and so does every other end of the command: a closed terminal, a kill."""
    from apps.cli import task_running
    from cocoro.messages import TaskRequest

    choice, request = RobotChoice(robot, site), TaskRequest(task=task, timeout_s=timeout, instead=instead)
    if not detach:
        sys.exit(asyncio.run(task_running.run(choice, request, json, snapshot)))
    if snapshot is not None:
        raise ConfigError("--snapshot takes its picture when the robot grasps: leave --detach out")
    sys.exit(asyncio.run(task_running.detach(choice, request, json)))


def rehearse(
    task: Task,
    scene: Annotated[
        str, typer.Option(help="A scene's name, or its file.", autocompletion=completions.scenes)
    ] = "paper",
    seed: Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")] = 0,
    sensors: Annotated[
        str,
        name_option("ideal", "real", help="Perfect camera and body, or real ones."),
    ] = "ideal",
    body: BodyOption = "nominal",
    robot: AnyRobotOption = None,
    measured: MeasuredOption = None,
    model: ModelOption = None,
    reach: ReachOption = None,
    adapt: AdaptOption = False,
    bend: Annotated[
        float | None, typer.Option(min=0.0, metavar="SECONDS", help="Bend the forearm by 3 cm at this time.")
    ] = None,
    samples: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Keep the samples here; an existing file is continued.")
    ] = None,
    latency: LatencyOption = None,
    lockstep: Annotated[bool, typer.Option("--lockstep", help="One serial cycle over all, as in the paper.")] = False,
    frames: FramesOption = None,
    objects: ObjectsOption = None,
    timeout: TimeoutOption = None,
    wait: Annotated[
        float, typer.Option(min=0.0, max=3600.0, metavar="SECONDS", help="Let the world run before the task is asked.")
    ] = 0.0,
    then: Annotated[
        list[str] | None,
        typer.Option(
            metavar="'TASK ...'", help="Then another task, as its command is written: 'put-down'. Repeatable."
        ),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(metavar="OUT.png", help="Write what the robot saw when it grasped.")
    ] = None,
    record: Annotated[Path | None, typer.Option(metavar="OUT.mcap", help="Record everything.")] = None,
    video: Annotated[
        Path | None, typer.Option(metavar="OUT.mp4", help="Film it; a name with .webp is a small animation.")
    ] = None,
    camera: CameraOption = "outside",
    json: JsonOption = False,
) -> None:
    """The whole robot is simulated in one process, in virtual time, and judged by the simulator's truth."""
    from apps.cli import rehearse as rehearsing
    from deploy.which_robot import files_of

    files = files_of(robot).with_measured(measured)
    options = {
        "task": task, "scene": scene, "seed": seed, "sensors": sensors, "body": body, "model": _text(model),
        "reach": reach or "learned", "adapt": adapt, "bend_s": bend, "samples": _text(samples), "lockstep": lockstep,
        "description": _text(files.description), "measured": _text(files.measured),
        "wait_s": wait, "then": [task_of(words, "--then") for words in then or []],
        "objects": _text(objects or files.objects), "timeout_s": timeout, "picture": _text(picture),
        "record": _text(record),
    }  # fmt: skip
    sys.exit(rehearsing.rehearse(options, latency or [], frames, json, video, camera))


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)


# --- commands from types --------------------------------------------------------------------------


def task_names() -> list[str]:
    """The tasks whose commands are made from their types. `cocoro babble` runs those of the project's tasks that report
    samples, because it keeps the samples; `cocoro drive` reads keys."""
    return [name for name in TASKS.all() if not _has_another(name)]


def task_command(name: str) -> TyperCommand | None:
    """The command of a task; None for a name that is none."""
    return _command(name, operate) if _is_known(name) and not _has_another(name) else None


def _has_another(name: str) -> bool:
    """Whether a command in a file of its own runs the task."""
    return name in TASKS.own and (TASKS.own[name].samples is not None or name in _NAMES)


def _is_known(name: str) -> bool:
    """Whether there is a task of that name. One of the project's is found without a search for third parties'."""
    return name in TASKS.own or name in TASKS.all()


def task_of(words: str, option: str) -> Task:
    """The task that a command line's words ask for: 'follow blue_ball --for 20'. Raises ConfigError, which names the
    option that the words are of."""
    read: list[Task] = []

    def keep(task: Task) -> None:
        """Keep it."""
        read.append(task)

    try:
        name, *rest = shlex.split(words) or [""]
        if not _is_known(name):
            raise ConfigError(f"no such task: {name!r}; known are {', '.join(TASKS.all())}")
        _command(name, keep).main(rest, prog_name=name, standalone_mode=False)
    except Exception as error:
        usage = getattr(error, "format_message", None)  # an error of typer's, whose types are its own affair
        if usage is None and not isinstance(error, ValueError | CocoroError):
            raise
        raise ConfigError(f"{option} {words!r}: {usage() if usage is not None else error}") from error
    if not read:
        raise ConfigError(f"{option} {words!r}: give a task with its arguments")
    return read[0]


class RehearsalGroup(TyperGroup):
    """A command for each task."""

    def list_commands(self, ctx: Any) -> list[str]:
        return [name for name in TASKS.all() if name not in _NAMES]  # nobody drives by hand in a rehearsal

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if _is_known(cmd_name) and cmd_name not in _NAMES:
            return taking_former(_command(cmd_name, rehearse))
        if ctx is not None and not ctx.resilient_parsing and not cmd_name.startswith("-"):
            ctx.fail(f"There is no task {cmd_name!r}; {choice_of(cmd_name, self.list_commands(ctx))}")
        return None


app = typer.Typer()
app.add_typer(
    typer.Typer(
        cls=RehearsalGroup,
        no_args_is_help=True,
        help="Try a task in simulation: the whole robot in one process, in virtual time.",
    ),
    name="rehearse",
)


TaskIdArgument = Annotated[
    str, typer.Argument(metavar="[ID]", help="The task's id, as `--detach` prints it; by default the running task.")
]


@app.command()
def cancel(
    task: TaskIdArgument = "", robot: RobotOption = None, site: ThroughOption = None, json: JsonOption = False
) -> None:
    """End the running task; the robot stands still."""
    from apps.cli import task_running

    sys.exit(asyncio.run(task_running.cancel(RobotChoice(robot, site), task, json)))


@app.command()
def wait(
    task: TaskIdArgument = "", robot: RobotOption = None, site: ThroughOption = None, json: JsonOption = False
) -> None:
    """Follow a task to its end, and exit as its own command would have. Ctrl-C ends the waiting, not the task."""
    from apps.cli import task_running

    sys.exit(asyncio.run(task_running.wait(RobotChoice(robot, site), task, json)))


def _command(name: str, shared: Shared) -> TyperCommand:
    made = typer.Typer()
    made.command(name, rich_help_panel=PANEL)(command_of(TASKS.kind(name), shared))
    made.callback()(lambda: None)
    command = get_group(made).commands[name]
    assert isinstance(command, TyperCommand)
    return command


def command_of(kind: type[Task], shared: Shared) -> Callable[..., None]:
    """A function for typer: its parameters are a task's fields and the options that its commands share."""
    left_out = {"task"}
    if not kind.snapshot_phase:
        left_out |= {"snapshot", "picture"}
    if kind.samples is None:
        left_out.add("samples")
    hints = get_type_hints(shared, include_extras=True)
    fields = [field for field in msgspec.structs.fields(kind) if _is_option(field)]
    parameters = [_parameter(field, kind) for field in fields]
    parameters += [
        parameter.replace(annotation=hints[name], kind=inspect.Parameter.KEYWORD_ONLY)
        for name, parameter in inspect.signature(shared).parameters.items()
        if name not in left_out
    ]

    def command(**given: Any) -> None:
        values = {field.name: given.pop(field.name) for field in fields}
        try:
            task = TASKS.read({"task": kind.tag(), **values})
        except ValueError as error:
            raise ConfigError(str(error)) from error
        shared(task, **given)

    command.__name__ = kind.tag()
    command.__doc__ = f"{inspect.cleandoc(kind.__doc__ or '')}\n\n{shared.__doc__}"
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return command


def _is_option(field: msgspec.structs.FieldInfo) -> bool:
    _, _, metas = _unwrapped(field.type)
    return all((meta.extra or {}).get("option", True) for meta in metas)


def _parameter(field: msgspec.structs.FieldInfo, task: type[Task]) -> inspect.Parameter:
    """A field as typer has it: `label` is the argument, every other one an option, named without its unit. A label that
    names no object is a policy's name."""
    plain, optional, metas = _unwrapped(field.type)
    text = next((meta.description for meta in metas if meta.description), None)
    default = inspect.Parameter.empty if field.default is NODEFAULT else field.default
    if field.name == "label":
        word, complete = ("LABEL", completions.labels) if task.needs_label else ("NAME", completions.policies)
        annotation = _ANNOTATED[plain, typer.Argument(metavar=word, help=text, autocompletion=complete)]
        return inspect.Parameter(field.name, inspect.Parameter.KEYWORD_ONLY, annotation=annotation, default=default)
    name, metavar = field.name, None
    for unit, word in UNITS.items():
        if name.endswith(unit):
            name, metavar = name.removesuffix(unit), word
    low = next((limit for meta in metas for limit in (meta.ge, meta.gt) if limit is not None), None)
    high = next((limit for meta in metas for limit in (meta.le, meta.lt) if limit is not None), None)
    option = typer.Option(f"--{name.replace('_', '-')}", help=text, min=low, max=high, metavar=metavar)
    kind = plain | None if optional else plain
    return inspect.Parameter(
        field.name, inspect.Parameter.KEYWORD_ONLY, annotation=_ANNOTATED[kind, option], default=default
    )


def _unwrapped(annotation: Any) -> tuple[Any, bool, tuple[Meta, ...]]:
    """The type behind `Annotated` and `| None`; whether None is allowed; and the `Meta` of it."""
    optional = False
    metas: tuple[Meta, ...] = ()
    while get_origin(annotation) in (Annotated, Union, UnionType):
        if get_origin(annotation) is Annotated:
            annotation, *found = get_args(annotation)
            metas += tuple(meta for meta in found if isinstance(meta, Meta))
        else:
            optional = True
            (annotation,) = (part for part in get_args(annotation) if part is not type(None))
    return annotation, optional, metas
