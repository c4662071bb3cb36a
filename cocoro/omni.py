"""Kinematics of a base with three or more omni wheels: their rollers let each wheel move freely along its axle.

The rim of a wheel has the speed of the wheel's place on the body, projected on the direction in which the wheel drives:
one row of a matrix from the body's twist to the wheels (R. Siegwart, I. Nourbakhsh: Introduction to Autonomous Mobile
Robots, chapter 3; K. Lynch, F. Park: Modern Robotics, section 13.2, for rollers at right angles to the axle). The
reverse is its pseudoinverse: with more than three wheels, the motion that fits them best, and what is left is slip.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, radians, sin, sqrt
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from cocoro.drive import Twist, WheelDrive
from cocoro.units import Positive

_LEAST_DETERMINANT = 1e-4
"""Of the normal equations of unit rows, by the cube of the number of wheels. Three wheels at 120 degrees have 1/27."""

_Row = tuple[float, float, float]


class WheelServo(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The servo that turns a wheel."""

    network: str
    """The serial line that it is on."""
    id: Annotated[int, Meta(ge=0, le=253)]
    direction: Literal[-1, 1] = 1
    """-1: the wheel drives forwards when the servo's counts fall."""


class OmniWheel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One wheel of an omni base: its place on the body, and where it drives."""

    name: str
    distance_m: Positive
    """From the body frame's origin to the middle of the wheel."""
    angle_deg: float
    """Direction of the wheel from there, counter-clockwise from ahead."""
    radius_m: Positive
    drive_deg: float | None = None
    """Direction in which the wheel drives the body when it turns forwards, counter-clockwise from ahead; by default
    `angle_deg` + 90: all wheels forwards turn the body counter-clockwise."""
    servo: WheelServo | None = None
    """None: something else than a servo on one of the robot's lines turns it."""

    @property
    def place_m(self) -> tuple[float, float]:
        """x, y in the body frame."""
        angle_rad = radians(self.angle_deg)
        return self.distance_m * cos(angle_rad), self.distance_m * sin(angle_rad)

    @property
    def drive_rad(self) -> float:
        """Direction in which it drives, counter-clockwise from ahead."""
        return radians(self.angle_deg + 90.0 if self.drive_deg is None else self.drive_deg)

    @property
    def row(self) -> _Row:
        """Speed of its rim by the body's speed ahead, its turn rate (m) and its speed aside."""
        (x, y), ahead, aside = self.place_m, cos(self.drive_rad), sin(self.drive_rad)
        return ahead, x * aside - y * ahead, aside


class Omni(WheelDrive):
    """Omni wheels. Raises ValueError when they do not drive the body in all directions."""

    goes_aside = True
    in_step = True

    def __init__(self, wheels: Sequence[OmniWheel]) -> None:
        self.names = tuple(wheel.name for wheel in wheels)
        self._rows = [wheel.row for wheel in wheels]
        self.lever_m = max((abs(row[1]) for row in self._rows), default=0.0)
        self._inverse = _pseudoinverse(self._rows)

    def wheels(self, twist: Twist) -> tuple[float, ...]:
        ahead, turn, aside = twist
        return tuple(row[0] * ahead + row[1] * turn + row[2] * aside for row in self._rows)

    def twist(self, wheels: Sequence[float]) -> Twist:
        ahead, turn, aside = (
            sum(share * wheel for share, wheel in zip(row, wheels, strict=True)) for row in self._inverse
        )
        return Twist(ahead, turn, aside)


def _pseudoinverse(rows: Sequence[_Row]) -> list[list[float]]:
    """The three rows of the matrix of least squares by the normal equations. The turn is scaled by the wheels' mean
    lever, so that the equations are well conditioned and their determinant tells what the wheels cannot do."""
    scale = sqrt(sum(row[1] ** 2 for row in rows) / len(rows)) if rows else 0.0
    unit = [(row[0], row[1] / (scale or 1.0), row[2]) for row in rows]
    (a, b, c), (_, d, e), (_, _, f) = ([sum(row[i] * row[j] for row in unit) for j in range(3)] for i in range(3))
    cofactors = [
        [d * f - e * e, c * e - b * f, b * e - c * d],
        [c * e - b * f, a * f - c * c, b * c - a * e],
        [b * e - c * d, b * c - a * e, a * d - b * b],
    ]
    determinant = a * cofactors[0][0] + b * cofactors[0][1] + c * cofactors[0][2]
    if len(rows) < 3 or determinant < _LEAST_DETERMINANT * len(rows) ** 3:
        raise ValueError("its wheels do not move the body ahead, aside and round independently of each other")
    return [
        [sum(cofactors[i][j] * row[j] for j in range(3)) / determinant / (scale if i == 1 else 1.0) for row in unit]
        for i in range(3)
    ]
