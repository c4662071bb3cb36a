"""`cocoro kinect`: tools on the device itself, while its service is down."""

from __future__ import annotations

import re
import sys
from math import radians
from pathlib import Path
from typing import Annotated, Any

import typer

from apps.cli import exits
from apps.cli.options import AnyRobotOption, JsonOption, MeasuredOption, ProfileOption
from apps.cli.output import tell
from apps.cli.toml_files import write_values
from cocoro.component import load
from cocoro.errors import ConfigError, RefusedError
from cocoro.robot import Robot
from deploy import profiles
from deploy.processes import named
from deploy.profiles import Profile
from deploy.rundir import RunDir
from deploy.which_robot import profile_of
from services.kinect import calibration, tools

LARGEST_SQUARE_MM = 500.0


app = typer.Typer()
kinect = typer.Typer(no_args_is_help=True, help="Calibrate the Kinect; tilt it.")
app.add_typer(kinect, name="kinect")


@kinect.command()
def calibrate(
    board: Annotated[
        str, typer.Option(metavar="CxR", help="Inner corners of the chessboard, across and down.")
    ] = "9x6",
    square: Annotated[float, typer.Option(metavar="MM", help="The side of one square.")] = 25.0,
    views: Annotated[int, typer.Option(min=6, max=200, help="Number of views to take.")] = 30,
    source: Annotated[
        Path | None, typer.Option("--from", metavar="FOLDER", help="Views that were kept, instead of the device.")
    ] = None,
    keep: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Keep the views here, to calibrate from them again.")
    ] = None,
    profile: ProfileOption = "robot",
    robot: AnyRobotOption = None,
    measured: MeasuredOption = None,
    write: Annotated[
        Path | None,
        typer.Option("--write", metavar="FILE", help="Write the result into this file, not the robot's measured file."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Measure lenses, registration and depth curve from views of a chessboard. The robot must be down."""
    sys.exit(calibrate_from_views(profile, board, square, views, source, keep, write, robot, measured, json))


@kinect.command()
def tilt(
    angle: Annotated[float, typer.Argument(metavar="DEG", min=-30.0, max=30.0, help="Upward is positive.")],
    profile: ProfileOption = "robot",
) -> None:
    """Move the Kinect's own tilt motor. The robot's description expects it at 0, since the neck tilts."""
    tools.tilt(_config(profiles.read(profile)), radians(angle))


def calibrate_from_views(
    profile_name: str, size: str, square_mm: float, views: int, source: Path | None, keep: Path | None,
    write: Path | None, which: str | None = None, measured: Path | None = None, as_json: bool = False,
) -> int:  # fmt: skip
    """Takes views or reads them from `source`, calibrates, and writes the result into the robot's measured file.

    Raises ConfigError for an impossible board or square, RefusedError while the Kinect's service runs.
    """
    profile = profile_of(profile_name, which, measured)
    robot, file = _robot(profile, write)
    board = calibration.Board(*_board(size), _square_m(square_mm))

    def report(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    if source is not None:
        taken = tools.read(source, board, report)
    else:
        report(f"show the board ({size} inner corners) 0.6 to 2 m away, in every part of the picture, tilted every way")
        taken = tools.capture(_config(profile), board, views, keep, report)
    found = calibration.calibrate(taken, board, robot)
    if not as_json:
        _print(found)
    write_values(file, "camera", found.values(), robot.eye.name)
    tell(as_json, {"file": str(file), "views": found.views, "kinect": found.values()}, f"written to {file}")
    if not as_json and profile.measured is None:
        print(f'Name the file in the profile: measured = "{file}"')
    return exits.DONE


def _print(found: Any) -> None:
    fx, fy, cx, cy = found.colour_lens[:4]
    print(
        f"colour  fx {fx:.1f}, fy {fy:.1f}, middle {cx:.1f}, {cy:.1f}; corners within {found.colour_misfit_px:.2f} px"
    )
    fx, fy, cx, cy = found.depth_lens[:4]
    print(f"depth   fx {fx:.1f}, fy {fy:.1f}, middle {cx:.1f}, {cy:.1f}; within {found.depth_misfit_codes:.2f} codes")
    places = zip(found.depth_offset_m, found.offset_doubt_m, strict=True)
    offsets = ", ".join(f"{1000 * place:.1f} +- {1000 * doubt:.1f}" for place, doubt in places)
    print(f"place   {offsets} mm (x, y, z, in the colour camera's frame); {found.views} views")


def _config(profile: Profile) -> Any:
    if "kinect" in RunDir(profile.robot).claims():
        raise RefusedError(f"the Kinect's service of {profile.robot} is running: stop it with `cocoro down`")
    return profile.config("kinect", load(named("kinect")).config)


def _robot(profile: Profile, write: Path | None) -> tuple[Robot, Path]:
    """The robot by its description, without earlier measurements of its Kinect; and its measured file."""
    description, measured = profile.robot_files
    return Robot.load(description), write or measured or Path(f"{profile.robot}-measured.toml")


def _board(size: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)x(\d+)", size)
    columns, rows = (int(match[1]), int(match[2])) if match else (0, 0)
    if not (3 <= columns <= 40 and 3 <= rows <= 40):
        raise ConfigError(f"--board {size!r}: write the number of inner corners as 9x6, 3 to 40 each way")
    return columns, rows


def _square_m(square_mm: float) -> float:
    if not 1.0 <= square_mm <= LARGEST_SQUARE_MM:
        raise ConfigError(f"--square {square_mm:g}: the side of a square in mm, 1 to {LARGEST_SQUARE_MM:g}")
    return square_mm / 1000.0
