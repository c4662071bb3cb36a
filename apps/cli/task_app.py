"""The commands of tasks, made from their types: `cocoro NAME` on a robot, and `cocoro rehearse NAME`."""

from __future__ import annotations

import asyncio
import inspect
import sys
from collections.abc import Callable
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import msgspec
import typer
from msgspec import NODEFAULT, Meta
from typer.core import TyperGroup

from apps.cli.options import (
    AdaptOption,
    BodyOption,
    FramesOption,
    JsonOption,
    LatencyOption,
    MeshOption,
    ModelOption,
    ObjectsOption,
    ReachOption,
    RobotChoice,
    RobotOption,
    TimeoutOption,
)
from cocoro.errors import ConfigError
from cocoro.tasks import Task
from services.executive.tasks import TASKS

PANEL = "Tasks"
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
    snapshot: Annotated[
        Path | None, typer.Option(metavar="OUT.png", help="Write what the robot sees when it grasps.")
    ] = None,
    robot: RobotOption = None,
    profile: MeshOption = None,
    json: JsonOption = False,
) -> None:
    """Ctrl-C cancels it on the robot."""
    from apps.cli import tasks
    from cocoro.messages import TaskRequest

    request = TaskRequest(task=task, timeout_s=timeout)
    sys.exit(asyncio.run(tasks.run(RobotChoice(robot, profile), request, json, snapshot)))


def rehearse(
    task: Task,
    scene: Annotated[str, typer.Option(help="A scene's name, or its file.")] = "paper",
    seed: Annotated[int, typer.Option(min=0, help="Seed of everything that is drawn at random.")] = 0,
    sensors: Annotated[
        str, typer.Option(metavar="ideal|real", help="Perfect camera and body, or real ones.")
    ] = "ideal",
    body: BodyOption = "nominal",
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
    picture: Annotated[
        Path | None, typer.Option(metavar="OUT.png", help="Write what the robot saw when it grasped.")
    ] = None,
    record: Annotated[Path | None, typer.Option(metavar="OUT.mcap", help="Record everything.")] = None,
    json: JsonOption = False,
) -> None:
    """The whole robot is simulated in one process, in virtual time, and judged by the simulator's truth."""
    from apps.cli import rehearse as rehearsing

    options = {
        "task": task, "scene": scene, "seed": seed, "sensors": sensors, "body": body, "model": _text(model),
        "reach": reach or "learned", "adapt": adapt, "bend_s": bend, "samples": _text(samples), "lockstep": lockstep,
        "objects": _text(objects), "timeout_s": timeout, "picture": _text(picture), "record": _text(record),
    }  # fmt: skip
    sys.exit(rehearsing.rehearse(options, latency or [], frames, json))


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)


# --- commands from types --------------------------------------------------------------------------


def add_to(app: typer.Typer) -> None:
    """Add a command for each of the project's tasks, and the group `rehearse`."""
    for kind in TASKS.own.values():
        if kind.samples is None:  # `cocoro babble` runs the others: it keeps their samples
            app.command(kind.tag(), rich_help_panel=PANEL)(command_of(kind, operate))
    rehearsals = typer.Typer(
        cls=group_of(rehearse),
        no_args_is_help=True,
        help="Try a task in simulation: the whole robot in one process, in virtual time.",
    )
    for kind in TASKS.own.values():
        rehearsals.command(kind.tag())(command_of(kind, rehearse))
    app.add_typer(rehearsals, name="rehearse", rich_help_panel=PANEL)


def group_of(shared: Shared) -> type[TyperGroup]:
    """A group of commands that has third parties' tasks too. Their entry points are looked for only when a name is not
    one of the project's commands, or when all commands are listed."""

    class Group(TyperGroup):
        def get_command(self, ctx: Any, cmd_name: str) -> Any:
            found = super().get_command(ctx, cmd_name)
            kind = None if found is not None else TASKS.all().get(cmd_name)
            return found if kind is None else _third_partys(kind, shared)

        def list_commands(self, ctx: Any) -> list[str]:
            return [*super().list_commands(ctx), *(name for name in TASKS.all() if name not in TASKS.own)]

    return Group


def _third_partys(kind: type[Task], shared: Shared) -> Any:
    app = typer.Typer(add_completion=False)
    app.command(kind.tag(), rich_help_panel=PANEL)(command_of(kind, shared))
    return typer.main.get_command(app)


def command_of(kind: type[Task], shared: Shared) -> Callable[..., None]:
    """A function for typer: its parameters are a task's fields and the options that its commands share."""
    left_out = {"task"}
    if not kind.snapshot_phase:
        left_out |= {"snapshot", "picture"}
    if kind.samples is None:
        left_out.add("samples")
    hints = get_type_hints(shared, include_extras=True)
    fields = [field for field in msgspec.structs.fields(kind) if _is_option(field)]
    parameters = [_parameter(field) for field in fields]
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


def _parameter(field: msgspec.structs.FieldInfo) -> inspect.Parameter:
    """A field as typer has it: `label` is the argument, every other one an option, named without its unit."""
    plain, optional, metas = _unwrapped(field.type)
    text = next((meta.description for meta in metas if meta.description), None)
    default = inspect.Parameter.empty if field.default is NODEFAULT else field.default
    if field.name == "label":
        annotation = _ANNOTATED[plain, typer.Argument(help=text)]
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
