"""The commands and their options. What they do is imported when they are called, so that `--help` is quick."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from apps.cli import capture_app, hardware_app, learning_app, objects_app, tools_app
from apps.cli.options import (
    AdaptOption,
    DistanceOption,
    ForOption,
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
    TimeoutOption,
)

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Start, command and watch a CoCoRo robot.\n\n"
    "First `cocoro up sim --detach`, then `cocoro fetch red_can`, at last `cocoro down`.",
    epilog="Exit codes: 0 done, 1 the task failed, 2 bad usage, 3 refused or cancelled, 4 the mesh is not there.",
)

TASKS, WATCH, RUNNING, SAFETY = "Tasks", "Watching", "Starting and stopping", "Safety"


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
    }  # fmt: skip
    sys.exit(rehearsing.rehearse(options, latency or [], frames, json))


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
