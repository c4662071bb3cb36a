"""`cocoro base`, `cocoro servos`, `cocoro kinect` and `cocoro doctor`; `app` takes them in."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from typing import Annotated

import typer

from apps.cli.options import (
    JsonOption,
    MeshOption,
    ProfileArgument,
    ProfileOption,
    RobotChoice,
    RobotOption,
)

PANEL = "Hardware"

base = typer.Typer(invoke_without_command=True)
servos = typer.Typer(
    no_args_is_help=True, help="Find, set up, calibrate, hold and relax the servos; clear their faults."
)
kinect = typer.Typer(no_args_is_help=True, help="Calibrate the Kinect; tilt it.")

JointsArgument = Annotated[
    list[str] | None, typer.Argument(metavar="[JOINT]...", help="All of them where none is named.")
]
PortsOption = Annotated[
    list[str] | None, typer.Option(metavar="DEVICE", help="Instead of the profile's ports. Repeatable.")
]
BaudOption = Annotated[int | None, typer.Option(metavar="RATE", help="Instead of the robot description's.")]
WriteOption = Annotated[
    Path | None,
    typer.Option("--write", metavar="FILE", help="The file to write what was found into, instead of the robot's own."),
]


def add_to(app: typer.Typer) -> None:
    app.add_typer(base, name="base", rich_help_panel=PANEL)
    app.add_typer(servos, name="servos", rich_help_panel=PANEL)
    app.add_typer(kinect, name="kinect", rich_help_panel=PANEL)
    app.command(rich_help_panel=PANEL)(doctor)


# --- base -----------------------------------------------------------------------------------------


@base.callback()
def show_base(
    context: typer.Context, robot: RobotOption = None, profile: MeshOption = None, json: JsonOption = False
) -> None:
    """What the base is like: mode, battery, bumpers, odometry; `recover` puts it back into its mode."""
    if context.invoked_subcommand is None:
        from apps.cli import base as showing

        sys.exit(asyncio.run(showing.show(RobotChoice(robot, profile), json)))


@base.command()
def recover(robot: RobotOption = None, profile: MeshOption = None) -> None:
    """Put a Create that left its mode (a cliff, a wheel drop, the charger) back into it."""
    from apps.cli import base as showing

    sys.exit(asyncio.run(showing.recover(RobotChoice(robot, profile))))


# --- servos, while the robot is up ------------------------------------------------------------------


def _ask(action: str, joints: list[str] | None, robot: str | None, profile: str | None) -> None:
    from apps.cli import servos as asking

    sys.exit(asyncio.run(asking.ask(RobotChoice(robot, profile), action, joints or [])))


@servos.command()
def clear(joints: JointsArgument = None, robot: RobotOption = None, profile: MeshOption = None) -> None:
    """Forget latched faults, such as an overload, and have those joints hold again where they are."""
    _ask("clear", joints, robot, profile)


@servos.command()
def relax(joints: JointsArgument = None, robot: RobotOption = None, profile: MeshOption = None) -> None:
    """Let joints go limp, to be turned by hand. The arm sinks: hold it."""
    _ask("relax", joints, robot, profile)


@servos.command()
def hold(joints: JointsArgument = None, robot: RobotOption = None, profile: MeshOption = None) -> None:
    """Have joints hold where they are."""
    _ask("hold", joints, robot, profile)


# --- servos, while it is down -----------------------------------------------------------------------


@servos.command()
def scan(
    profile: ProfileOption = "robot",
    port: PortsOption = None,
    baud: Annotated[list[int] | None, typer.Option(metavar="RATE", help="Only these. Repeatable.")] = None,
    last: Annotated[int, typer.Option(min=1, max=253, help="The highest ID to ask for.")] = 20,
    write: Annotated[
        Path | None, typer.Option("--write", metavar="FILE", help="Put the ports that were found into this profile.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Find servos: on every serial port, at every baud rate. The robot must be down."""
    from apps.cli import servos_by_hand as tools

    sys.exit(tools.scan(profile, port or [], baud or [], last, write, json))


@servos.command("set-id")
def set_id(
    old: Annotated[int, typer.Argument(min=0, max=253, help="Its ID now.")],
    new: Annotated[int, typer.Argument(min=0, max=253, help="The ID that it is to have.")],
    port: Annotated[str, typer.Option(metavar="DEVICE", help="Where it is connected.")],
    baud: Annotated[int, typer.Option(metavar="RATE")] = 1_000_000,
) -> None:
    """Give a servo another ID, and have it answer without delay. Best alone on the line."""
    from apps.cli import servos_by_hand as tools

    sys.exit(tools.set_id(port, baud, old, new))


@servos.command()
def calibrate(
    joints: Annotated[list[str], typer.Argument(metavar="JOINT...", help="Which joints, one after the other.")],
    at: Annotated[float, typer.Option(metavar="DEG", help="The angle to which it will be turned by hand.")] = 0.0,
    profile: ProfileOption = "robot",
    port: Annotated[str | None, typer.Option(metavar="DEVICE", help="Instead of the profile's port.")] = None,
    baud: BaudOption = None,
    write: WriteOption = None,
) -> None:
    """Measure where a joint's zero is and which way it turns, by turning it by hand. The robot must be down."""
    from apps.cli import servos_by_hand as tools

    sys.exit(tools.calibrate(profile, joints, at, port, baud, write))


@servos.command()
def limits(
    joints: Annotated[list[str], typer.Argument(metavar="JOINT...", help="Which joints, one after the other.")],
    profile: ProfileOption = "robot",
    port: Annotated[str | None, typer.Option(metavar="DEVICE", help="Instead of the profile's port.")] = None,
    baud: BaudOption = None,
    write: WriteOption = None,
) -> None:
    """Measure how far a joint may turn, by turning it by hand from end to end. The robot must be down."""
    from apps.cli import servos_by_hand as tools

    sys.exit(tools.limits(profile, joints, port, baud, write))


# --- kinect, while it is down -----------------------------------------------------------------------


@kinect.command("calibrate")
def calibrate_kinect(
    board: Annotated[
        str, typer.Option(metavar="CxR", help="Inner corners of the chessboard, across and down.")
    ] = "9x6",
    square: Annotated[float, typer.Option(metavar="MM", help="The side of one square.")] = 25.0,
    views: Annotated[int, typer.Option(min=6, max=200, help="So many views are taken.")] = 30,
    source: Annotated[
        Path | None, typer.Option("--from", metavar="FOLDER", help="Views that were kept, instead of the device.")
    ] = None,
    keep: Annotated[Path | None, typer.Option(metavar="FOLDER", help="Keep the views, to calibrate from anew.")] = None,
    profile: ProfileOption = "robot",
    write: WriteOption = None,
) -> None:
    """Measure lenses, registration and depth curve from views of a chessboard. The robot must be down."""
    from apps.cli import kinect as tools

    sys.exit(tools.calibrate(profile, board, square, views, source, keep, write))


@kinect.command()
def tilt(
    angle: Annotated[float, typer.Argument(metavar="DEG", min=-30.0, max=30.0, help="Upward is positive.")],
    profile: ProfileOption = "robot",
) -> None:
    """Move the Kinect's own tilt motor. The robot's description wants it at 0: its neck tilts."""
    from apps.cli import kinect as tools

    sys.exit(tools.tilt(profile, angle))


# --- doctor ---------------------------------------------------------------------------------------


def doctor(
    profile: ProfileArgument = "robot",
    json: JsonOption = False,
) -> None:
    """Look over a machine and its robot before a run; each line is well, or says what to do. Exit code 1 if not."""
    from apps.cli import doctor as looking

    sys.exit(looking.doctor(profile, json))
