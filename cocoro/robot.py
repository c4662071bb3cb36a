"""The robot by its description, ready for computing: what simulator, models and drivers read of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from math import pi, radians, tan
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec import UNSET

from cocoro.arrays import CodeArray, Float32Array, FloatArray
from cocoro.cameras import eye_of
from cocoro.description import Description, completed, read
from cocoro.description_limbs import Marker
from cocoro.errors import ConfigError, field_text
from cocoro.joints import GROUPS, Group, Joint, Network
from cocoro.kinematics import Chain, DenavitHartenberg, Link, Origin, Tree
from cocoro.link_row import LinkRow


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: pixel (u, v) right and down, camera frame x right, y down, z forward.

    A pixel's index is its centre (the top left pixel's centre is (0, 0)), so the image reaches from -0.5 to
    width - 0.5 and its middle is at (width - 1) / 2.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def ray(self, u_px: float, v_px: float) -> FloatArray:
        """Direction of a pixel in the camera frame with z = 1 (no unit), shape (3,)."""
        return np.array([(u_px - self.cx) / self.fx, (v_px - self.cy) / self.fy, 1.0])

    def scaled(self, width: int, height: int) -> Camera:
        """A camera like this one at another resolution."""
        sx, sy = width / self.width, height / self.height
        cx = (self.cx + 0.5) * sx - 0.5  # distances scale from the image's edge, which is at -0.5
        cy = (self.cy + 0.5) * sy - 0.5
        return Camera(width, height, self.fx * sx, self.fy * sy, cx, cy)


class Robot:
    """The description, ready for computing. Make it with `Robot.load()`."""

    def __init__(self, spec: Description) -> None:
        self._spec = spec
        self.name = spec.name
        self.base = spec.base
        self.drive = spec.base.drive
        self.cameras = {row.name: row for row in spec.camera}
        self.eye = eye_of(spec.camera, spec.eye)
        """The camera by which it finds things."""
        self.head = spec.head
        self.arm = spec.arm
        self.reach = None if spec.reach is UNSET else spec.reach
        self.marker = spec.marker
        self.networks: dict[str, Network] = spec.network
        """The serial lines by name."""
        self.claw = spec.claw
        self.hull = spec.hull
        self.poses = spec.pose
        self.solid = spec.solid
        groups = spec.groups
        self.joints = {
            row.name: Joint.of(row, spec.network[row.network].protocol, groups.get(row.name)) for row in spec.joint
        }
        self.links = {
            row.name: Link(row.name, row.parent, row.joint, _place_of(row), radians(row.offset_deg))
            for row in spec.link
        }

    @classmethod
    def load(cls, path: Path | None = None, override: Path | None = None) -> Robot:
        """Read the Calliope's description, or the one in `path`.

        `override` has only the values that were measured on one robot: tables are merged, and rows of `[[link]]`,
        `[[joint]]` and `[[hull.tube]]` by their name. Raises ConfigError naming file and field.
        """
        return cls(read(path, override))

    @classmethod
    def from_data(cls, data: Any, where: str = "robot description") -> Robot:
        """The robot that `to_data` described. Raises ConfigError naming the field.

        Captures carry the description as data. Those from before the description had `[hull]`, `claw.level_roll_deg`
        and the networks' `command_timeout_s` get the Calliope's hull and level roll, and the timeout of their base.
        """
        try:
            return cls(msgspec.convert(completed(data), Description))
        except msgspec.ValidationError as error:
            raise ConfigError(f"{where}: {field_text(error, Description)}") from error

    def to_data(self) -> dict[str, Any]:
        """The whole description as plain data."""
        data: dict[str, Any] = msgspec.to_builtins(self._spec)
        return data

    def with_base(self, **changes: float) -> Robot:
        """A robot like this one with other values in its `[base]` table."""
        return Robot(msgspec.structs.replace(self._spec, base=msgspec.structs.replace(self.base, **changes)))

    def with_networks(self, **changes: float | str) -> Robot:
        """A robot like this one with other values in all of its `[network]` tables."""
        networks = {name: msgspec.structs.replace(row, **changes) for name, row in self._spec.network.items()}
        return Robot(msgspec.structs.replace(self._spec, network=networks))

    def network_joints(self, network: str) -> tuple[str, ...]:
        """The joints on one serial line, those of no group included, in the order of their servo IDs."""
        rows = [joint for joint in self.joints.values() if joint.network == network]
        return tuple(joint.name for joint in sorted(rows, key=lambda joint: joint.id))

    def group_joints(self, group: Group) -> tuple[str, ...]:
        """The joints that a group's commands and states are about, in the order of their servo IDs."""
        rows = [joint for joint in self.joints.values() if joint.group == group]
        return tuple(joint.name for joint in sorted(rows, key=lambda joint: joint.id))

    def line_of(self, group: Group) -> str:
        """The serial line that all joints of a group are on."""
        return self.joints[self.group_joints(group)[0]].network

    def groups_on(self, line: str) -> tuple[Group, ...]:
        """The groups whose joints are on a serial line."""
        return tuple(group for group in GROUPS if self.line_of(group) == line)

    @property
    def wheel_line(self) -> str | None:
        """The serial line with the servos that turn the wheels; None where something else turns them."""
        return next((one.network for one in self.base.servo_places), None)

    @cached_property
    def jaws(self) -> tuple[str, ...]:
        """The joints that close the hand."""
        return tuple(self.claw.open_sign)

    @cached_property
    def fingers(self) -> tuple[str, ...]:
        """The two links that hold what is grasped: the jaws', and with one jaw the hand's, which has the fixed one."""
        moving = tuple(self.link_of(jaw) for jaw in self.jaws)
        return moving if self.claw.fixed_pad_m is None else (*moving, self.link_of(self.arm.roll))

    def link_of(self, joint: str) -> str:
        """The link that a joint moves. Raises KeyError naming a joint that moves none."""
        for link in self.links.values():
            if link.joint == joint:
                return link.name
        raise KeyError(f"joint {joint!r} moves no link")

    @property
    def the_marker(self) -> Marker:
        """The ball on the hand. Raises ConfigError where there is none."""
        if self.marker is None:
            raise ConfigError(f"{self.name} has no marker on its hand: its description has no table [marker]")
        return self.marker

    @cached_property
    def camera_chain(self) -> Chain:
        """From the body to the colour camera's frame: x right, y down, z forward."""
        return self.chain(self.eye.link)

    def lacks(self, parts: Iterable[str]) -> str:
        """The first of the parts (`cocoro.tasks.BodyPart`) that this robot does not have, a sentence; '' when it has
        them all."""
        without: dict[str, str] = {}
        if self.marker is None:
            without["marker"] = "has no marker on its hand that its camera could see"
        if self.head is None:
            without["neck"] = "has no neck: its camera is fixed on its body"
        return next((f"{self.name} {without[part]}" for part in parts if part in without), "")

    @cached_property
    def head_joints(self) -> tuple[str, ...]:
        """The joints that pan and tilt the camera; none where it is fixed on the body."""
        return (self.head.pan, self.head.tilt) if self.head is not None else ()

    def head_angles(self, pan_rad: float = 0.0, tilt_rad: float = 0.0) -> dict[str, float]:
        """The angles of the head's joints, rad, by their names; none of a camera that is fixed on the body."""
        return dict(zip(self.head_joints, (pan_rad, tilt_rad), strict=False))

    @cached_property
    def camera_pivot(self) -> str:
        """The link about whose place the camera tilts: that of the neck's tilt, or the fixed camera's own."""
        return self.link_of(self.head.tilt) if self.head is not None else self.eye.link

    def chain(self, tip: str) -> Chain:
        """The links from the body to the tip. Raises KeyError naming a link that is missing."""
        return Chain(self.links, tip)

    def tree(self, *tips: str) -> Tree:
        """The links from the body to the tips. Raises KeyError naming a link that is missing."""
        return Tree(self.links, tips)

    @cached_property
    def camera(self) -> Camera:
        k = self.eye
        return Camera(
            k.width,
            k.height,
            k.width / 2 / tan(k.horizontal_fov_rad / 2),
            k.height / 2 / tan(k.vertical_fov_rad / 2),
            (k.width - 1) / 2,  # 319.5, the middle of a symmetric view: see Camera
            (k.height - 1) / 2,
        )

    @property
    def sees_depth(self) -> bool:
        """Whether its pictures have depth beside colour."""
        return self.eye.depth != "none"

    def depth_m(self, raw: CodeArray) -> Float32Array:
        """Metres along the optical axis for the depth codes of `eye`, in their shape; no data is NaN."""
        return self._depth_table[np.minimum(raw, self.eye.no_depth_code)]

    def depth_code(self, depth_m: FloatArray) -> CodeArray:
        """Codes for metres along the optical axis, in their shape: the inverse of `depth_m` up to quantisation. Outside
        of the sensor's range it is that of no data. Raises ValueError for a camera without depth."""
        eye = self.eye
        inside = (depth_m >= eye.min_range_m) & (depth_m <= eye.max_range_m)
        if eye.depth == "mm":
            codes = np.rint(1000.0 * np.where(inside, depth_m, 1.0))
        else:
            a, b, c = eye.curve
            codes = np.rint(b * (np.arctan(np.where(inside, depth_m, 1.0) / a) - c))
        return np.where(inside, codes, eye.no_depth_code).astype(np.uint16)

    @cached_property
    def _depth_table(self) -> Float32Array:
        eye = self.eye
        codes = np.arange(eye.no_depth_code + 1)
        if eye.depth == "none":
            return np.full(len(codes), np.nan, dtype=np.float32)
        if eye.depth == "mm":
            table = np.maximum(codes / 1000.0, max(eye.min_range_m / 2, 0.05))  # nothing nearer is ever measured
        else:
            a, b, c = eye.curve
            angle = codes / b + c
            table = np.where(angle < pi / 2, a * np.tan(angle), np.nan)
        table[-1] = np.nan
        table[table > 2 * eye.max_range_m] = np.nan
        return table.astype(np.float32)


def _place_of(row: LinkRow) -> DenavitHartenberg | Origin:
    if row.xyz_m is not UNSET and row.rpy_deg is not UNSET:
        roll, pitch, yaw = row.rpy_deg
        return Origin(row.xyz_m, (radians(roll), radians(pitch), radians(yaw)))
    assert row.theta_deg is not UNSET
    assert row.d_m is not UNSET
    assert row.alpha_deg is not UNSET
    assert row.r_m is not UNSET
    return DenavitHartenberg(radians(row.theta_deg), row.d_m, radians(row.alpha_deg), row.r_m)
