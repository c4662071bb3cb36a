"""The robot description: one TOML file that the simulator, the models and the drivers all read."""

from __future__ import annotations

import tomllib
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from math import pi, radians, tan
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from cocoro.arrays import CodeArray, Float32Array, FloatArray
from cocoro.errors import ConfigError
from cocoro.kinematics import Chain, Link, Tree
from cocoro.units import Positive, Vec3

LensValues = tuple[float, float, float, float, float, float, float, float, float]
"""fx, fy, cx, cy in pixels, then k1, k2, p1, p2, k3 as OpenCV has them."""

SERVO_COUNTS = 1024
SERVO_RANGE_RAD = radians(300.0)
SERVO_COUNT_RAD = SERVO_RANGE_RAD / (SERVO_COUNTS - 1)
"""0..1023 stand for 0..300 degrees (ROBOTIS AX-12 manual)."""


class Base(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    wheel_separation_m: Positive
    wheel_radius_m: Positive
    chassis_diameter_m: Positive
    chassis_height_m: Positive
    mass_kg: Positive
    max_wheel_speed_mps: Positive
    wheel_acceleration_mps2: Positive
    command_timeout_s: Positive
    """No word counts for longer, however slow the wheels turn."""
    state_rate_hz: Positive
    stand_within_s: Positive = 0.3
    """Whoever falls silent: within so long the wheels stand, from whatever speed."""
    stand_reserve_s: Positive = 0.03
    """The part of that which is kept for the way of a word, a turn of the loop that acts on its absence, and the body
    behind the ramp of its wheels."""

    def patience_s(self, speed_mps: float) -> float:
        """How old a word may be on which the faster wheel turns at this speed. What is left of `stand_within_s` is the
        ramp down to standing."""
        ramp_s = abs(speed_mps) / self.wheel_acceleration_mps2
        return max(min(self.command_timeout_s, self.stand_within_s - self.stand_reserve_s - ramp_s), 0.0)

    def speed_at_age_mps(self, age_s: float) -> float:
        """The fastest that a wheel may turn on a word of this age, so that it stands in time if that was the last."""
        ramp_s = self.stand_within_s - self.stand_reserve_s - age_s
        return max(ramp_s, 0.0) * self.wheel_acceleration_mps2


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
    """What was measured of the two lenses; the driver straightens its pictures by it, so that readers of frames may
    reckon with the fields of view above."""
    depth_rotation_rad: Vec3 = (0.0, 0.0, 0.0)
    """How the depth camera is turned against the colour camera (rotation vector): from its frame into the latter's."""


class Marker(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The ball on the hand that babbling looks at; `position_m` in the link's frame."""

    link: str
    radius_m: Positive
    position_m: Vec3


class Network(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    baud: int
    rate_hz: Positive


class Claw(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pad_length_m: Positive
    open_sign: dict[str, float]


class Joint(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: str
    network: Literal["arm", "hand"]
    id: int
    limits_deg: tuple[float, float]
    torque_nm: Positive
    max_speed_radps: Positive
    compliance_deg: Annotated[float, Meta(ge=0)] = 0.0
    """How far from its goal the servo pushes with all of `torque_nm`, and with less when nearer; 0: always."""
    overload_s: Positive = 5.0
    """Pushing at its limit for so long is an overload."""
    direction: Literal[-1, 1] = 1
    centre_count: float = (SERVO_COUNTS - 1) / 2

    def __post_init__(self) -> None:
        if not self.limits_deg[0] < self.limits_deg[1]:
            raise ValueError(f"joint {self.name}: limits_deg must rise, not {self.limits_deg}")

    @property
    def limits_rad(self) -> tuple[float, float]:
        return radians(self.limits_deg[0]), radians(self.limits_deg[1])

    def to_count(self, angle_rad: float) -> int:
        """The servo position nearest to a joint angle, clipped to 0..1023."""
        count = round(self.centre_count + self.direction * angle_rad / SERVO_COUNT_RAD)
        return min(max(count, 0), SERVO_COUNTS - 1)

    def to_angle(self, count: float) -> float:
        """The joint angle in radians that a servo position stands for."""
        return self.direction * (count - self.centre_count) * SERVO_COUNT_RAD


class _LinkRow(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: str
    parent: str
    theta_deg: float
    d_m: float
    alpha_deg: float
    r_m: float
    joint: str | None = None
    offset_deg: float = 0.0


class _DescriptionFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: str
    base: Base
    kinect: Kinect
    link: list[_LinkRow]
    marker: Marker
    network: dict[Literal["arm", "hand"], Network]
    joint: list[Joint]
    claw: Claw
    pose: dict[str, dict[str, float]]

    def __post_init__(self) -> None:
        """Names must mean something: a link's parent and joint, and whatever else refers to one of them."""
        parents = {row.name: row.parent for row in self.link}
        joints = {joint.name for joint in self.joint}
        for row in self.link:
            above, passed = row.parent, {row.name}
            while above != "body":
                if above not in parents:
                    raise ValueError(f"link {row.name}: there is no link {above!r} to stand on")
                if above in passed:
                    raise ValueError(f"link {row.name}: its parents go in a circle at {above!r}")
                passed.add(above)
                above = parents[above]
            if row.joint is not None and row.joint not in joints:
                raise ValueError(f"link {row.name}: there is no joint {row.joint!r}")
        if self.marker.link not in parents:
            raise ValueError(f"marker: there is no link {self.marker.link!r}")
        poses = [(f"pose {name}", set(angles)) for name, angles in self.pose.items()]
        for where, named in [*poses, ("claw", set(self.claw.open_sign))]:
            if unknown := sorted(named - joints):
                raise ValueError(f"{where}: there is no joint {unknown[0]!r}")


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
        """Direction of a pixel, camera frame, with z = 1; shape (3,)."""
        return np.array([(u_px - self.cx) / self.fx, (v_px - self.cy) / self.fy, 1.0])

    def scaled(self, width: int, height: int) -> Camera:
        """The same camera at another resolution."""
        sx, sy = width / self.width, height / self.height
        cx = (self.cx + 0.5) * sx - 0.5  # what scales is the distance from the image's edge, at -0.5
        cy = (self.cy + 0.5) * sy - 0.5
        return Camera(width, height, self.fx * sx, self.fy * sy, cx, cy)


class Robot:
    """The description, ready to compute with. Make it with `Robot.load()`."""

    def __init__(self, spec: _DescriptionFile) -> None:
        self._spec = spec
        self.name = spec.name
        self.base = spec.base
        self.kinect = spec.kinect
        self.marker = spec.marker
        self.networks = spec.network
        self.claw = spec.claw
        self.poses = spec.pose
        self.joints = {joint.name: joint for joint in spec.joint}
        self.links = {
            row.name: Link(
                row.name,
                row.parent,
                row.joint,
                radians(row.theta_deg),
                row.d_m,
                radians(row.alpha_deg),
                row.r_m,
                radians(row.offset_deg),
            )
            for row in spec.link
        }

    @classmethod
    def load(cls, path: Path | None = None, override: Path | None = None) -> Robot:
        """Read the Calliope's own description, or another one.

        `override` is a robot's own file with just the values that were measured on that robot; tables are
        merged, and `[[link]]` and `[[joint]]` rows by their name. Raises ConfigError naming file and field.
        """
        file = path or resources.files("cocoro").joinpath("calliope.toml")
        where = str(path or "calliope.toml")
        try:
            data = tomllib.loads(file.read_text(encoding="utf-8"))
            if override is not None:
                where = str(override)
                _merge(data, tomllib.loads(override.read_text(encoding="utf-8")))
            return cls(msgspec.convert(data, _DescriptionFile))
        except (ValueError, OSError) as error:  # not UTF-8, not TOML, not a description, not there
            raise ConfigError(f"robot description {where}: {error}") from error

    @classmethod
    def from_data(cls, data: Any, where: str = "robot description") -> Robot:
        """From what `to_data` gave. Raises ConfigError naming the field."""
        try:
            return cls(msgspec.convert(data, _DescriptionFile))
        except msgspec.ValidationError as error:
            raise ConfigError(f"{where}: {error}") from error

    def to_data(self) -> dict[str, Any]:
        """The description as plain data, everything resolved."""
        data: dict[str, Any] = msgspec.to_builtins(msgspec.structs.replace(self._spec, base=self.base))
        return data

    def with_base(self, **changes: float) -> Robot:
        """The same robot with other values in its `[base]` table."""
        other = copy(self)
        other.base = msgspec.structs.replace(self.base, **changes)
        return other

    def network_joints(self, network: str) -> tuple[str, ...]:
        """The joints of one servo network, in the order of their servo IDs."""
        rows = [joint for joint in self.joints.values() if joint.network == network]
        return tuple(joint.name for joint in sorted(rows, key=lambda joint: joint.id))

    def chain(self, tip: str) -> Chain:
        return Chain(self.links, tip)

    def tree(self, *tips: str) -> Tree:
        return Tree(self.links, tips)

    @cached_property
    def camera(self) -> Camera:
        k = self.kinect
        return Camera(
            k.width,
            k.height,
            k.width / 2 / tan(k.horizontal_fov_rad / 2),
            k.height / 2 / tan(k.vertical_fov_rad / 2),
            (k.width - 1) / 2,  # 319.5, the middle of a symmetric view: see Camera
            (k.height - 1) / 2,
        )

    def depth_m(self, raw: CodeArray) -> Float32Array:
        """Raw 11-bit depth codes to metres along the optical axis; no data (2047 and beyond) becomes NaN."""
        return self._depth_table[np.minimum(raw, 2047)]

    def depth_code(self, depth_m: FloatArray) -> CodeArray:
        """Metres to raw codes, 2047 outside of the range; the inverse of `depth_m` up to quantisation."""
        a, b, c = self.kinect.depth_curve
        inside = (depth_m >= self.kinect.min_range_m) & (depth_m <= self.kinect.max_range_m)
        codes = np.rint(b * (np.arctan(np.where(inside, depth_m, 1.0) / a) - c))
        return np.where(inside, codes, 2047).astype(np.uint16)

    @cached_property
    def _depth_table(self) -> Float32Array:
        a, b, c = self.kinect.depth_curve
        angle = np.arange(2048) / b + c
        table = np.where(angle < pi / 2, a * np.tan(angle), np.nan)
        table[2047] = np.nan
        table[table > 2 * self.kinect.max_range_m] = np.nan
        return table.astype(np.float32)


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
