"""`cocoro kinect calibrate` and `tilt`: done with the device itself, while its service is down."""

from __future__ import annotations

import re
import sys
from math import radians
from pathlib import Path
from typing import Any

from apps.cli import exits
from apps.cli.robot_file import write_values
from cocoro.component import load
from cocoro.errors import ConfigError, RefusedError
from cocoro.robot import Robot
from deploy import profiles
from deploy.processes import named
from deploy.profiles import Profile
from deploy.rundir import RunDir
from services.kinect import calibration, tools

LARGEST_SQUARE_MM = 500.0


def calibrate(
    profile_name: str, size: str, square_mm: float, views: int, source: Path | None, keep: Path | None,
    write: Path | None,
) -> int:  # fmt: skip
    """Take views or read them, calibrate, and write what came of it into the robot's own file."""
    profile = profiles.read(profile_name)
    robot, file = _robot(profile, write)
    board = calibration.Board(*_board(size), _square_m(square_mm))

    def tell(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    if source is not None:
        taken = tools.read(source, board, tell)
    else:
        tell(f"show the board ({size} inner corners), 0.6 to 2 m away, in every part of the picture, tilted every way")
        taken = tools.capture(_config(profile), board, views, keep, tell)
    found = calibration.calibrate(taken, board, robot)
    write_values(file, "kinect", found.values())
    _print(found)
    print(f"written to {file}")
    if profile.measured is None:
        print(f'Name it in the profile: measured = "{file}"')
    return exits.DONE


def tilt(profile_name: str, angle_deg: float) -> int:
    tools.tilt(_config(profiles.read(profile_name)), radians(angle_deg))
    return exits.DONE


def _print(found: Any) -> None:
    fx, fy, cx, cy = found.colour_lens[:4]
    print(
        f"colour  fx {fx:.1f}, fy {fy:.1f}, middle {cx:.1f}, {cy:.1f}; corners within {found.colour_misfit_px:.2f} px"
    )
    fx, fy, cx, cy = found.depth_lens[:4]
    print(f"depth   fx {fx:.1f}, fy {fy:.1f}, middle {cx:.1f}, {cy:.1f}; within {found.depth_misfit_codes:.2f} codes")
    places = zip(found.depth_offset_m, found.offset_doubt_m, strict=True)
    told = ", ".join(f"{1000 * place:.1f} +- {1000 * doubt:.1f}" for place, doubt in places)
    print(f"place   {told} mm (x, y, z, in the colour camera's frame); {found.views} views")


def _config(profile: Profile) -> Any:
    if "kinect" in RunDir(profile.robot).claims():
        raise RefusedError("the Kinect's service runs: `cocoro down` first")
    return profile.config("kinect", load(named("kinect")).config)


def _robot(profile: Profile, write: Path | None) -> tuple[Robot, Path]:
    """As it is described, without what was measured of its Kinect before; and its own file."""
    measured = None if profile.measured is None else Path(profile.measured)
    description = None if profile.description is None else Path(profile.description)
    return Robot.load(description), write or measured or Path(f"{profile.robot}-measured.toml")


def _board(size: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)x(\d+)", size)
    columns, rows = (int(match[1]), int(match[2])) if match else (0, 0)
    if not (3 <= columns <= 40 and 3 <= rows <= 40):
        raise ConfigError(f"--board {size!r}: write the inner corners as 9x6, three or more each way")
    return columns, rows


def _square_m(square_mm: float) -> float:
    if not 1.0 <= square_mm <= LARGEST_SQUARE_MM:
        raise ConfigError(f"--square {square_mm:g}: the side of a square in mm, 1 to {LARGEST_SQUARE_MM:g}")
    return square_mm / 1000.0
