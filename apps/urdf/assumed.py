"""Values in the places of what a URDF does not say, so that the simulator runs: base, camera and head, gripper, servo
lines. The numbers of base and camera are the Calliope's until others are put there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from apps.urdf.hand import PAD_HEIGHT_M, PAD_THICKNESS_M, Hand
from apps.urdf.model import Urdf
from apps.urdf.parts import lowest_m
from apps.urdf.roles import Roles
from apps.urdf.rows import BODY, Rows, inverse_of, rounded
from cocoro.arrays import FloatArray
from cocoro.kinematics import Origin
from cocoro.robot import Robot
from sim.body import CASTER_RADIUS_M

LIMITS_DEG, TORQUE_NM, SPEED_RADPS = (-150.0, 150.0), 3.0, 3.0
"""Of a joint for which the URDF has none."""
CHASSIS_DIAMETER_M, CHASSIS_HEIGHT_M, CHASSIS_KG = 0.30, 0.04, 5.0
WHEEL_SEPARATION_M, WHEEL_RADIUS_M = 0.24, 0.03
MAX_WHEEL_SPEED_MPS = 0.3
CAMERA_M = (-0.12, 0.0, 0.45)
"""Where the camera stands, above the chassis, when the URDF has none."""
_HEAD = "head_pan", "head_tilt"
_TILT = Origin((0.0, 0.0, 0.0), (np.pi / 2, 0.0, 0.0))
"""In the pan's frame, whose axes are the body's: positive angles look up."""
_MOUNT_M = 0.02
_HOUSING_M = 0.08
_TO_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""A camera's frame, x right, y down, z forward, in one with x forward, z up."""


@dataclass(frozen=True)
class Body:
    """The base that the URDF's root stands on."""

    root: Origin
    """The root in the body's frame."""
    top_m: float
    camera_m: tuple[float, float, float]
    """Where the camera is at angle 0, body frame."""

    def base(self, parts_kg: float) -> dict[str, Any]:
        base: dict[str, Any] = Robot.load().to_data()["base"]
        return base | {
            "wheel_separation_m": WHEEL_SEPARATION_M,
            "wheel_radius_m": WHEEL_RADIUS_M,
            "chassis_diameter_m": CHASSIS_DIAMETER_M,
            "chassis_height_m": CHASSIS_HEIGHT_M,
            "mass_kg": rounded(parts_kg + CHASSIS_KG, 3),
            "max_wheel_speed_mps": MAX_WHEEL_SPEED_MPS,
        }

    def hull(self, roles: Roles, hand: Hand) -> dict[str, Any]:
        low, high = (np.array(self.camera_m) + side * _HOUSING_M for side in (-1.0, 1.0))
        return {
            "kinect_min_m": [rounded(value, 4) for value in low],
            "kinect_max_m": [rounded(value, 4) for value in high],
            "finger_radius_m": 0.02,
            "finger_turn_deg": {jaw: hand.finger_deg[jaw] for jaw in roles.jaws},
        }


def body_of(urdf: Urdf, roles: Roles) -> Body:
    """The robot stands on its wheels, if it has any with solids, else on top of a chassis."""
    still = [link for link in urdf.links if not any(joint.name in roles.joints for joint in urdf.moving(link))]
    lowest = lowest_m(urdf, still)
    top_m = CASTER_RADIUS_M + CHASSIS_HEIGHT_M
    height_m = 0.0 if roles.wheels and lowest is not None else top_m
    root = Origin((0.0, 0.0, rounded(height_m - (lowest or 0.0), 6)), (0.0, 0.0, 0.0))
    camera_m = CAMERA_M[0], CAMERA_M[1], CAMERA_M[2] + top_m
    if roles.camera is not None:
        x, y, z = (root.transform() @ urdf.poses()[roles.camera])[:3, 3].tolist()
        camera_m = x, y, z
    return Body(root, top_m, camera_m)


def head_of(
    urdf: Urdf, roles: Roles, rows: Rows, body: Body, joints: list[dict[str, Any]]
) -> tuple[tuple[str, str], list[dict[str, Any]]]:
    """The joints of the head and the parts of its links: those above the URDF's camera, if they are two, else two that
    are added where the camera is, with their rows."""
    if len(roles.head) == 2:
        return (roles.head[0], roles.head[1]), []
    pan, tilt = (rows.free(name, "joint") for name in _HEAD)
    upright = np.eye(4)
    upright[:3, 3] = body.camera_m
    if roles.camera is None:
        rows.add(pan, BODY, Origin.of(upright), pan)
    else:
        rows.add(pan, rows.link[roles.camera], Origin.of(inverse_of(_camera_pose(urdf, roles, body)) @ upright), pan)
    rows.add(tilt, pan, _TILT, tilt)
    for name in (pan, tilt):
        joints.append({"name": name, "network": "arm", "id": len(joints) + 1, "limits_deg": [-90.0, 90.0],
                       "torque_nm": TORQUE_NM, "max_speed_radps": SPEED_RADPS})  # fmt: skip
    parts = [
        {"name": f"{name}_mass", "link": name, "shape": "box", "size_m": [0.03, 0.03, 0.03], "mass_kg": 0.05,
         "solid": False} for name in (pan, tilt)
    ]  # fmt: skip
    return (pan, tilt), parts


def camera_of(urdf: Urdf, roles: Roles, rows: Rows, body: Body, head: tuple[str, str]) -> dict[str, Any]:
    """The camera's table, and the row of its frame, which is that of the URDF's link at angle 0, its lens along x or,
    of an optical frame, along z."""
    turn = np.eye(4)
    if roles.camera is None or "optical" not in roles.camera.lower():
        turn[:3, :3] = _TO_OPTICAL
    if len(roles.head) == 2 and roles.camera is not None:
        parent = rows.link[roles.camera]
    else:
        parent = head[1]
        if roles.camera is not None:
            turn[:3, :3] = _camera_pose(urdf, roles, body)[:3, :3] @ turn[:3, :3]
        turn = inverse_of(_TILT.transform()) @ turn
    link = rows.add(rows.free("camera", "view"), parent, Origin.of(turn))
    x, y = CAMERA_M[0] - 2 * _MOUNT_M, CAMERA_M[1]
    low = [x - _MOUNT_M, y - _MOUNT_M, body.top_m]
    high = [x, y + _MOUNT_M, body.top_m + (CAMERA_M[2] if roles.camera is None else _MOUNT_M)]
    table = Robot.load().to_data()["kinect"] | {"link": link, "colour_lens": None, "depth_lens": None}
    table["mount_min_m"], table["mount_max_m"] = ([rounded(value, 4) for value in corner] for corner in (low, high))
    return {name: value for name, value in table.items() if value is not None}


def _camera_pose(urdf: Urdf, roles: Roles, body: Body) -> FloatArray:
    """The frame (4, 4) of the URDF's camera in the body's, m, with all joints at 0."""
    assert roles.camera is not None
    return np.asarray(body.root.transform() @ urdf.poses()[roles.camera])


def claw_of(urdf: Urdf, roles: Roles, hand: Hand) -> dict[str, Any]:
    """Jaws open towards the farther end of their limits."""
    signs = {}
    for jaw in roles.jaws:
        low, high = urdf.joints[jaw].limits_rad or (-1.0, 1.0)
        signs[jaw] = -1.0 if -low > high else 1.0
    return {
        "pad_length_m": rounded(hand.pad_length_m, 4),
        "open_sign": signs,
        "level_roll_deg": 0.0,
        "pad_gap_m": rounded(hand.pad_gap_m, 4),
        "pad_height_m": PAD_HEIGHT_M,
        "pad_thickness_m": PAD_THICKNESS_M,
    }


def stand_ins(roles: Roles, rows: Rows) -> dict[str, Any]:
    """The marker and the servo lines."""
    line = {"protocol": "dynamixel", "baud": 1_000_000, "rate_hz": 50.0, "command_timeout_s": 0.15}
    return {
        "marker": {"link": rows.joint[roles.roll], "radius_m": 0.0125, "position_m": [0.0, 0.04, 0.0]},
        "network": {"arm": dict(line), "hand": dict(line)},
    }
