"""A calibration by LeRobot, and what it says of the joints of a robot description. Pure.

LeRobot keeps the calibration of an arm of Feetech servos (SO-100, SO-101, LeKiwi) in a JSON file, by motor: `id`,
`drive_mode`, `homing_offset`, `range_min` and `range_max`. Files from before its redesign of 2025 (pull request 777)
have other fields and another zero, the arm stretched level. Sources: huggingface/lerobot, `motors/motors_bus.py`,
`motors/feetech/`, `robots/so_follower/`, `robots/lekiwi/`; its documentation, "Backward compatibility"; Feetech's
memory table of the STS series.

- `homing_offset` is also in the servo (register 31, sign in bit 11), which reports its position less this offset. It
  makes the pose that was held at the start of the calibration 2047. The range is in positions that the servo reports.
- The range has the ends between which the joint was turned by hand. For a joint that can turn all the way round, and
  for wheels, LeRobot writes 0 to 4095 without measuring.
- In degrees, LeRobot's 0 is the middle of the range; the gripper is 0 to 100 from end to end. Neither is the zero of a
  description: here, the middle of the range is the middle of the joint's limits in the description. The two zeros
  agree where these limits are symmetric.
- `drive_mode` 1 turns a motor's sense round, but not in degrees. LeRobot itself writes 0 for these arms.
- A joint that passes from 4095 to 0 within its way is recorded wrongly, and nothing in the file tells it.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping
from math import degrees
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
from msgspec import Meta

from cocoro.errors import ConfigError, choice_of, field_text
from cocoro.joints import Joint
from cocoro.servo_units import UNITS, Protocol
from services.servos.family import signed
from services.servos.tools import MARGIN_DEG

PROTOCOL: Protocol = "feetech"
LAST = UNITS[PROTOCOL].counts - 1
OFFSET_SIGN = 1 << 11
TOP_OFFSET = OFFSET_SIGN - 1
FORMER = {"motor_names", "calib_mode"}
"""Keys of the files from before the redesign."""
WHOLE_TURN_DEG = 270.0
"""A joint whose limits are this far apart may have been recorded as one that turns all the way round."""
NARROWEST_DEG = 10.0
"""A joint that was turned by less was hardly turned."""

Count = Annotated[int, Meta(ge=0, le=LAST)]


class Motor(msgspec.Struct, frozen=True):
    """The calibration of a motor. Other fields, of later versions, are not read."""

    id: Annotated[int, Meta(ge=0, le=253)]
    drive_mode: Literal[0, 1]
    homing_offset: Annotated[int, Meta(ge=-TOP_OFFSET, le=TOP_OFFSET)]
    range_min: Count
    range_max: Count

    @property
    def whole_turn(self) -> bool:
        """Whether its range was not measured."""
        return (self.range_min, self.range_max) == (0, LAST)

    @property
    def range_deg(self) -> float:
        return (self.range_max - self.range_min) * degrees(UNITS[PROTOCOL].count_rad)


class Calibrated(NamedTuple):
    """A joint as a file calibrates it."""

    motor_name: str
    motor: Motor
    joint: Joint
    """With the values of the file."""
    doubt_deg: float
    """By so much its zero may be wrong: half of the difference between the range and the description's limits."""

    @property
    def values(self) -> dict[str, Any]:
        """For its [[joint]] row. The limits stay the description's where LeRobot did not measure the range."""
        values: dict[str, Any] = {"direction": self.joint.direction, "centre_count": self.joint.centre_count}
        return values if self.motor.whole_turn else {**values, "limits_deg": self.joint.limits_deg}

    def differs_by(self, register: int) -> int:
        """By how much the servo's register `offset` is above the file's."""
        return signed(register, OFFSET_SIGN) - self.motor.homing_offset


class Calibration(NamedTuple):
    """What a file says of a robot's joints."""

    joints: tuple[Calibrated, ...]
    left_out: tuple[str, ...]
    """Motors that calibrate no joint, each with the reason."""
    missing: tuple[str, ...]
    """Joints of the same lines, commanded ones, that the file does not calibrate."""


def read(text: bytes, where: str) -> dict[str, Motor]:
    """The motors of a file by name. Raises ConfigError when the text is no JSON, no calibration by LeRobot, or has a
    value that an STS servo cannot have."""
    try:
        data = json.loads(text.decode(), object_pairs_hook=_unique)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{where} is no JSON: {error}") from error
    if isinstance(data, dict) and data.keys() >= FORMER:
        raise ConfigError(
            f"{where} is from before LeRobot's redesign of 2025 and has no ranges: calibrate with a later LeRobot, or"
            " with `cocoro servos calibrate`"
        )
    if not isinstance(data, dict) or not data or not all(isinstance(row, dict) for row in data.values()):
        raise ConfigError(f"{where} is no calibration by LeRobot, which has a table for each motor")
    motors = {name: _motor(row, f"{where}, {name!r}") for name, row in data.items()}
    names: dict[int, str] = {}
    for name, motor in motors.items():
        if (other := names.setdefault(motor.id, name)) != name:
            raise ConfigError(f"{where}: {other!r} and {name!r} both have the ID {motor.id}")
    return motors


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"{next(name for name in names if names.count(name) > 1)!r} is there twice")
    return found


def _motor(row: dict[str, Any], where: str) -> Motor:
    try:
        motor = msgspec.convert(row, Motor)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{where}: {field_text(error, Motor)}") from error
    if not motor.range_min < motor.range_max:
        raise ConfigError(f"{where}: range_min must be below range_max, not {motor.range_min} and {motor.range_max}")
    return motor


def calibration(
    motors: Mapping[str, Motor],
    joints: Iterable[Joint],
    nominal: Mapping[str, Joint],
    line: str | None = None,
    reverse: Collection[str] = (),
) -> Calibration:
    """The joints that the motors calibrate, found by their IDs on lines of Feetech servos.

    `joints`: the robot's, with its measured IDs and lines. `nominal`: by name, those of its description alone, whose
    directions and limits count. `line`: only the joints on it. `reverse`: names of joints that turn against the
    description. Raises ConfigError when there is no such line, when an ID is that of joints on several lines, when a
    motor has a joint's name and another one's ID, and for a joint of `reverse` that the motors do not calibrate.
    """
    known = [joint for joint in joints if joint.units == UNITS[PROTOCOL] and line in (None, joint.network)]
    if not known:
        where = f"line {line}" if line else "a line"
        raise ConfigError(f'no joint of the robot description is on {where} of Feetech servos, protocol = "feetech"')
    lines = ", ".join(dict.fromkeys(joint.network for joint in known))
    found, left_out = list[Calibrated](), list[str]()
    for name, motor in motors.items():
        joint = _joint_of(name, motor, known)
        if joint is None:
            left_out.append(f"{name!r}: no joint on line {lines} has the ID {motor.id}")
        elif reason := _unusable(motor, nominal.get(joint.name, joint)):
            left_out.append(f"{name!r}, {joint.name}: {reason}")
        else:
            found.append(_calibrated(name, motor, joint, nominal.get(joint.name, joint), joint.name in reverse))
    there = [one.joint.name for one in found]
    if unknown := [name for name in reverse if name not in there]:
        raise ConfigError(f"there is no calibrated joint {unknown[0]!r} to reverse; {choice_of(unknown[0], there)}")
    missing = tuple(joint.name for joint in known if joint.group is not None and joint.name not in there)
    return Calibration(tuple(found), tuple(left_out), missing)


def _joint_of(name: str, motor: Motor, known: Collection[Joint]) -> Joint | None:
    """LeRobot puts a prefix before the names of an arm's motors when there are others."""
    alike = [joint for joint in known if joint.id == motor.id]
    if len(alike) > 1:
        places = " and ".join(f"{joint.name} on {joint.network}" for joint in alike)
        raise ConfigError(f"ID {motor.id} of {name!r} is that of {places}: choose one with --line")
    namesakes = [joint for joint in known if f"_{name}".endswith(f"_{joint.name}")]
    if namesakes and not {joint.name for joint in alike} & {joint.name for joint in namesakes}:
        other = f"where the ID {motor.id} is that of {alike[0].name}" if alike else "so it is the file of another robot"
        raise ConfigError(f"{name!r} has the ID {motor.id}, but the description's {namesakes[0].name} has"
                          f" {namesakes[0].id}, {other}")  # fmt: skip
    return alike[0] if alike else None


def _unusable(motor: Motor, joint: Joint) -> str:
    """Why a motor cannot calibrate its joint; '' when it can."""
    if motor.whole_turn and joint.group is None:
        return "a wheel, which has neither zero nor limits"
    if motor.whole_turn and joint.limits_deg[1] - joint.limits_deg[0] < WHOLE_TURN_DEG:
        return (
            "its range is all of the servo's, so it passed from 4095 to 0 or was not measured: use `cocoro servos"
            " calibrate`"
        )
    if motor.range_deg < NARROWEST_DEG:
        return f"it was turned by {motor.range_deg:.1f} degrees only"
    return ""


def _calibrated(name: str, motor: Motor, joint: Joint, nominal: Joint, reverse: bool) -> Calibrated:
    count_deg = degrees(joint.units.count_rad)
    low, high = nominal.limits_deg
    middle = (low + high) / 2
    direction = nominal.direction * (-1 if motor.drive_mode else 1) * (-1 if reverse else 1)
    centre = (motor.range_min + motor.range_max) / 2 - direction * middle / count_deg
    reach = motor.range_deg / 2 - MARGIN_DEG
    limits, doubt = (low, high), 0.0
    if not motor.whole_turn:
        limits, doubt = (round(middle - reach, 1), round(middle + reach, 1)), abs(motor.range_deg - (high - low)) / 2
    joint = msgspec.structs.replace(joint, direction=direction, centre_count=round(centre, 2), limits_deg=limits)
    return Calibrated(name, motor, joint, doubt)
