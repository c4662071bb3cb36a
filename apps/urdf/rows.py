"""The rows of a description's `[[link]]` from the joints of a URDF.

A row's joint turns about the row's z axis, a URDF's about any axis of its child. A joint about another axis than z
becomes two rows: one whose z is the axis, which has the joint's name and turns, and a fixed one, which turns back to
the frame that the URDF's link has. Frames of links are thus those of the URDF, at all angles.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain, count
from math import degrees
from typing import Any

import numpy as np

from apps.urdf.model import CONTINUOUS, HERE, Urdf, UrdfJoint
from apps.urdf.values import UrdfError
from cocoro.arrays import FloatArray
from cocoro.kinematics import Origin
from cocoro.units import Vec3
from sim.body import CASTERS, CHASSIS, MOUNT

BODY = "body"
_DIGITS = 9
"""Of lengths in metres and of angles in degrees."""


class Rows:
    """The rows, and which of them are the frames of the URDF's links and the turns of its joints."""

    def __init__(
        self, urdf: Urdf, root: Origin, joints: tuple[str, ...], turns: Mapping[str, FloatArray] | None = None
    ) -> None:
        """`root`: the place of the URDF's root in the body's frame. `joints` are those that turn; others stand at 0.
        `turns`: by joint, the frame (4, 4) in the URDF's child about whose z it turns, where the choice matters. Raises
        UrdfError when such a joint cannot keep its name."""
        turns = turns or {}
        self.data: list[dict[str, Any]] = []
        wheels = ("left", "right", *(joint.name for joint in urdf.joints.values() if joint.kind == CONTINUOUS))
        self.taken = {BODY, CHASSIS, MOUNT, *CASTERS}
        self.taken |= {f"{kind}_{name}" for kind in ("wheel", "hub") for name in wheels}
        self.link: dict[str, str] = {}
        """By the URDF's link, the row with its frame."""
        self.joint: dict[str, str] = {}
        """By joint, the row that it turns."""
        for name in joints:
            if name in turns and name in self.taken:
                raise UrdfError(f"joint {name}: another link has that name; give it another in a copy of the file")
            if name in turns or not _about_z(urdf.joints[name]):
                self.joint[name] = self.free(name, "axis")
        self.link[urdf.root] = self.add(self.free(urdf.root, "link"), BODY, root)
        for joint in urdf.joints.values():
            parent, name = self.link[joint.parent], self.free(joint.child, "link")
            if joint.name in self.joint:
                frame = turns.get(joint.name, turn_to(joint.axis))
                turned = Origin.of(joint.place.transform() @ frame)
                parent = self.add(self.joint[joint.name], parent, turned, joint.name)
                self.link[joint.child] = self.add(name, parent, Origin.of(inverse_of(frame)))
            elif joint.name in joints:
                self.link[joint.child] = self.joint[joint.name] = self.add(name, parent, joint.place, joint.name)
            else:
                self.link[joint.child] = self.add(name, parent, joint.place)

    def free(self, name: str, kind: str = "") -> str:
        """The name, with its kind, then a number behind it if others have it. It is taken from now on."""
        base = f"{name}_{kind}" if kind else name
        numbered = (f"{base}_{number}" for number in count(2))
        found = next(tried for tried in chain((name, base), numbered) if tried not in self.taken)
        self.taken.add(found)
        return found

    def add(self, name: str, parent: str, place: Origin = HERE, joint: str | None = None) -> str:
        """A row of this name, which must be free. Returns the name."""
        row: dict[str, Any] = {"name": name, "parent": parent} | ({"joint": joint} if joint is not None else {})
        row["xyz_m"] = [rounded(value) for value in place.xyz_m]
        row["rpy_deg"] = [rounded(degrees(value)) for value in place.rpy_rad]
        self.data.append(row)
        return name


def inverse_of(pose: FloatArray) -> FloatArray:
    """The inverse of a rigid transform (4, 4)."""
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse


def rounded(value: float, digits: int = _DIGITS) -> float:
    return round(float(value), digits) + 0.0  # not -0.0


def turn_to(direction: FloatArray | Vec3) -> FloatArray:
    """The smallest turn (4, 4) that brings z to a direction, a unit vector (3,)."""
    x, y, z = (float(value) for value in direction)
    total = np.eye(4)
    if z < -1.0 + 1e-12:
        total[1, 1] = total[2, 2] = -1.0
        return total
    cross = np.array([[0.0, 0.0, x], [0.0, 0.0, y], [-x, -y, 0.0]])
    total[:3, :3] = np.eye(3) + cross + cross @ cross / (1.0 + z)
    return total


def _about_z(joint: UrdfJoint) -> bool:
    return float(np.abs(np.subtract(joint.axis, (0.0, 0.0, 1.0))).max()) < 1e-9
