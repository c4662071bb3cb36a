"""What is read of a URDF: a tree of links, the joints between them, masses and solid shapes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from math import pi

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.kinematics import Origin
from cocoro.units import Vec3

HERE = Origin((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
FIXED, REVOLUTE, CONTINUOUS = "fixed", "revolute", "continuous"


@dataclass(frozen=True)
class Inertial:
    mass_kg: float
    place: Origin
    """The centre of mass, and the axes of `moments`, in the link's frame."""
    moments: FloatArray
    """(3, 3), kg m^2."""


@dataclass(frozen=True)
class Solid:
    """One `<collision>`: a primitive, as the description has it, or the box about a mesh."""

    shape: str
    """box, cylinder or sphere."""
    size_m: tuple[float, ...]
    place: FloatArray
    """Its frame in the link's, (4, 4). A cylinder lies along z."""

    @property
    def volume_m3(self) -> float:
        if self.shape == "box":
            return self.size_m[0] * self.size_m[1] * self.size_m[2]
        square = self.size_m[0] ** 2
        return 4 / 3 * pi * square * self.size_m[0] if self.shape == "sphere" else pi * square * self.size_m[1]


@dataclass(frozen=True)
class UrdfLink:
    name: str
    inertial: Inertial | None = None
    solids: tuple[Solid, ...] = ()
    unread: tuple[tuple[str, str], ...] = ()
    """Shapes that were not read: why, and which."""


@dataclass(frozen=True)
class UrdfJoint:
    name: str
    kind: str
    """FIXED, REVOLUTE or CONTINUOUS."""
    parent: str
    child: str
    place: Origin
    axis: Vec3 = (1.0, 0.0, 0.0)
    """Unit vector, in the child's frame."""
    limits_rad: tuple[float, float] | None = None
    effort_nm: float | None = None
    velocity_radps: float | None = None
    mimics: str | None = None
    """The joint that it follows, by one servo for both."""

    @property
    def moves(self) -> bool:
        return self.kind != FIXED


@dataclass(frozen=True)
class Urdf:
    """A tree: each link but `root` is the child of one joint."""

    name: str
    root: str
    links: dict[str, UrdfLink]
    joints: dict[str, UrdfJoint]
    """Parents before children."""
    above: dict[str, UrdfJoint] = field(default_factory=dict)
    """By link, the joint that it is the child of."""

    def below(self, link: str) -> Iterator[UrdfJoint]:
        """The joints whose parent the link is."""
        return (joint for joint in self.joints.values() if joint.parent == link)

    def chain(self, link: str) -> list[UrdfJoint]:
        """The joints from the root to the link."""
        found: list[UrdfJoint] = []
        while link in self.above:
            found.append(self.above[link])
            link = found[-1].parent
        return found[::-1]

    def moving(self, link: str) -> list[UrdfJoint]:
        """The joints from the root to the link that turn."""
        return [joint for joint in self.chain(link) if joint.moves]

    def poses(self) -> dict[str, FloatArray]:
        """Each link's frame (4, 4) in the root's, m, with all joints at 0."""
        found = {self.root: np.eye(4)}
        for joint in self.joints.values():
            found[joint.child] = found[joint.parent] @ joint.place.transform()
        return found
