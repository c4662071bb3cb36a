"""The commands and their options. What they do is imported when they are called, so that `--help` is quick."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from typing import Annotated

import typer

from apps.cli import capture_app, hardware_app, learning_app, objects_app, task_app, tools_app
from apps.cli.options import (
    AdaptOption,
    FramesOption,
    JsonOption,
    LatencyOption,
    MeshOption,
    ModelOption,
    ObjectsOption,
    ProfileArgument,
    ReachOption,
    RobotChoice,
    RobotOption,
    SetOption,
)

app = typer.Typer(
    cls=task_app.group_of(task_app.operate),
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Start, command and watch a CoCoRo robot.\n\n"
    "First `cocoro up sim --detach`, then `cocoro fetch red_can`, at last `cocoro down`.",
    epilog="Exit codes: 0 done, 1 the task failed, 2 bad usage, 3 refused or cancelled, 4 the mesh is not there.",
)

TASKS, WATCH, RUNNING, SAFETY = task_app.PANEL, "Watching", "Starting and stopping", "Safety"


# --- tasks ----------------------------------------------------------------------------------------


task_app.add_to(app)


@app.command(rich_help_panel=TASKS)
def cancel(robot: RobotOption = None, profile: MeshOption = None) -> None:
    """End the running task; the robot stands still."""
    from apps.cli import tasks

    sys.exit(asyncio.run(tasks.cancel(RobotChoice(robot, profile))))


# --- watching -------------------------------------------------------------------------------------


@app.command(rich_help_panel=WATCH)
def status(robot: RobotOption = None, profile: MeshOption = None, json: JsonOption = False) -> None:
    """What runs, how it is, what it does and why. Exit code 1 when something that should run does not."""
    from apps.cli import status as telling

    sys.exit(asyncio.run(telling.status(RobotChoice(robot, profile), json)))


objects_app.add_to(app, WATCH)


@app.command(rich_help_panel=WATCH)
def snapshot(
    out: Annotated[Path, typer.Argument(metavar="OUT.png", help="The picture's file.")],
    robot: RobotOption = None,
    profile: MeshOption = None,
) -> None:
    """What the robot sees now, with its detections drawn in."""
    from apps.cli import snapshot as taking

    sys.exit(asyncio.run(taking.snapshot(RobotChoice(robot, profile), out)))


@app.command(rich_help_panel=WATCH)
def topics(
    markdown: Annotated[bool, typer.Option("--markdown", help="The whole page of the documentation.")] = False,
    json: JsonOption = False,
) -> None:
    """What travels on the mesh: every key, its type, rate, quality of service and publisher."""
    from apps.cli import topics as listing

    print(listing.markdown() if markdown else listing.as_json() if json else listing.table(), end="")


# --- captures -------------------------------------------------------------------------------------

capture_app.add_to(app)

# --- tools ----------------------------------------------------------------------------------------

tools_app.add_to(app)

hardware_app.add_to(app)

# --- learning -------------------------------------------------------------------------------------

learning_app.add_to(app)

# --- starting and stopping ------------------------------------------------------------------------


@app.command(rich_help_panel=RUNNING)
def up(
    profile: ProfileArgument = "sim",
    detach: Annotated[bool, typer.Option("--detach", "-d", help="Return when the robot is up.")] = False,
    scene: Annotated[str | None, typer.Option(help="Simulator: a scene's name, or its file.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Simulator: the seed of all that is drawn.")] = None,
    sensors: Annotated[str | None, typer.Option(metavar="ideal|real", help="Simulator: perfect or real.")] = None,
    body: Annotated[
        str | None, typer.Option(metavar="nominal|worn", help="Simulator: a body as drawn, or not.")
    ] = None,
    model: ModelOption = None,
    reach: ReachOption = None,
    adapt: AdaptOption = False,
    frames: FramesOption = None,
    latency: LatencyOption = None,
    objects: ObjectsOption = None,
    set_: SetOption = None,
    unattended: Annotated[
        bool, typer.Option("--unattended", help="No person starts it: its first start comes up stopped.")
    ] = False,
) -> None:
    """Start a robot's processes and stay until Ctrl-C (or, with --detach, until they are ready)."""
    from apps.cli import running
    from deploy import profiles

    overrides = running.overrides(scene, seed, sensors, body, frames, latency or [], set_ or [])
    if objects is not None:
        overrides.insert(0, running.objects_of(objects))
    overrides[:0] = running.model_of(model, reach, adapt)
    read = profiles.read(profile, overrides)
    sys.exit(running.up_detached(read, unattended) if detach else running.up(read, unattended))


@app.command(rich_help_panel=RUNNING)
def down(robot: RobotOption = None) -> None:
    """Stop a robot's processes. Nothing running is no error."""
    from apps.cli import running

    sys.exit(running.down(robot))


@app.command(rich_help_panel=RUNNING)
def run(
    process: Annotated[str, typer.Argument(help="A process of the profile, or any other that is installed.")],
    profile: Annotated[
        str | None, typer.Option(metavar="PROFILE", help="By default that of the robot that is up here, else sim.")
    ] = None,
    set_: SetOption = None,
) -> None:
    """One process in this terminal, on the mesh of the profile. Ctrl-C ends it."""
    from apps.cli import running

    sys.exit(running.run(process, profile, set_ or []))


# --- safety ---------------------------------------------------------------------------------------

_CONTEXT = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}


@app.command(rich_help_panel=SAFETY, context_settings=_CONTEXT)
def estop(context: typer.Context) -> None:
    """Emergency stop, now: all that moves holds still until `reset`. (`stop` is the same.)"""
    from apps.cli import estop as stopping

    sys.exit(stopping.main("estop", context.args))


@app.command(hidden=True, context_settings=_CONTEXT)
def stop(context: typer.Context) -> None:
    """The same as estop."""
    estop(context)


@app.command(rich_help_panel=SAFETY)
def reset(robot: RobotOption = None, profile: MeshOption = None) -> None:
    """Release the emergency stop. The executive may refuse, and says why."""
    from apps.cli import reset as releasing

    sys.exit(asyncio.run(releasing.reset(RobotChoice(robot, profile))))
