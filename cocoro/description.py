"""The tables and fields of a robot description, and their reading from TOML.

`calliope.toml` describes the Calliope. A robot's own file has only the values that were measured on it.
"""

from __future__ import annotations

import tomllib
from importlib import resources
from math import radians
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from cocoro.base import Base
from cocoro.errors import ConfigError
from cocoro.joints import Group, JointRow, LineName, Network, check_groups, check_lines
from cocoro.link_row import LinkRow
from cocoro.units import Positive, Vec3

OWN_FILE = "calliope.toml"
_MISSING = f"; cocoro/{OWN_FILE} has every field, and a row with a new name needs all fields of its kind"

LensValues = tuple[float, float, float, float, float, float, float, float, float]
"""fx, fy, cx, cy in pixels, then OpenCV's distortion coefficients k1, k2, p1, p2, k3."""


class Head(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The joints that turn the camera."""

    pan: str
    """About the vertical, counter-clockwise positive."""
    tilt: str
    """Down positive."""


class Arm(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the names of joints and links of the arm and the hand stand for."""

    joints: Annotated[tuple[str, ...], Meta(min_length=2)]
    """Those that bring the hand to a place, from the body out. The first one turns the arm about the vertical."""
    bend: str
    """The joint whose sign tells one way of reaching a place from the other. `pose.upright` has the sign to keep."""
    roll: str
    """It turns the hand about the hand's own axis. The hand begins at the link that it moves."""
    tip: str
    """The link whose origin goes to a target's centre. Its z axis points along the hand."""

    @property
    def azimuth(self) -> str:
        """The joint that turns the arm about the vertical."""
        return self.joints[0]


class Kinect(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    width: int
    height: int
    rate_hz: Positive
    horizontal_fov_rad: Positive
    vertical_fov_rad: Positive
    depth_offset_m: Vec3
    projector_offset_m: Vec3
    min_range_m: Positive
    max_range_m: Positive
    depth_curve: Vec3
    mount_min_m: Vec3
    mount_max_m: Vec3
    colour_lens: LensValues | None = None
    depth_lens: LensValues | None = None
    """Calibration of both lenses. The driver rectifies its images; readers of frames use the fields of view above."""
    depth_rotation_rad: Vec3 = (0.0, 0.0, 0.0)
    """Rotation vector from the depth camera's frame to the colour camera's."""
    link: str = "camera"  # what it was called before it could be called otherwise
    """The link that carries it, whose frame is the colour camera's: x right, y down, z forward."""


class Marker(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The ball on the hand that babbling looks at; `position_m` is in the link's frame."""

    link: str
    radius_m: Positive
    position_m: Vec3


class Claw(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pad_length_m: Positive
    """Length of a finger and of the pad along it."""
    open_sign: dict[str, float]
    """By joint, the sign of the angles towards which it opens."""
    level_roll_deg: float
    """The hand's roll at which the claws lie level, for upright targets; the marker then stands above the hand."""
    pad_gap_m: Positive
    """Distance of the pads at angle 0 of the claws, at which they are parallel."""
    pad_height_m: Positive
    pad_thickness_m: Positive

    @property
    def level_roll_rad(self) -> float:
        return radians(self.level_roll_deg)


class Tube(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A stretch of the arm's hull: balls evenly spaced from one link's origin to another's, both ends included."""

    name: str
    start: str
    end: str
    radius_m: Positive
    balls: Annotated[int, Meta(ge=2)]


class Hull(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The space that arm and hand take up, and the Kinect's housing, for keeping them apart."""

    kinect_min_m: Vec3
    kinect_max_m: Vec3
    """A box, body frame, that holds the Kinect's housing at every head angle."""
    finger_radius_m: Positive
    finger_turn_deg: dict[str, float]
    """By claw link, the angle in its x-y plane from its x axis to its finger."""
    tube: Annotated[list[Tube], Meta(min_length=1)]
    """From the chassis out. The first one turns on the chassis and is not checked against it."""


Shape = Literal["box", "sphere", "cylinder"]


class Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One primitive, rigidly attached to a link."""

    name: str
    link: str
    """`body` is the chassis. What is solid there can be touched by itself, under its own name."""
    shape: Shape
    size_m: tuple[float, ...]
    """Box: its three sides; cylinder: radius and height; sphere: radius."""
    position_m: Vec3 = (0.0, 0.0, 0.0)
    """Centre, in the link's frame."""
    rgb: Vec3 = (0.45, 0.45, 0.46)
    mass_kg: Annotated[float, Meta(ge=0)] = 0.0
    axis: Literal["x", "y", "z"] = "z"
    """Axis of the link along which a cylinder lies."""
    solid: bool = True
    """Whether it collides."""

    def __post_init__(self) -> None:
        sides = {"box": 3, "cylinder": 2, "sphere": 1}[self.shape]
        if len(self.size_m) != sides or min(self.size_m) <= 0.0:
            raise ValueError(f"part {self.name}: size_m of a {self.shape} is {sides} lengths, not {self.size_m}")


class Solid(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the simulator builds the robot of, besides chassis, wheels, mount, marker and pads, which follow from other
    tables."""

    mount_mass_kg: Annotated[float, Meta(ge=0)]
    part: list[Part]
    touching: list[tuple[str, str]] = []
    """Links that touch though no joint is between them: they do not collide. A part of the body is its own link, and
    `mount` is the mount."""


class Description(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: str
    base: Base
    kinect: Kinect
    head: Head
    link: list[LinkRow]
    arm: Arm
    marker: Marker
    network: dict[LineName, Network]
    joint: list[JointRow]
    claw: Claw
    hull: Hull
    pose: dict[str, dict[str, float]]
    solid: Solid

    def __post_init__(self) -> None:
        """Refuses what contradicts itself: names of links and joints that the description does not have, circles of
        links, lines with one ID twice, limbs whose joints move nothing or are on several lines, poses without a joint
        that they need, boxes whose corners are swapped."""
        self._check_links()
        self._check_places()
        self._check_limbs()
        for where, low_m, high_m in (
            ("kinect.mount_min_m", self.kinect.mount_min_m, self.kinect.mount_max_m),
            ("hull.kinect_min_m", self.hull.kinect_min_m, self.hull.kinect_max_m),
        ):
            if not all(low < high for low, high in zip(low_m, high_m, strict=True)):
                raise ValueError(f"{where}: {low_m} must be below {high_m} along each axis")

    @property
    def groups(self) -> dict[str, Group]:
        """By joint, the group that commands it. A joint that moves neither hand nor camera, such as a wheel's, is in
        none."""
        rows = {row.name: row for row in self.link}
        groups: dict[str, Group] = {}
        for tip in (self.arm.tip, self.kinect.link):
            row = rows.get(tip)
            while row is not None:
                if row.joint is not None:
                    groups[row.joint] = "arm"
                row = rows.get(row.parent)
        for joint in (self.arm.roll, *self.claw.open_sign):
            groups[joint] = "hand"
        return groups

    def _check_links(self) -> None:
        parents = {row.name: row.parent for row in self.link}
        joints = {joint.name for joint in self.joint}
        for row in self.link:
            above, passed = row.parent, {row.name}
            while above != "body":
                if above not in parents:
                    raise ValueError(f"link {row.name}: its parent {above!r} is not a link")
                if above in passed:
                    raise ValueError(f"link {row.name}: its parents go in a circle at {above!r}")
                passed.add(above)
                above = parents[above]
            if row.joint is not None and row.joint not in joints:
                raise ValueError(f"link {row.name}: there is no joint {row.joint!r}")

    def _check_places(self) -> None:
        links = {row.name for row in self.link}
        places = [("marker", self.marker.link), ("arm.tip", self.arm.tip), ("kinect.link", self.kinect.link)]
        places += [("hull.finger_turn_deg", name) for name in self.hull.finger_turn_deg]
        places += [(f"hull.tube {tube.name}", name) for tube in self.hull.tube for name in (tube.start, tube.end)]
        places += [(f"part {part.name}", part.link) for part in self.solid.part if part.link != "body"]
        for where, name in places:
            if name not in links:
                raise ValueError(f"{where}: there is no link {name!r}")
        named = {"mount", *links, *(part.name for part in self.solid.part if part.link == "body" and part.solid)}
        if unknown := sorted({link for pair in self.solid.touching for link in pair} - named):
            raise ValueError(f"solid.touching: there is no link {unknown[0]!r}")

    def _check_limbs(self) -> None:
        arm, joints = self.arm, {joint.name for joint in self.joint}
        check_lines(self.joint, self.network)
        limbs = [("claw", set(self.claw.open_sign)), ("head", {self.head.pan, self.head.tilt})]
        limbs.append(("arm", {*arm.joints, arm.roll}))
        poses = [(f"pose {name}", set(angles)) for name, angles in self.pose.items()]
        for where, named in [*poses, *limbs, ("hull.finger_turn_deg", set(self.hull.finger_turn_deg))]:
            if unknown := sorted(named - joints):
                raise ValueError(f"{where}: there is no joint {unknown[0]!r}")
        moved = {row.joint for row in self.link}
        for where, named in limbs:
            if idle := sorted(named - moved):
                raise ValueError(f"{where}: the joint {idle[0]!r} moves no link")
        if arm.bend not in arm.joints:
            raise ValueError(f"arm: bend = {arm.bend!r} is none of its joints {', '.join(arm.joints)}")
        check_groups(self.joint, groups := self.groups)
        if lost := [joint for joint in arm.joints if groups.get(joint) != "arm"]:
            raise ValueError(f"arm: the joint {lost[0]!r} is not between the body and the hand")
        for name, wanted in (("park", arm.joints), ("upright", arm.joints), ("unfolded", arm.joints[1:])):
            if missing := [joint for joint in wanted if joint not in self.pose.get(name, {})]:
                raise ValueError(f"pose {name}: the angle of {missing[0]!r} is missing")


def read(path: Path | None, override: Path | None) -> Description:
    """Read the description in `path` (None: the Calliope's), with the values of `override` in place of its own. Raises
    ConfigError naming file and field."""
    where = str(path or OWN_FILE)
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8") if path else _own_text())
        if override is not None:
            where = str(override)
            _merge(data, tomllib.loads(override.read_text(encoding="utf-8")))
            where = f"{path} with {override}" if path else where  # either may have the wrong field
        return msgspec.convert(data, Description)
    except (ValueError, OSError) as error:  # not UTF-8, not TOML, not a description, not there
        advice = _MISSING if "missing required field" in str(error) else ""
        raise ConfigError(f"robot description {where}: {error}{advice}") from error


def _own_text() -> str:
    return resources.files("cocoro").joinpath(OWN_FILE).read_text(encoding="utf-8")


def completed(data: Any) -> Any:
    """Recorded data with the fields that descriptions did not have yet when it was recorded."""
    if not isinstance(data, dict):
        return data
    claw, base, networks = (data.get(name) for name in ("claw", "base", "network"))
    own = tomllib.loads(_own_text())
    for table in ("hull", "head", "arm", "solid"):
        data = {table: own[table], **data}
    if isinstance(claw, dict):
        data["claw"] = {name: value for name, value in own["claw"].items() if name != "open_sign"} | claw
    if isinstance(poses := data.get("pose"), dict):
        data["pose"] = {name: own["pose"][name] for name in ("unfolded", "upright")} | poses
    if isinstance(networks, dict) and isinstance(base, dict) and "command_timeout_s" in base:
        timeout = {"command_timeout_s": base["command_timeout_s"]}
        networks = {name: timeout | row if isinstance(row, dict) else row for name, row in networks.items()}
        data = {**data, "network": networks}
    return data


def _merge(into: dict[str, Any], extra: dict[str, Any]) -> None:
    for key, value in extra.items():
        if isinstance(value, dict) and isinstance(into.get(key), dict):
            _merge(into[key], value)
        elif isinstance(value, list) and value and isinstance(value[0], dict) and isinstance(into.get(key), list):
            rows = {row.get("name"): row for row in into[key]}
            for row in value:
                if row.get("name") in rows:
                    _merge(rows[row["name"]], row)
                else:
                    into[key].append(row)
        else:
            into[key] = value
