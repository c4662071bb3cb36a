"""The solid parts of the simulated robot: shapes, masses and colours, attached to the links of the robot description.

Chassis, wheels, the mounting box, the marker and the claws' pads follow from the description's other tables; `solid`
has the rest. The claws' pads are put at equal height: in the maker's drawing they are 32 mm apart, which would tip a
can over.

An omni wheel is a wheel as the others on a hub that slides along the axle without resistance, and that is set back to
its place before each step, by a millimetre at most. So the floor's friction holds the wheel, and no force along the
axle gets from it to the body: what ideal rollers do. Along its driving direction it pushes with its motor's torque, up
to friction times load. The body therefore moves as the kinematics of its wheels say, slips where they push more than
the floor holds, and is held up by what it meets. Left out: the rollers' drag, the jolt from roller to roller, the
change of the point of contact from one row of rollers to the other, and the inertia of the wheels' own mass along their
axles. (PyBullet's anisotropic friction would need no hub. But friction along one direction alone is two parallel rows
of its solver; where the axle lies along one of the world's axes one row is nearly empty, takes all of the friction
cone, and the wheel slips.)
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import msgspec
import numpy as np

from cocoro.arrays import FloatArray
from cocoro.base import Base
from cocoro.description import Part
from cocoro.errors import ConfigError
from cocoro.robot import Robot

CASTER_RADIUS_M = 0.010
CASTER_X_M = 0.135
CHASSIS, MOUNT = "chassis", "mount"
"""Names of links: the root, whose frame is the description's body frame, and the box that holds the Kinect up."""
CASTERS = ("caster_front", "caster_rear")
"""Links of a differential base; omni wheels carry the robot alone."""

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
class Extra:
    """A link that is not in the description: fixed, a wheel that turns about y, or the hub of an omni wheel, which
    slides along y."""

    name: str
    position_m: tuple[float, float, float]
    kind: Literal["fixed", "wheel", "hub"] = "fixed"
    turn_rad: float = 0.0
    """About z: direction in which a wheel drives."""
    parent: str = CHASSIS


@dataclass(frozen=True)
class SimBody:
    """Everything solid: parts by link, the links that the description lacks, and friction by link."""

    parts: dict[str, list[Part]]
    extras: list[Extra]
    wheels: dict[str, float]
    """Radius by link, m, in the order of the base's drive."""
    friction: dict[str, Friction] = field(default_factory=dict)

    @property
    def mass_kg(self) -> float:
        return sum(part.mass_kg for parts in self.parts.values() for part in parts)


def pose_of(part: Part) -> FloatArray:
    """Transform from a part's frame to its link's, (4, 4)."""
    total = np.eye(4)
    if part.axis == "x":
        total[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    elif part.axis == "y":
        total[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    total[:3, 3] = part.position_m
    return total


def inertia_of(part: Part) -> FloatArray:
    """Inertia of a homogeneous part about its centre, in its link's axes; (3, 3), kg m^2."""
    if part.shape == "box":
        x, y, z = part.size_m
        diagonal = [(y * y + z * z) / 12, (x * x + z * z) / 12, (x * x + y * y) / 12]
    elif part.shape == "cylinder":
        radius, height = part.size_m
        across = radius * radius / 4 + height * height / 12
        diagonal = [across, across, radius * radius / 2]
    else:
        diagonal = [0.4 * part.size_m[0] ** 2] * 3
    turn = pose_of(part)[:3, :3]
    return np.asarray(part.mass_kg * turn @ np.diag(diagonal) @ turn.T)


def body_of_parts(robot: Robot) -> SimBody:
    """Build the robot's parts. The chassis gets the rest of the robot's mass."""
    base = robot.base
    parts: dict[str, list[Part]] = {}
    extras: list[Extra] = []
    if robot.eye.mount is not None:
        low, high = np.array(robot.eye.mount)
        x, y, z = ((low + high) / 2).tolist()
        mass_kg = robot.solid.mount_mass_kg
        parts[MOUNT] = [Part(MOUNT, MOUNT, "box", tuple((high - low).tolist()), rgb=_WHITE, mass_kg=mass_kg)]
        extras.append(Extra(MOUNT, (x, y, z)))
    on_body = [part for part in robot.solid.part if part.link == "body"]
    for part in on_body:
        if part.solid:
            extras.append(Extra(part.name, part.position_m))
            parts[part.name] = [msgspec.structs.replace(part, link=part.name, position_m=(0.0, 0.0, 0.0))]
    wheels, radii = _wheels(base)
    casters = CASTERS if base.kind == "differential" else ()
    parts |= {name: _wheel(name, radius_m) for name, radius_m in radii.items()}
    parts |= {wheel.name: [_hub(wheel.name)] for wheel in wheels if wheel.kind == "hub"}
    parts |= {name: [_caster(name)] for name in casters}
    for part in robot.solid.part:
        if part.link != "body":
            parts.setdefault(part.link, []).append(part)
    inside = [part for part in on_body if not part.solid]
    if (ball := robot.marker) is not None:
        marker = Part("marker", ball.link, "sphere", (ball.radius_m,), ball.position_m, _MAGENTA, solid=False)
        parts.setdefault(ball.link, []).append(marker)
    for jaw in robot.jaws:
        link = robot.link_of(jaw)
        parts.setdefault(link, []).extend(_jaw(robot, link))
        if robot.claw.fixed_pad_m is not None:
            parts.setdefault(robot.link_of(robot.arm.roll), []).append(_fixed_pad(robot, link, robot.claw.fixed_pad_m))
    rest = base.mass_kg - sum(part.mass_kg for rows in parts.values() for part in rows)
    rest -= sum(part.mass_kg for part in inside)
    size = base.chassis_diameter_m / 2, base.chassis_height_m
    centre = 0.0, 0.0, CASTER_RADIUS_M + base.chassis_height_m / 2
    parts[CHASSIS] = [Part("chassis", CHASSIS, "cylinder", size, centre, _METAL, rest), *inside]
    extras += [
        *wheels,
        *(Extra(name, (x, 0.0, CASTER_RADIUS_M)) for name, x in zip(casters, (CASTER_X_M, -CASTER_X_M), strict=False)),
    ]
    friction = dict.fromkeys(radii, Friction(1.0)) | dict.fromkeys(casters, Friction(0.0))
    friction |= {finger: Friction(0.9, spinning=0.01) for finger in robot.fingers}
    return SimBody(parts, extras, radii, friction)


def _wheels(base: Base) -> tuple[list[Extra], dict[str, float]]:
    """The links of the wheels, each in a frame whose y axis is its axle and whose x axis is where it drives, and the
    radii by wheel, m, in the order of the base's drive."""
    extras: list[Extra] = []
    if base.wheel_radius_m is not None:
        left_m, radius_m = base.axle_m / 2, base.wheel_radius_m
        for name, y in zip(base.drive.names, (left_m, -left_m), strict=True):
            extras.append(Extra(f"wheel_{name}", (0.0, y, radius_m), "wheel"))
        return extras, {extra.name: radius_m for extra in extras}
    for wheel in base.wheel:
        hub = Extra(f"hub_{wheel.name}", (*wheel.place_m, wheel.radius_m), "hub", wheel.drive_rad)
        extras += [hub, Extra(f"wheel_{wheel.name}", (0.0, 0.0, 0.0), "wheel", parent=hub.name)]
    return extras, {f"wheel_{wheel.name}": wheel.radius_m for wheel in base.wheel}


def _caster(name: str) -> Part:
    return Part(name, name, "sphere", (CASTER_RADIUS_M,), rgb=_METAL, mass_kg=0.03)


def _hub(name: str) -> Part:
    return Part(name, name, "cylinder", (0.01, 0.02), rgb=_DARK, mass_kg=0.02, axis="y", solid=False)


def _wheel(name: str, radius_m: float) -> list[Part]:
    """A wheel that touches the floor in one point, the middle of its tread: the solver then cannot choose where within
    the tread's width the wheel pivots."""
    return [
        Part(name, name, "cylinder", (radius_m, 0.02), rgb=_DARK, mass_kg=0.15, axis="y", solid=False),
        Part(f"{name}_tread", name, "sphere", (radius_m,), rgb=_DARK),
    ]


def _jaw(robot: Robot, link: str) -> list[Part]:
    """Pad and bracket of one claw, in its link's frame, whose x points away from the roll axis."""
    hand, claw = dict.fromkeys(robot.joints, 0.0), robot.claw
    root = robot.chain(robot.link_of(robot.arm.roll)).pose(hand)
    tip = robot.chain(robot.arm.tip).pose(hand)
    to_claw = np.linalg.inv(robot.chain(link).pose(hand))
    reach = float((to_claw @ tip)[1, 3])  # from the claw's axis to the pad, along the roll axis
    level = round(float((to_claw @ tip)[2, 3]), 9)  # both pads at one height, wherever on its axis a jaw has its frame
    axis = root if claw.fixed_pad_m is None else tip
    offset = -float((to_claw @ axis)[0, 3])  # from the hand's axis to the claw's
    face = claw.jaw_pad_m - offset
    thickness, height, length = claw.pad_thickness_m, claw.pad_height_m, claw.pad_length_m
    middle = face + thickness / 2
    toward = 1.0 if reach > 0 else -1.0
    start = abs(reach) - length / 2
    bracket = middle + thickness / 2 + 0.010, start + 0.010, height
    place = (middle + thickness / 2 - 0.010) / 2, toward * (start - 0.010) / 2, level
    return [
        Part(f"{link}_pad", link, "box", (thickness, length, height), (middle, reach, level), _DARK, 0.035),
        Part(f"{link}_bracket", link, "box", bracket, place, _GREY, 0.045),
    ]


def _fixed_pad(robot: Robot, jaw: str, from_axis_m: float) -> Part:
    """The pad that faces the only jaw, in the frame of the hand's link. Raises ConfigError when the jaw opens along
    neither x nor y of that frame."""
    hand, claw = dict.fromkeys(robot.joints, 0.0), robot.claw
    link = robot.link_of(robot.arm.roll)
    from_hand = np.linalg.inv(robot.chain(link).pose(hand))
    tip = (from_hand @ robot.chain(robot.arm.tip).pose(hand))[:3, 3]
    opens = (from_hand @ robot.chain(jaw).pose(hand))[:3, 0]
    along = int(np.abs(opens).argmax())
    if along == 2 or abs(opens[along]) < 0.99:
        raise ConfigError(f"{robot.name}: the jaw {jaw} opens along neither x nor y of the link {link}")
    size = [claw.pad_height_m, claw.pad_height_m, claw.pad_length_m]
    size[along] = claw.pad_thickness_m
    x, y, z = (tip - opens * (from_axis_m + claw.pad_thickness_m / 2)).tolist()
    return Part("fixed_pad", link, "box", tuple(size), (x, y, z), _DARK, 0.035)
