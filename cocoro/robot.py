"""The robot description: one TOML file that the simulator, the models and the drivers all read.

`calliope.toml` describes the Calliope. A robot's own file (`override`) has only the values that were measured on it.
"""

from __future__ import annotations

import tomllib
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
from cocoro.errors import ConfigError, field_text
from cocoro.kinematics import Chain, Link, Tree
from cocoro.units import Positive, Vec3

OWN_FILE = "calliope.toml"
_MISSING = f"; cocoro/{OWN_FILE} has every field, and a row with a new name needs all fields of its kind"

LensValues = tuple[float, float, float, float, float, float, float, float, float]
"""fx, fy, cx, cy in pixels, then OpenCV's distortion coefficients k1, k2, p1, p2, k3."""

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
    """A wheel command is valid for at most this time, at any speed."""
    state_rate_hz: Positive
    stand_within_s: Positive = 0.3
    """The wheels stand within this time after the last command, from any speed."""
    stand_reserve_s: Positive = 0.03
    """The part of `stand_within_s` reserved for the delivery of a command, one period of the loop that notices the
    silence, and the body's lag behind the ramp of its wheels."""

    def patience_s(self, speed_mps: float) -> float:
        """The age up to which a command counts when it turns the faster wheel at this speed; the ramp down to standing
        takes the rest of `stand_within_s`."""
        ramp_s = abs(speed_mps) / self.wheel_acceleration_mps2
        return max(min(self.command_timeout_s, self.stand_within_s - self.stand_reserve_s - ramp_s), 0.0)

    def speed_at_age_mps(self, age_s: float) -> float:
        """The highest wheel speed from which the base still stands in time when the last command has this age."""
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
    """Calibration of both lenses. The driver rectifies its images; readers of frames use the fields of view above."""
    depth_rotation_rad: Vec3 = (0.0, 0.0, 0.0)
    """Rotation vector from the depth camera's frame to the colour camera's."""


class Marker(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The ball on the hand that babbling looks at; `position_m` is in the link's frame."""

    link: str
    radius_m: Positive
    position_m: Vec3


class Network(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One bus of servos."""

    baud: int
    rate_hz: Positive
    command_timeout_s: Positive
    """A command to these joints is valid for this time."""


class Claw(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pad_length_m: Positive
    """Length of a finger and of the pad along it."""
    open_sign: dict[str, float]
    """By joint, the sign of the angles towards which it opens."""
    level_roll_deg: float
    """The wrist roll at which the claws lie level, for upright targets; the marker then stands above the hand."""

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


class Joint(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: str
    network: Literal["arm", "hand"]
    id: int
    limits_deg: tuple[float, float]
    torque_nm: Positive
    max_speed_radps: Positive
    compliance_deg: Annotated[float, Meta(ge=0)] = 0.0
    """Distance from the goal beyond which the servo pushes with all of `torque_nm`; 0: always."""
    overload_s: Positive = 5.0
    """A servo that pushes at its limit for this long is overloaded."""
    direction: Literal[-1, 1] = 1
    centre_count: float = (SERVO_COUNTS - 1) / 2

    def __post_init__(self) -> None:
        if not self.limits_deg[0] < self.limits_deg[1]:
            raise ValueError(f"joint {self.name}: limits_deg must rise, not {self.limits_deg}")

    @property
    def limits_rad(self) -> tuple[float, float]:
        return radians(self.limits_deg[0]), radians(self.limits_deg[1])

    def to_count(self, angle_rad: float) -> int:
        """The servo position nearest to a joint angle (radians), clipped to 0..1023."""
        count = round(self.centre_count + self.direction * angle_rad / SERVO_COUNT_RAD)
        return min(max(count, 0), SERVO_COUNTS - 1)

    def to_angle(self, count: float) -> float:
        """The joint angle, radians, of a servo position."""
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
    hull: Hull
    pose: dict[str, dict[str, float]]

    def __post_init__(self) -> None:
        """Refuses references to links and joints that the description does not have, circles of links, and boxes whose
        corners are swapped."""
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
        hull = [("hull.finger_turn_deg", name) for name in self.hull.finger_turn_deg]
        hull += [(f"hull.tube {tube.name}", name) for tube in self.hull.tube for name in (tube.start, tube.end)]
        for where, name in [("marker", self.marker.link), *hull]:
            if name not in parents:
                raise ValueError(f"{where}: there is no link {name!r}")
        for where, low_m, high_m in (
            ("kinect.mount_min_m", self.kinect.mount_min_m, self.kinect.mount_max_m),
            ("hull.kinect_min_m", self.hull.kinect_min_m, self.hull.kinect_max_m),
        ):
            if not all(low < high for low, high in zip(low_m, high_m, strict=True)):
                raise ValueError(f"{where}: {low_m} must be below {high_m} along each axis")
        poses = [(f"pose {name}", set(angles)) for name, angles in self.pose.items()]
        claws = [("claw", set(self.claw.open_sign)), ("hull.finger_turn_deg", set(self.hull.finger_turn_deg))]
        for where, named in [*poses, *claws]:
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

    def __init__(self, spec: _DescriptionFile) -> None:
        self._spec = spec
        self.name = spec.name
        self.base = spec.base
        self.kinect = spec.kinect
        self.marker = spec.marker
        self.networks: dict[str, Network] = {str(name): row for name, row in spec.network.items()}
        self.claw = spec.claw
        self.hull = spec.hull
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
        """Read the Calliope's description, or the one in `path`.

        `override` has only the values that were measured on one robot: tables are merged, and rows of `[[link]]`,
        `[[joint]]` and `[[hull.tube]]` by their name. Raises ConfigError naming file and field.
        """
        where = str(path or OWN_FILE)
        try:
            data = tomllib.loads(path.read_text(encoding="utf-8") if path else _own_text())
            if override is not None:
                where = str(override)
                _merge(data, tomllib.loads(override.read_text(encoding="utf-8")))
                where = f"{path} with {override}" if path else where  # either may have the wrong field
            return cls(msgspec.convert(data, _DescriptionFile))
        except (ValueError, OSError) as error:  # not UTF-8, not TOML, not a description, not there
            advice = _MISSING if "missing required field" in str(error) else ""
            raise ConfigError(f"robot description {where}: {error}{advice}") from error

    @classmethod
    def from_data(cls, data: Any, where: str = "robot description") -> Robot:
        """The robot that `to_data` described. Raises ConfigError naming the field.

        Captures carry the description as data. Those from before the description had `[hull]`, `claw.level_roll_deg`
        and the networks' `command_timeout_s` get the Calliope's hull and level roll, and the timeout of their base.
        """
        try:
            return cls(msgspec.convert(_completed(data), _DescriptionFile))
        except msgspec.ValidationError as error:
            raise ConfigError(f"{where}: {field_text(error, _DescriptionFile)}") from error

    def to_data(self) -> dict[str, Any]:
        """The whole description as plain data."""
        data: dict[str, Any] = msgspec.to_builtins(self._spec)
        return data

    def with_base(self, **changes: float) -> Robot:
        """A robot like this one with other values in its `[base]` table."""
        return Robot(msgspec.structs.replace(self._spec, base=msgspec.structs.replace(self.base, **changes)))

    def with_networks(self, **changes: float) -> Robot:
        """A robot like this one with other values in both of its `[network]` tables."""
        networks = {name: msgspec.structs.replace(row, **changes) for name, row in self._spec.network.items()}
        return Robot(msgspec.structs.replace(self._spec, network=networks))

    def network_joints(self, network: str) -> tuple[str, ...]:
        """The joints of one servo network, in the order of their servo IDs."""
        rows = [joint for joint in self.joints.values() if joint.network == network]
        return tuple(joint.name for joint in sorted(rows, key=lambda joint: joint.id))

    def chain(self, tip: str) -> Chain:
        """The links from the body to the tip. Raises KeyError naming a link that is missing."""
        return Chain(self.links, tip)

    def tree(self, *tips: str) -> Tree:
        """The links from the body to the tips. Raises KeyError naming a link that is missing."""
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
        """Metres along the optical axis for raw 11-bit depth codes, in their shape; no data (2047 and above) is NaN."""
        return self._depth_table[np.minimum(raw, 2047)]

    def depth_code(self, depth_m: FloatArray) -> CodeArray:
        """Raw codes for metres along the optical axis, in their shape: the inverse of `depth_m` up to quantisation.
        Outside of the sensor's range it is 2047."""
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


def _own_text() -> str:
    return resources.files("cocoro").joinpath(OWN_FILE).read_text(encoding="utf-8")


def _completed(data: Any) -> Any:
    """Recorded data with the fields that descriptions did not have yet when it was recorded."""
    if not isinstance(data, dict):
        return data
    claw, base, networks = (data.get(name) for name in ("claw", "base", "network"))
    if "hull" not in data or (isinstance(claw, dict) and "level_roll_deg" not in claw):
        own = tomllib.loads(_own_text())
        data = {"hull": own["hull"], **data}
        if isinstance(claw, dict):
            data["claw"] = {"level_roll_deg": own["claw"]["level_roll_deg"], **claw}
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
