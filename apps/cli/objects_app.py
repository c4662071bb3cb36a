"""`cocoro objects` and what can be done with them; `app` takes them in."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from typing import Annotated

import typer

from apps.cli.options import DescriptionOption, JsonOption, MeasuredOption, MeshOption, RobotChoice, RobotOption

app = typer.Typer()
objects = typer.Typer(invoke_without_command=True)
app.add_typer(objects, name="objects")


@objects.callback()
def list_them(
    context: typer.Context, robot: RobotOption = None, profile: MeshOption = None, json: JsonOption = False
) -> None:
    """The objects that the robot knows, and where it saw each last; `learn` adds one."""
    if context.invoked_subcommand is None:
        from apps.cli import objects as listing

        sys.exit(asyncio.run(listing.objects(RobotChoice(robot, profile), json)))


@objects.command()
def learn(
    label: Annotated[str, typer.Argument(help="What it is to be called: orange_box.")],
    source: Annotated[
        str, typer.Option("--from", metavar="FILE|live", help="A picture, or what the robot sees now.")
    ] = "live",
    at: Annotated[str | None, typer.Option(metavar="U,V", help="A pixel that is of it.")] = None,
    box: Annotated[str | None, typer.Option(metavar="L,T,R,B", help="A box of pixels that it fills most of.")] = None,
    shape: Annotated[
        str | None, typer.Option(metavar="SHAPE", help="cylinder, sphere or box; by its outline when it is not said.")
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(metavar="METRES", help="0.066x0.12 is a can's diameter and height; measured when not said."),
    ] = None,
    distance: Annotated[
        float | None, typer.Option(min=0.05, max=10.0, metavar="METRES", help="How far it was, for a picture.")
    ] = None,
    graspable: Annotated[
        bool | None, typer.Option("--graspable/--not-graspable", help="By its size when it is not said.")
    ] = None,
    mass: Annotated[float | None, typer.Option(min=0.001, max=10.0, metavar="KG", help="Roughly, if not said.")] = None,
    catalogue: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The file of known objects; that of the robot that is up, or objects.toml."),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(metavar="OUT.png", help="What it would match, drawn in; LABEL.png.")
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Save it without asking.")] = False,
    replace: Annotated[bool, typer.Option("--replace", help="Forget what an object of that name looked like.")] = False,
    add: Annotated[bool, typer.Option("--add", help="Add these colours to it: seen in another light.")] = False,
    description: DescriptionOption = None,
    measured: MeasuredOption = None,
    robot: RobotOption = None,
    profile: MeshOption = None,
    json: JsonOption = False,
) -> None:
    """A new object's colours and size, from one look at it: what is pointed at, or what stands out in the middle.

    Says and draws what it would match before it saves anything, and warns of what else looks like it.
    """
    from apps.cli import learn_object as learning
    from apps.cli.snapshot import check
    from cocoro.robot import Robot

    wanted = learning.wanted_of(
        label, at_px=learning.pixel_of(at), box_px=learning.box_of(box), shape=shape, size_m=learning.size_of(size),
        distance_m=distance, graspable=graspable, mass_kg=mass,
    )  # fmt: skip
    if picture is not None:
        check(picture)
    keeping = learning.SaveOptions(catalogue, picture, yes, replace, add, json)
    camera_of = Robot.load(description, measured)
    sys.exit(asyncio.run(learning.learn_object(RobotChoice(robot, profile), source, wanted, keeping, camera_of)))
