"""`cocoro servos import`: the zeros, directions and limits of a calibration that LeRobot has made."""

from __future__ import annotations

import sys
from math import degrees
from pathlib import Path
from typing import Annotated, Any

import typer

from apps.cli import exits
from apps.cli.options import AnyRobotOption, JsonOption, MeasuredOption, ProfileOption
from apps.cli.output import complain, print_json
from apps.cli.servo_bench import BaudOption, PortOption, ServoWorkbench, WriteOption
from apps.cli.terminal import print_table
from apps.cli.toml_files import write_values
from cocoro.errors import ConfigError, choice_of
from cocoro.robot import Robot
from services.servos import lerobot
from services.servos.bus import SilentError
from services.servos.lerobot import Calibrated, Calibration

DOUBT_DEG = 5.0
"""A zero that may be wrong by more than this is told."""


def import_lerobot(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="LeRobot's calibration of the arm, a JSON file.")],
    check: Annotated[
        bool,
        typer.Option(
            "--check",
            help="First compare with the servos, and show the joints' angles. If one differs, nothing is written."
            " The robot must be down.",
        ),
    ] = False,
    reverse: Annotated[
        list[str] | None,
        typer.Option(metavar="JOINT", help="A joint that turns against the robot description. Repeatable."),
    ] = None,
    line: Annotated[str | None, typer.Option(metavar="NAME", help="Only the joints on this serial line.")] = None,
    profile: ProfileOption = "robot",
    port: PortOption = None,
    baud: BaudOption = None,
    write: WriteOption = None,
    robot: AnyRobotOption = None,
    measured: MeasuredOption = None,
    json: JsonOption = False,
) -> None:
    """Take over zeros and limits from a calibration by LeRobot, of Feetech servos as in an SO-101 or a LeKiwi."""
    motors = lerobot.read(_content(file), str(file))
    bench = ServoWorkbench.of(profile, write, robot, measured)
    if line is not None and line not in bench.robot.networks:
        raise ConfigError(f"there is no line {line!r}; {choice_of(line, bench.robot.networks)}")
    nominal = Robot.load(bench.profile.robot_files[0]).joints
    found = lerobot.calibration(motors, bench.robot.joints.values(), nominal, line, reverse or [])
    sys.exit(take_over(bench, found, str(file), _Look(bench, port, baud) if check else None, json))


def _content(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise ConfigError(f"{file} cannot be read: {error.strerror}") from error


class _Look:
    """What the servos on the line say."""

    def __init__(self, bench: ServoWorkbench, port: str | None, baud: int | None) -> None:
        self._bench, self._port, self._baud = bench, port, baud
        self.angle_deg: dict[str, float] = {}
        self.wrong: list[str] = []
        """What differs from the file, by sentences."""

    def at(self, one: Calibrated) -> None:
        """Reads a servo's offset and position. Raises PortError."""
        joint = one.joint
        try:
            with self._bench.line(joint, self._port, self._baud) as line:
                differs = one.differs_by(line.read(joint.id, "offset"))
                angle = degrees(joint.to_angle(line.reading(joint.id).position))
        except SilentError:
            self.wrong.append(f"{joint.name} (ID {joint.id}) does not answer")
            return
        if differs:
            wants = one.motor.homing_offset
            text = f"{joint.name} (ID {joint.id}) has the homing offset {wants + differs}, in the file it is {wants}"
            self.wrong.append(text)
        else:
            self.angle_deg[joint.name] = round(angle, 1)


def take_over(bench: ServoWorkbench, found: Calibration, file: str, look: _Look | None, as_json: bool) -> int:
    """Prints the values and writes them into the robot's own file; the exit code is 1 when there are none, or when the
    servos differ from the file, so that nothing is written."""
    wrong, angles = list[str](), dict[str, float]()
    if look is not None:
        for one in found.joints:
            look.at(one)
        wrong, angles = look.wrong, look.angle_deg
    writes = bool(found.joints) and not wrong
    if as_json:
        print_json(_data(bench, found, wrong, angles, writes))
    else:
        _print(found, angles)
    for text in wrong:
        complain(text)
    if wrong:
        complain(
            f"nothing is written: {file} is not what these servos have; connect the arm with LeRobot, which writes its"
            " file into them, or use `cocoro servos calibrate`"
        )
    elif not found.joints:
        complain(f"nothing is written: {file} calibrates no joint of this robot")
    else:
        for one in found.joints:
            write_values(bench.file, "joint", one.values, one.joint.name)
        if not as_json:
            _print_advice(bench, found, file)
    return exits.DONE if writes else exits.FAILED


def _data(
    bench: ServoWorkbench, found: Calibration, wrong: list[str], angles: dict[str, float], writes: bool
) -> dict[str, Any]:
    joints = [
        {
            "joint": one.joint.name,
            "motor": one.motor_name,
            "id": one.motor.id,
            **one.values,
            "zero_doubt_deg": round(one.doubt_deg, 1),
            "angle_deg": angles.get(one.joint.name),
        }
        for one in found.joints
    ]
    written = str(bench.file) if writes else None
    return {"joints": joints, "left_out": found.left_out, "missing": found.missing, "wrong": wrong, "written": written}


def _print(found: Calibration, angles: dict[str, float]) -> None:
    rows = []
    for one in found.joints:
        values, joint = one.values, one.joint
        limits = "as before" if one.motor.whole_turn else f"{joint.limits_deg[0]:g} to {joint.limits_deg[1]:g}"
        angle = f"{angles[joint.name]:g}" if joint.name in angles else ""
        row = (joint.name, one.motor_name, str(joint.id), f"{joint.direction:+d}", str(values["centre_count"]), limits)
        rows.append((*row, angle))
    if rows:
        print_table(("joint", "motor", "id", "direction", "centre", "limits, deg", "now, deg"), rows)
    for text in found.left_out:
        print(f"left out: {text}")
    if found.missing:
        print(f"not in the file: {', '.join(found.missing)}")
    sys.stdout.flush()


def _print_advice(bench: ServoWorkbench, found: Calibration, file: str) -> None:
    print(f"written to {bench.file}")
    if bench.profile.measured is None:
        print(f'Name the file in the profile: measured = "{bench.file}"')
    for one in found.joints:
        if one.doubt_deg > DOUBT_DEG:
            print(
                f"{one.joint.name}: LeRobot's range of {one.motor.range_deg:.0f} degrees is not as wide as the"
                f" description's limits: its zero may be wrong by {one.doubt_deg:.0f} degrees"
            )
        if one.motor.whole_turn:
            print(f"{one.joint.name}: LeRobot measured no ends: its zero is the pose that was held for it")
    print("Which way a joint turns is the robot description's word: LeRobot's file does not tell it.")
    print(
        f"Before the first start turn the limp joints to known poses: `cocoro servos import {file} --check`"
        " shows their angles. A joint that turns the wrong way needs --reverse, a wrong zero `cocoro servos calibrate`."
    )
