"""The solid parts of the simulated robot: shapes, masses and colours, attached to the links of the robot description.

The kinematics, the chassis, the mounting box, the pads' length and the marker come from the description. This module
adds what the description lacks: the thickness and mass of each link. It also puts the claws' pads at equal height; in
the maker's drawing they are 32 mm apart, which would tip a can over.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.robot import Robot
from sim.render.interface import Shape

PAD_GAP_M = 0.072
"""Distance of the pads at claw angle 0, where they are parallel. They hold a 66 mm can at less than 3 degrees."""
PAD_HEIGHT_M = 0.030
PAD_THICKNESS_M = 0.008
CASTER_RADIUS_M = 0.010
CASTER_X_M = 0.135
CHASSIS = "chassis"
"""Name of the root link. Its frame is the description's body frame."""

_WHITE = (0.82, 0.82, 0.80)
_GREY = (0.45, 0.45, 0.46)
_DARK = (0.13, 0.13, 0.14)
_METAL = (0.62, 0.63, 0.65)
_MAGENTA = (0.85, 0.05, 0.65)


@dataclass(frozen=True)
class Friction:
    """Friction coefficients of a link (spinning and rolling in metres). A contact has the product of both bodies'."""

    lateral: float = 0.6
    spinning: float = 0.0
    rolling: float = 0.0


@dataclass(frozen=True)
class Part:
    """One primitive, rigidly attached to a link of the description. Sizes as in `Visual`."""

    name: str
    shape: Shape
    size_m: tuple[float, ...]
    position_m: tuple[float, float, float]
    """Centre, in the link's frame."""
    rgb: tuple[float, float, float]
    mass_kg: float = 0.0
    axis: str = "z"
    """Axis of the link along which a cylinder lies."""
    solid: bool = True
    """Whether it collides."""

    def pose(self) -> FloatArray:
        """Transform from the part's frame to its link's, (4, 4)."""
        total = np.eye(4)
        if self.axis == "x":
            total[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
        elif self.axis == "y":
            total[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
        total[:3, 3] = self.position_m
        return total

    def inertia(self) -> FloatArray:
        """Inertia of the homogeneous part about its centre, in the link's axes; (3, 3), kg m^2."""
        if self.shape == "box":
            x, y, z = self.size_m
            diagonal = [(y * y + z * z) / 12, (x * x + z * z) / 12, (x * x + y * y) / 12]
        elif self.shape == "cylinder":
            radius, height = self.size_m
            across = radius * radius / 4 + height * height / 12
            diagonal = [across, across, radius * radius / 2]
        else:
            diagonal = [0.4 * self.size_m[0] ** 2] * 3
        turn = self.pose()[:3, :3]
        return np.asarray(self.mass_kg * turn @ np.diag(diagonal) @ turn.T)


@dataclass(frozen=True)
class Extra:
    """A link that is not in the description: fixed on the chassis, or a wheel that turns about y."""

    name: str
    position_m: tuple[float, float, float]
    wheel: bool = False


@dataclass(frozen=True)
class SimBody:
    """Everything solid: parts by link, the links that the description lacks, and friction by link."""

    parts: dict[str, list[Part]]
    extras: list[Extra]
    friction: dict[str, Friction] = field(default_factory=dict)

    @property
    def mass_kg(self) -> float:
        return sum(part.mass_kg for parts in self.parts.values() for part in parts)


def calliope_body(robot: Robot) -> SimBody:
    """Build the Calliope's parts. The chassis gets the rest of the robot's mass.

    The arm's masses give a static shoulder torque of 1.6 N m at full reach with an empty hand, as designed.
    """
    base, mount = robot.base, robot.kinect
    low, high = np.array(mount.mount_min_m), np.array(mount.mount_max_m)
    middle = tuple(float(v) for v in (low + high) / 2)
    wheel = robot.base.wheel_radius_m
    top_m = CASTER_RADIUS_M + base.chassis_height_m
    shoulder_x, arm_y, arm_z = robot.chain("arm_base").position({"arm_base": 0.0})
    parts: dict[str, list[Part]] = {
        "mount": [Part("mount", "box", tuple(float(v) for v in high - low), (0, 0, 0), _WHITE, 4.6)],
        "riser": [Part("riser", "cylinder", (0.025, 0.03), (0, 0, 0), _DARK, 0.10)],
        "wheel_left": _wheel("wheel_left", wheel),
        "wheel_right": _wheel("wheel_right", wheel),
        "caster_front": [Part("caster_front", "sphere", (CASTER_RADIUS_M,), (0, 0, 0), _METAL, 0.03)],
        "caster_rear": [Part("caster_rear", "sphere", (CASTER_RADIUS_M,), (0, 0, 0), _METAL, 0.03)],
        "neck_pan": [Part("neck_pan", "box", (0.05, 0.034, 0.034), (0, 0, 0.040), _DARK, 0.07)],
        "neck_tilt": [Part("neck_tilt", "box", (0.034, 0.034, 0.040), (0, 0.008, 0), _DARK, 0.07)],
        "camera": [
            Part("kinect", "box", (0.28, 0.040, 0.060), (0, 0, -0.034), _DARK, 0.55),
            Part("kinect_lens", "cylinder", (0.009, 0.003), (0, 0, -0.0035), _METAL, solid=False),
        ],
        "arm_base": [
            Part("arm_base_servo", "box", (0.045, 0.036, 0.030), (0, 0, -0.013), _DARK, 0.07),
            Part("arm_base_bracket", "box", (0.085, 0.034, 0.024), (0.045, 0, 0.012), _GREY, 0.05),
        ],
        "shoulder": [
            Part("shoulder_servo", "cylinder", (0.022, 0.046), (0, 0, 0), _DARK, 0.08),
            Part("upper_arm", "box", (0.105, 0.034, 0.036), (0.0725, 0, 0), _GREY, 0.06),
        ],
        "elbow": [
            Part("elbow_servo", "cylinder", (0.022, 0.046), (0, 0, 0), _DARK, 0.08),
            Part("forearm", "box", (0.082, 0.032, 0.034), (0.0615, 0, 0), _GREY, 0.05),
        ],
        "wrist_pitch": [
            Part("wrist_servo", "cylinder", (0.020, 0.044), (0, 0, 0), _DARK, 0.06),
            Part("roll_servo", "box", (0.036, 0.034, 0.036), (0.022, -0.0225, 0), _DARK, 0.055),
        ],
        "wrist_roll": [
            Part("palm", "box", (0.060, 0.034, 0.088), (0, 0, 0.090), _GREY, 0.13),
            Part("marker_stalk", "cylinder", (0.003, 0.024), (0, 0.028, 0.060), _DARK, 0.0, "y", solid=False),
        ],
    }
    ball = robot.marker
    parts[ball.link].append(Part("marker", "sphere", (ball.radius_m,), ball.position_m, _MAGENTA, solid=False))
    for claw in robot.claw.open_sign:
        parts[claw] = _claw(robot, claw)
    left = base.wheel_separation_m / 2
    rest = base.mass_kg - sum(part.mass_kg for rows in parts.values() for part in rows)
    radius, height = base.chassis_diameter_m / 2, base.chassis_height_m
    centre_z = CASTER_RADIUS_M + height / 2
    parts[CHASSIS] = [
        Part("chassis", "cylinder", (radius, height), (0, 0, centre_z), _METAL, rest - 0.9),
        # The battery sits behind the axle, as a counterweight to the arm.
        Part("battery", "box", (0.08, 0.16, 0.05), (-0.10, 0, centre_z), _DARK, 0.9, solid=False),
    ]
    arm_foot = (float(shoulder_x), float(arm_y), (top_m + arm_z - 0.028) / 2)
    return SimBody(
        parts,
        [
            Extra("mount", (middle[0], middle[1], middle[2])),
            Extra("riser", arm_foot),
            Extra("wheel_left", (0.0, left, wheel), wheel=True),
            Extra("wheel_right", (0.0, -left, wheel), wheel=True),
            Extra("caster_front", (CASTER_X_M, 0.0, CASTER_RADIUS_M)),
            Extra("caster_rear", (-CASTER_X_M, 0.0, CASTER_RADIUS_M)),
        ],
        {
            "wheel_left": Friction(1.0),
            "wheel_right": Friction(1.0),
            "caster_front": Friction(0.0),
            "caster_rear": Friction(0.0),
            **{claw: Friction(0.9, spinning=0.01) for claw in robot.claw.open_sign},
        },
    )


def _wheel(name: str, radius_m: float) -> list[Part]:
    """A wheel that touches the floor in one point, the middle of its tread: the solver then cannot choose where within
    the tread's width the wheel pivots."""
    return [
        Part(name, "cylinder", (radius_m, 0.02), (0, 0, 0), _DARK, 0.15, "y", solid=False),
        Part(f"{name}_tread", "sphere", (radius_m,), (0, 0, 0), _DARK),
    ]


def _claw(robot: Robot, claw: str) -> list[Part]:
    """Pad and bracket of one claw, in the claw link's frame, whose x points away from the roll axis."""
    hand = dict.fromkeys(robot.joints, 0.0)
    root, tip = robot.chain("wrist_roll").pose(hand), robot.chain("pad_centre").pose(hand)
    to_claw = np.linalg.inv(robot.chain(claw).pose(hand))
    reach = float((to_claw @ tip)[1, 3])  # from the claw's axis to the pad, along the roll axis
    offset = -float((to_claw @ root)[0, 3])  # from the roll axis to the claw's axis
    face = PAD_GAP_M / 2 - offset
    middle = face + PAD_THICKNESS_M / 2
    length = robot.claw.pad_length_m
    toward = 1.0 if reach > 0 else -1.0
    start = abs(reach) - length / 2
    return [
        Part(f"{claw}_pad", "box", (PAD_THICKNESS_M, length, PAD_HEIGHT_M), (middle, reach, 0), _DARK, 0.035),
        Part(
            f"{claw}_bracket",
            "box",
            (middle + PAD_THICKNESS_M / 2 + 0.010, start + 0.010, PAD_HEIGHT_M),
            ((middle + PAD_THICKNESS_M / 2 - 0.010) / 2, toward * (start - 0.010) / 2, 0),
            _GREY,
            0.045,
        ),
    ]
