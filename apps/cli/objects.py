"""`cocoro objects`: the objects that the robot knows, and where it saw each last."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from apps.cli import exits
from apps.cli.link import joined
from apps.cli.options import JsonOption, MeasuredOption, RobotChoice, RobotOption, ThroughOption
from apps.cli.output import print_json
from apps.cli.snapshot import check
from apps.cli.terminal import Column, print_table
from cocoro.messages import KnownObject, ObjectsRequest
from cocoro.topics import OBJECTS

app = typer.Typer()
objects = typer.Typer(invoke_without_command=True)
app.add_typer(objects, name="objects")


@objects.callback()
def objects_callback(
    context: typer.Context, robot: RobotOption = None, site: ThroughOption = None, json: JsonOption = False
) -> None:
    """The objects that the robot knows, and where it saw each last; `learn` adds one."""
    if context.invoked_subcommand is None:
        sys.exit(asyncio.run(list_objects(RobotChoice(robot, site), json)))


@objects.command()
def learn(
    label: Annotated[str, typer.Argument(help="The object's new label: orange_box.")],
    source: Annotated[
        str, typer.Option("--from", metavar="FILE|live", help="A picture file, or `live`: what the robot sees now.")
    ] = "live",
    at: Annotated[str | None, typer.Option(metavar="U,V", help="A pixel of the object.")] = None,
    box: Annotated[
        str | None, typer.Option(metavar="L,T,R,B", help="A box of pixels that the object mostly fills.")
    ] = None,
    shape: Annotated[
        str | None, typer.Option(metavar="SHAPE", help="cylinder, sphere or box; guessed from the outline by default.")
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(metavar="METRES", help="Diameter x height: 0.066x0.12; measured by default."),
    ] = None,
    distance: Annotated[
        float | None,
        typer.Option(min=0.05, max=10.0, metavar="METRES", help="Distance of the object in a picture file."),
    ] = None,
    graspable: Annotated[
        bool | None, typer.Option("--graspable/--not-graspable", help="Decided by its size by default.")
    ] = None,
    mass: Annotated[
        float | None, typer.Option(min=0.001, max=10.0, metavar="KG", help="Estimated from its size by default.")
    ] = None,
    catalogue: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="File of known objects; the running robot's, or objects.toml, by default."),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(metavar="OUT.png", help="Picture of what would match; LABEL.png by default.")
    ] = None,
    yes: Annotated[
        bool | None,
        typer.Option("--yes/--no", "-y/-n", help="Save it without asking, or only look; without a terminal say which."),
    ] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Replace the colours of a known object.")] = False,
    add: Annotated[bool, typer.Option("--add", help="Add the colours of another light to a known object.")] = False,
    measured: MeasuredOption = None,
    robot: RobotOption = None,
    site: ThroughOption = None,
    json: JsonOption = False,
) -> None:
    """Learn a new object's colours and size from one view: the object at --at or in --box, or the one that stands out.

    Prints and draws what would match before it saves anything, and warns of known objects that look alike.
    """
    from apps.cli import learn_object as learning  # slow to import: OpenCV and the components
    from deploy.which_robot import files_here

    hints = learning.hints_of(
        label, at_px=learning.pixel_of(at), box_px=learning.box_of(box), shape=shape, size_m=learning.size_of(size),
        distance_m=distance, graspable=graspable, mass_kg=mass,
    )  # fmt: skip
    if picture is not None:
        check(picture)
    saving = learning.SaveOptions(catalogue, picture, yes, replace, add, json)
    camera_of = None if source == learning.LIVE else files_here(robot).with_measured(measured).load()
    sys.exit(asyncio.run(learning.learn_object(RobotChoice(robot, site), source, hints, saving, camera_of)))


async def list_objects(choice: RobotChoice, as_json: bool) -> int:
    """Prints the known objects and returns the exit code. Raises MeshError when the robot's mesh is not there."""
    async with joined(choice) as link:
        reply = await link.call(OBJECTS, ObjectsRequest())
    if as_json:
        print_json(msgspec.to_builtins(reply.objects))
    else:
        columns = ("object", Column("shape", 1), "size (cm)", "graspable", Column("seen", text=True))
        print_table(columns, [_row(known) for known in reply.objects])
    return exits.DONE


def _row(known: KnownObject) -> tuple[str, ...]:
    size = " x ".join(f"{100 * side:.1f}" for side in known.size_m)
    seen = "-"
    if known.seen is not None:
        x_m, y_m, z_m = known.seen.position_m
        seen = f"{known.seen.age_s:.1f} s ago at ({x_m:.2f}, {y_m:.2f}, {z_m:.2f}) m"
    return known.label, known.shape, size, "yes" if known.graspable else "no", seen
