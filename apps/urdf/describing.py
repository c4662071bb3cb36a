"""A robot description from a URDF: what the file has, what its order and names tell, and values in the places of all
else, each of them listed as missing."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, degrees
from pathlib import Path
from typing import Any

import numpy as np

from apps.urdf.assumed import LIMITS_DEG, LINE, SPEED_RADPS, body_of, camera_of, claw_of, lines, torque_nm
from apps.urdf.hand import hand_of
from apps.urdf.missing import Missing, missing_of
from apps.urdf.model import Urdf
from apps.urdf.parts import Parts, carriers
from apps.urdf.posture import postures_of, straight_deg
from apps.urdf.reading import read
from apps.urdf.roles import Roles, roles_of
from apps.urdf.rows import Rows, rounded
from apps.urdf.things import can_m
from apps.urdf.values import UrdfError
from cocoro.arrays import FloatArray
from cocoro.errors import ConfigError
from cocoro.kinematics import Origin
from cocoro.robot import Robot

_TUBE_RADIUS_M = 0.03
_LEAST_TUBE_M = 0.02
_ASIDE_RAD = 1.3
"""The planner takes an arm that is turned so far for folded."""


@dataclass(frozen=True)
class Made:
    """A description as data, which `Robot.from_data` takes, and what is missing in it."""

    data: dict[str, Any]
    missing: tuple[Missing, ...]
    robot: Robot


def describe(path: Path, name: str, *, postures: bool = False) -> Made:
    """Make the description of the robot `name` from the URDF in a file; with `postures` chosen by the arm's kinematics,
    which takes a second, and the table of its reach. Raises ConfigError as `reading.read` does, and for a robot without
    an arm."""
    urdf = read(path)
    try:
        return _described(urdf, name, postures)
    except UrdfError as error:
        raise ConfigError(f"{path}: {error}") from error


def _described(urdf: Urdf, name: str, postures: bool) -> Made:
    roles = roles_of(urdf)
    hand = hand_of(urdf, roles)
    body = body_of(urdf, roles)
    rows = Rows(urdf, body.root, roles.joints, hand.jaws)
    rolling = () if body.rolling is None else body.rolling.joints
    parts = Parts(urdf, rows, body.root, roles.wheels, rolling)
    tip = rows.link[hand.tip] if hand.tip else rows.add(
        rows.free("tip", "link"), rows.link[urdf.joints[roles.roll].child], Origin.of(hand.place)
    )  # fmt: skip
    joints = [_joint(urdf, joint, roles) for joint in roles.joints]
    data: dict[str, Any] = {"name": name, "base": body.base(parts.mass_kg)}
    data["camera"] = [camera_of(roles, rows, body)]
    if roles.head:
        data["head"] = {"pan": roles.head[0], "tilt": roles.head[1]}
    data["arm"] = {"joints": list(roles.arm), "bend": roles.bend, "roll": roles.roll, "tip": tip}
    data["link"] = rows.data
    data["network"] = lines()
    data["joint"] = joints
    data["claw"] = claw_of(hand)
    data["hull"] = {"tube": _tubes(roles, rows, tip, data["link"]), **body.hull(roles, hand)}
    data["pose"] = _poses(roles, joints)
    data["solid"] = _solid(urdf, roles, rows, parts)
    try:
        robot = Robot.from_data({"head": None} | data, "the description made of it")
        if straight_deg(robot) is not None:
            data["arm"]["straight_deg"] = straight_deg(robot)
            robot = Robot.from_data({"head": None} | data, "the description made of it")
        if postures and (chosen := postures_of(robot, 2.0 * can_m(robot)[0])) is not None:
            data |= {"reach": chosen.reach, "pose": chosen.poses}
            robot = Robot.from_data({"head": None} | data, "the description made of it")
    except ConfigError as error:
        raise UrdfError(str(error)) from error
    return Made(data, missing_of(urdf, roles, hand, parts, body, data), robot)


def _joint(urdf: Urdf, name: str, roles: Roles) -> dict[str, Any]:
    joint = urdf.joints[name]
    low, high = LIMITS_DEG if joint.limits_rad is None else map(degrees, joint.limits_rad)
    return {
        "name": name,
        "network": LINE,
        "id": roles.joints.index(name) + 1,
        "limits_deg": [rounded(low, 4), rounded(high, 4)],
        "torque_nm": rounded(torque_nm(joint.effort_nm)),
        "max_speed_radps": rounded(joint.velocity_radps or SPEED_RADPS),
    }


def _tubes(roles: Roles, rows: Rows, tip: str, links: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Balls along the arm from joint to joint."""
    stops = [rows.joint[name] for name in (*roles.arm, roles.roll)] + [tip]
    tubes = []
    start = stops[0]
    for end in stops[1:]:
        length_m = float(np.linalg.norm(_between(links, start, end)))
        if length_m > _LEAST_TUBE_M:
            balls = max(2, ceil(length_m / _TUBE_RADIUS_M) + 1)
            tubes.append({"name": start, "start": start, "end": end, "radius_m": _TUBE_RADIUS_M, "balls": balls})
            start = end
    return tubes or [{"name": "hand", "start": stops[0], "end": tip, "radius_m": _TUBE_RADIUS_M, "balls": 2}]


def _between(links: list[dict[str, Any]], start: str, end: str) -> FloatArray:
    """From one link's origin to another's behind it, (3,), m, with all joints at 0."""
    by_name = {row["name"]: row for row in links}
    total, name = np.eye(4), end
    while name != start:
        row = by_name[name]
        roll, pitch, yaw = np.radians(row["rpy_deg"]).tolist()
        total = Origin(tuple(row["xyz_m"]), (roll, pitch, yaw)).transform() @ total
        name = row["parent"]
    return np.asarray(total[:3, 3])


def _poses(roles: Roles, joints: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """All postures at angle 0, or in the middle of limits that leave it out; parked, the arm is turned to its side."""
    zero = {}
    for row in joints:
        low, high = row["limits_deg"]
        zero[row["name"]] = 0.0 if low <= 0.0 <= high else rounded(np.radians((low + high) / 2), 4)
    arm = {name: zero[name] for name in roles.arm}
    aside = rounded(min(_ASIDE_RAD, np.radians(joints[roles.joints.index(roles.arm[0])]["limits_deg"][1])), 4)
    return {
        "park": arm | {roles.arm[0]: aside},
        "unfolded": {name: arm[name] for name in roles.arm[1:]},
        "upright": dict(arm),
    }


def _solid(urdf: Urdf, roles: Roles, rows: Rows, parts: Parts) -> dict[str, Any]:
    carrier = carriers(urdf, rows)
    above = {rows.joint[name]: carrier[urdf.joints[name].parent] for name in roles.joints}
    touching = parts.touching(above)
    wrist = above[rows.joint[roles.roll]]
    touching += [pair for jaw in roles.jaws if (pair := (wrist, rows.joint[jaw])) not in touching and wrist in above]
    return {"mount_mass_kg": 0.0, "touching": [list(pair) for pair in touching], "part": parts.data}
