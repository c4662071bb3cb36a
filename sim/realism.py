"""The simulated body's differences from a perfect one: errors of servos and wheels, and errors of making and wear.

The camera's errors are in `sim.camera`, the latencies in `sim.service`. Everything is drawn from the run's seed, so the
same seed gives the same body.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from math import exp, radians, sqrt
from typing import Any

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.robot import Robot
from sim.kinds import BodyKind, Sensors
from sim.seeds import stream


@dataclass(frozen=True)
class BodyRealism:
    """Errors of servos, wheels and odometry."""

    backlash_deg: float = 0.0
    servo_speed_scatter: float = 0.0
    """Standard deviation of a servo's speed about the commanded one, as a share of it."""
    wheel_scale_error: float = 0.0
    """A wheel's distance differs from the nominal one by a share drawn uniformly within +- this, constant for the
    run."""
    wheel_slip: float = 0.0
    """Standard deviation of a wheel's slip, as a share of its distance."""
    scatter_time_s: float = 0.5
    slip_time_s: float = 0.2
    """Correlation times of servo speed scatter and of wheel slip."""
    exact_odometry: bool = True


REALISM: dict[Sensors, BodyRealism] = {
    "ideal": BodyRealism(),
    "real": BodyRealism(
        backlash_deg=0.5,
        servo_speed_scatter=0.02,
        wheel_scale_error=0.02,
        wheel_slip=0.01,
        exact_odometry=False,
    ),
}


def wheel_scales(seed: int, realism: BodyRealism, wheels: int) -> FloatArray:
    """Distance that each wheel rolls per nominal metre in the run `seed`, (wheels,)."""
    return np.asarray(1.0 + stream(seed, "wheel scale").uniform(-1.0, 1.0, wheels) * realism.wheel_scale_error)


class Wander:
    """A first-order autoregressive process of mean 0 and standard deviation `sigma` in each channel.

    White noise at the rate of the physics would average out; this noise is correlated over about `time_s`.
    """

    def __init__(self, draws: np.random.Generator, channels: int, sigma: float, time_s: float, dt_s: float) -> None:
        self._draws = draws
        self._keep = exp(-dt_s / time_s)
        self._add = sigma * sqrt(1.0 - self._keep**2)
        self.values: FloatArray = sigma * draws.standard_normal(channels)

    def step(self) -> FloatArray:
        """The next values, (channels,), `dt_s` later."""
        self.values = self._keep * self.values + self._add * self._draws.standard_normal(self.values.size)
        return self.values


LENGTH_M = 0.005
"""Largest error of each length of the arm's links."""
ZERO_DEG = 2.0
"""Largest error of the zero of each joint of neck, arm and wrist."""
CAMERA_M, CAMERA_DEG = 0.005, 1.0
"""Largest error of the camera's place and orientation."""
MARKER_M = 0.005
"""Distance of the marker from its nominal place, in a random direction."""
WHEELS_M = 0.008
"""Largest error of the distance between two wheels; half of it, of an omni wheel from the middle."""
LOOSENING_DEG_PER_MIN = 0.03
"""Largest rate at which an arm joint slips on its servo's shaft, always in one direction."""
BEND_RAD = 0.15
"""Angle of a bent forearm: 3 cm at the marker, which is 0.2 m from the elbow."""


@dataclass(frozen=True)
class Wear:
    """The true body, as opposed to the nominal description that services, drivers and firmware use."""

    robot: Robot
    """The description of the true body."""
    slip_radps: Mapping[str, float] = field(default_factory=dict)
    """By joint, how fast it slips on its servo's shaft."""
    bend_s: float | None = None
    """Time at which the forearm is bent; None is never."""

    def slip_rad(self, joint: str, time_s: float) -> float:
        """The angle, rad, by which a joint exceeds its servo's shaft."""
        bent = self.bend_s is not None and time_s >= self.bend_s and joint == self.robot.arm.bend
        return self.slip_radps.get(joint, 0.0) * time_s + (BEND_RAD if bent else 0.0)


def body_of(robot: Robot, kind: BodyKind, seed: int, bend_s: float | None = None) -> Wear:
    """The true body in the run `seed`: as the nominal description, or worn. `bend_s`: when its forearm is bent."""
    if kind == "nominal":
        return Wear(robot, bend_s=bend_s)
    rng = stream(seed, "loosening")
    limit = radians(LOOSENING_DEG_PER_MIN) / 60.0
    loose = robot.arm.joints
    slips = {joint: float(rate) for joint, rate in zip(loose, rng.uniform(-limit, limit, len(loose)), strict=True)}
    return Wear(_worn(robot, stream(seed, "wear")), slips, bend_s)


def _worn(robot: Robot, rng: np.random.Generator) -> Robot:
    data = robot.to_data()
    rows = {row["name"]: row for row in data["link"]}
    arm_links = [robot.link_of(joint) for joint in (*robot.arm.joints, robot.arm.roll)]
    head_links = [robot.link_of(joint) for joint in robot.head_joints]
    for name in arm_links:
        _stretch(rows[name], rng)
    for name in head_links + arm_links:
        rows[name]["offset_deg"] += float(rng.uniform(-ZERO_DEG, ZERO_DEG))
    shift_m = _direction(rng) * rng.uniform(0.0, CAMERA_M)
    turn_rad = _direction(rng) * radians(rng.uniform(0.0, CAMERA_DEG))
    camera = rows[robot.eye.link]
    data["link"] = [row for row in data["link"] if row is not camera]
    for row in _displacement("camera_mount_worn", camera["parent"], shift_m, turn_rad):
        data["link"].append(row)
        camera["parent"] = row["name"]
    data["link"].append(camera)
    if data["marker"] is not None:
        marker = np.array(data["marker"]["position_m"]) + MARKER_M * _direction(rng)
        data["marker"]["position_m"] = tuple(marker.tolist())
    if robot.base.kind == "differential":
        data["base"]["wheel_separation_m"] += float(rng.uniform(-WHEELS_M, WHEELS_M))
    for wheel in data["base"]["wheel"]:
        wheel["distance_m"] += float(rng.uniform(-WHEELS_M, WHEELS_M)) / 2
    return Robot.from_data(data, "worn body")


def _stretch(row: dict[str, Any], rng: np.random.Generator) -> None:
    """Changes the lengths of a link's row that are not 0, whichever form it has."""
    if "xyz_m" in row:
        lengths = [value + float(rng.uniform(-LENGTH_M, LENGTH_M)) if value != 0.0 else 0.0 for value in row["xyz_m"]]
        row["xyz_m"] = tuple(lengths)
        return
    for length in ("d_m", "r_m"):
        if row[length] != 0.0:
            row[length] += float(rng.uniform(-LENGTH_M, LENGTH_M))


def _direction(rng: np.random.Generator) -> FloatArray:
    """A random direction, uniform on the sphere; unit vector, (3,)."""
    vector: FloatArray = rng.standard_normal(3)
    return vector / float(np.linalg.norm(vector))


def _displacement(name: str, parent: str, shift_m: FloatArray, turn_rad: FloatArray) -> Iterator[dict[str, Any]]:
    """Rows of fixed links that shift their children by `shift_m` (3,) and turn them by `turn_rad` (3,) about x, y and
    z.

    A row of the kinematic table moves only along and about its x and z axes. For y, a row turns by 90 degrees about z,
    so that its x is y, and the next row turns back.
    """
    (x, y, z), (rx, ry, rz) = shift_m.tolist(), np.degrees(turn_rad).tolist()
    for number, row in enumerate(
        (
            {"d_m": z, "r_m": x, "alpha_deg": rx},
            {"theta_deg": 90.0 + rz, "r_m": y, "alpha_deg": ry},
            {"theta_deg": -90.0},
        )
    ):
        link = {"name": f"{name}_{number}", "parent": parent, "joint": None, "offset_deg": 0.0}
        yield {**link, "theta_deg": 0.0, "d_m": 0.0, "alpha_deg": 0.0, "r_m": 0.0, **row}
        parent = f"{name}_{number}"
