"""Values in the places of what a URDF does not say, so that the simulator runs: base, camera, gripper, servo line.
The numbers of base and camera are the Calliope's until others are put there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from apps.urdf.hand import PAD_HEIGHT_M, PAD_THICKNESS_M, Hand
from apps.urdf.model import Urdf
from apps.urdf.parts import lowest_m
from apps.urdf.roles import Roles
from apps.urdf.rows import BODY, Rows, rounded
from apps.urdf.wheels import MAX_SPEED_MPS, Rolling, rolling_of
from cocoro.kinematics import Origin
from cocoro.robot import Robot
from sim.body import CASTER_RADIUS_M

LIMITS_DEG, TORQUE_NM, SPEED_RADPS = (-150.0, 150.0), 3.0, 3.0
"""Of a joint for which the URDF has none."""
MOST_NM = 500.0
"""A torque from here on is that of a file that was not filled in, and would throw a small robot about."""
AHEAD_M = 0.08
"""Of the assumed base's middle, the root of a URDF that has no wheels: an arm amid the base hardly reaches past it."""
CHASSIS_DIAMETER_M, CHASSIS_HEIGHT_M, CHASSIS_KG = 0.30, 0.04, 5.0
WHEEL_SEPARATION_M, WHEEL_RADIUS_M = 0.24, 0.03
LOAD_KG = 1.5
"""Battery, electronics and what else a base has on which the URDF's wheels are."""
CAMERA_M, CAMERA_DOWN_DEG = (-0.12, 0.0, 0.45), 28.0
"""Where the camera stands, above the chassis, and how far down it looks, when the URDF has none."""
LINE = "bus"
_TO_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""A camera's frame, x right, y down, z forward, in one with x forward, z up."""


@dataclass(frozen=True)
class Body:
    """The base that the URDF's root stands on."""

    root: Origin
    """The root in the body's frame."""
    camera_m: tuple[float, float, float]
    """Where a camera is, body frame, that the URDF does not have."""

    rolling: Rolling | None
    """None: the wheels are assumed."""

    def base(self, parts_kg: float) -> dict[str, Any]:
        base: dict[str, Any] = Robot.load().to_data()["base"]
        for field in ("kind", "wheel", "wheel_separation_m", "wheel_radius_m"):
            base.pop(field, None)
        common = {"chassis_diameter_m": CHASSIS_DIAMETER_M, "chassis_height_m": CHASSIS_HEIGHT_M}
        if self.rolling is None:
            return base | common | {
                "kind": "differential",
                "wheel_separation_m": WHEEL_SEPARATION_M,
                "wheel_radius_m": WHEEL_RADIUS_M,
                "mass_kg": rounded(parts_kg + CHASSIS_KG, 3),
                "max_wheel_speed_mps": MAX_SPEED_MPS,
            }  # fmt: skip
        common["chassis_diameter_m"] = rounded(2.0 * self.rolling.reach_m, 3)
        mass_kg = rounded(parts_kg + LOAD_KG, 3)
        return base | common | dict(self.rolling.table) | {"mass_kg": mass_kg, "bumper": False}

    def hull(self, roles: Roles, hand: Hand) -> dict[str, Any]:
        return {"finger_radius_m": 0.02, "finger_turn_deg": {jaw: hand.finger_deg[jaw] for jaw in roles.jaws}}


def body_of(urdf: Urdf, roles: Roles) -> Body:
    """The robot stands on its wheels, if it has any with solids, else on top of a chassis."""
    rolling = rolling_of(urdf, roles.wheels)
    top_m = CASTER_RADIUS_M + CHASSIS_HEIGHT_M
    if rolling is not None:
        root = rolling.root
    else:
        still = [link for link in urdf.links if not any(joint.name in roles.joints for joint in urdf.moving(link))]
        lowest = lowest_m(urdf, still)
        height_m = 0.0 if roles.wheels and lowest is not None else top_m
        ahead_m = 0.0 if roles.wheels else AHEAD_M
        root = Origin((ahead_m, 0.0, rounded(height_m - (lowest or 0.0), 6)), (0.0, 0.0, 0.0))
    return Body(root, (CAMERA_M[0], CAMERA_M[1], CAMERA_M[2] + top_m), rolling)


def camera_of(roles: Roles, rows: Rows, body: Body) -> dict[str, Any]:
    """The camera's table, and the row of its frame, which is that of the URDF's link, its lens along x or, of an
    optical frame, along z. A camera that the URDF does not have is fixed on the body."""
    pose = np.eye(4)
    if roles.camera is None:
        down, (x, y, z) = np.radians(CAMERA_DOWN_DEG), body.camera_m
        pose[:3, 3] = x, y, z
        pose[:3, :3] = Origin((0.0, 0.0, 0.0), (0.0, float(down), 0.0)).transform()[:3, :3]
    if roles.camera is None or "optical" not in roles.camera.lower():
        pose[:3, :3] = pose[:3, :3] @ _TO_OPTICAL
    parent = BODY if roles.camera is None else rows.link[roles.camera]
    table: dict[str, Any] = Robot.load().to_data()["camera"][0] | {
        "name": "camera",
        "link": rows.add(rows.free("camera", "view"), parent, Origin.of(pose)),
    }
    for field in ("colour_lens", "depth_lens", "mount_min_m", "mount_max_m"):
        table.pop(field, None)
    return table


def claw_of(hand: Hand) -> dict[str, Any]:
    claw = {
        "pad_length_m": rounded(hand.pad_length_m, 4),
        "open_sign": hand.open_sign,
        "level_roll_deg": 0.0,
        "pad_gap_m": rounded(hand.pad_gap_m, 4),
        "pad_height_m": PAD_HEIGHT_M,
        "pad_thickness_m": PAD_THICKNESS_M,
    }
    return claw if hand.fixed_pad_m is None else claw | {"fixed_pad_m": rounded(hand.fixed_pad_m, 4)}


def torque_nm(effort_nm: float | None) -> float:
    """A servo's torque by what the URDF says."""
    return TORQUE_NM if effort_nm is None or effort_nm >= MOST_NM else effort_nm


def lines() -> dict[str, Any]:
    """The only servo line."""
    return {LINE: {"protocol": "dynamixel", "baud": 1_000_000, "rate_hz": 50.0, "command_timeout_s": 0.15}}
