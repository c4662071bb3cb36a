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
from msgspec import UNSET, Meta, UnsetType

from cocoro.base import Base
from cocoro.cameras import CameraRow, eye_of, with_rows
from cocoro.description_checks import (
    check_box,
    check_camera,
    check_claw,
    check_masses,
    check_names,
    check_poses,
    check_wheels,
)
from cocoro.description_limbs import Claw, Head, Hull, Marker, Reach
from cocoro.errors import ConfigError, choice_of
from cocoro.joints import Group, JointRow, LineName, Network, ServoPlace, check_groups, check_lines
from cocoro.link_row import LinkRow
from cocoro.units import Vec3

OWN_FILE = "calliope.toml"
SHIPPED = ("calliope", "lekiwi", "lekiwi-colour")
"""Robots whose descriptions the project ships: where a file is asked for, the bare name is that description."""
BASED_ON = "based_on"
"""Field of a file: the shipped description that it changes, with only its own values in the file."""
_MISSING = f"; cocoro/{OWN_FILE} has every field, and a row with a new name needs all fields of its kind"


class Arm(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the names of joints and links of the arm and the hand stand for."""

    joints: Annotated[tuple[str, ...], Meta(min_length=2)]
    """Those that bring the hand to a place, from the body out. The first one turns the arm about the vertical."""
    bend: str
    """The joint whose sign tells one way of reaching a place from the other. `pose.upright` has the sign to keep."""
    straight_deg: float | UnsetType = UNSET
    """Angle of `bend` at which the limbs on its two sides are in line: its sign counts from there. 0 by default."""
    roll: str
    """It turns the hand about the hand's own axis. The hand begins at the link that it moves."""
    tip: str
    """The link whose origin goes to a target's centre. Its z axis points along the hand."""

    @property
    def straight_rad(self) -> float:
        return 0.0 if self.straight_deg is UNSET else radians(self.straight_deg)

    @property
    def azimuth(self) -> str:
        """The joint that turns the arm about the vertical."""
        return self.joints[0]


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


class Description(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    name: str
    base: Base
    camera: Annotated[list[CameraRow], Meta(min_length=1)]
    eye: str = ""
    """Name of the camera by which the robot finds things, whose pictures are `kinect/frame`; '' is the first."""
    head: Head | None = None
    link: list[LinkRow]
    arm: Arm
    reach: Reach | UnsetType = UNSET
    marker: Marker | None = None
    """Without it the robot learns nothing from the sight of its hand."""
    network: dict[LineName, Network]
    joint: list[JointRow]
    claw: Claw
    hull: Hull
    pose: dict[str, dict[str, float]]
    solid: Solid

    def __post_init__(self) -> None:
        """Refuses what contradicts itself: names of links and joints that the description does not have, circles of
        links, lines with one ID twice, limbs whose joints move nothing or are on several lines, a camera that other
        joints turn than the head's, poses without a joint that they need, boxes with one corner or swapped ones, links
        that turn and have no mass."""
        self._check_links()
        self._check_places()
        self._check_limbs()
        links = {row.name: (row.parent, row.joint) for row in self.link}
        check_camera(eye_of(self.camera, self.eye).link, links, self._head_joints)
        check_claw(len(self.claw.open_sign), self.claw.fixed_pad_m)
        check_names("camera", [camera.name for camera in self.camera])
        for camera in self.camera:
            check_box(f"camera {camera.name}: mount_min_m", camera.mount_min_m, camera.mount_max_m)
        check_box("hull.kinect_min_m", self.hull.kinect_min_m, self.hull.kinect_max_m)
        check_masses(links, [part.link for part in self.solid.part if part.mass_kg > 0.0], self.claw.open_sign)

    @property
    def _head_joints(self) -> set[str]:
        return set() if self.head is None else {self.head.pan, self.head.tilt}

    @property
    def groups(self) -> dict[str, Group]:
        """By joint, the group that commands it. A joint that moves neither hand nor camera, such as a wheel's, is in
        none."""
        rows = {row.name: row for row in self.link}
        groups: dict[str, Group] = {}
        for tip in (self.arm.tip, eye_of(self.camera, self.eye).link):
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
        places = [("arm.tip", self.arm.tip), *((f"camera {row.name}: link", row.link) for row in self.camera)]
        places += [("marker", self.marker.link)] if self.marker is not None else []
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
        servos = [ServoPlace("joint", row.name, row.network, row.id) for row in self.joint]
        check_lines([*servos, *self.base.servo_places], self.network)
        check_wheels(self.base.servo_places, self.network)
        limbs = [("claw", set(self.claw.open_sign)), ("head", self._head_joints)]
        limbs.append(("arm", {*arm.joints, arm.roll}))
        poses = [(f"pose {name}", set(angles)) for name, angles in self.pose.items()]
        for where, named in [*poses, *limbs]:
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
        check_poses(self.pose, arm.joints)


def read(path: Path | None, override: Path | None) -> Description:
    """Read the description in `path`, a file or one of `SHIPPED` (None: the Calliope's), with the values of `override`
    in place of its own. Raises ConfigError naming file and field."""
    where = str(path or OWN_FILE)
    try:
        data = _whole(tomllib.loads(_text(where)))
        if override is not None:
            where = str(override)
            _merge(data, with_rows(tomllib.loads(override.read_text(encoding="utf-8")), data))
            where = f"{path} with {override}" if path else where  # either may have the wrong field
        return msgspec.convert(data, Description)
    except (ValueError, OSError) as error:  # not UTF-8, not TOML, not a description, not there
        advice = _MISSING if "missing required field" in str(error) else ""
        raise ConfigError(f"robot description {where}: {error}{advice}") from error


def _whole(data: dict[str, Any]) -> dict[str, Any]:
    """The data of a file with that of the description that it is based on."""
    name = data.pop(BASED_ON, None)
    if name is None:
        return with_rows(data)
    if name not in SHIPPED:
        raise ValueError(f"{BASED_ON}: {choice_of(str(name), SHIPPED)}")
    whole = _whole(tomllib.loads(_text(name)))
    _merge(whole, with_rows(data, whole))
    return whole


def is_shipped(file: str | Path) -> bool:
    """Whether a description is asked for by the name of a robot that the project ships, and not by its file."""
    return str(file) in SHIPPED


def base_of(file: str | Path) -> str | None:
    """The shipped description that a description changes; None where it stands for itself, or cannot be read."""
    try:
        base = tomllib.loads(_text(str(file))).get(BASED_ON)
    except (ValueError, OSError):  # `read` says what is wrong with it
        return None
    return base if isinstance(base, str) and is_shipped(base) else None


def _text(where: str) -> str:
    if is_shipped(where):
        where = f"{where}.toml"
    elif where != OWN_FILE:
        return Path(where).read_text(encoding="utf-8")
    return resources.files("cocoro").joinpath(where).read_text(encoding="utf-8")


def completed(data: Any) -> Any:
    """Recorded data with the fields that descriptions did not have yet when it was recorded."""
    if not isinstance(data, dict):
        return data
    data = with_rows(data)
    claw, base, networks = (data.get(name) for name in ("claw", "base", "network"))
    own = tomllib.loads(_text("calliope"))
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
