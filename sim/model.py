"""Writes the robot as a URDF, from the robot description and the table of its parts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import asin, atan2, pi
from pathlib import Path

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.description import Part
from cocoro.kinematics import Link, turn_z
from cocoro.robot import Robot
from sim.body import CHASSIS, Extra, SimBody, body_of_parts, inertia_of, pose_of
from sim.render.interface import Visual

HUB_SLIDES_M = 1.0
"""More than an omni wheel's hub ever slides in a step."""


@dataclass(frozen=True)
class RobotModel:
    """The URDF that the simulator loads, and how its links carry those of the description."""

    urdf: str
    links: tuple[str, ...]
    """The root first. PyBullet numbers them differently: get the numbers from it by name."""
    body: SimBody
    carried: dict[str, tuple[str, FloatArray]]
    """For each link of the description: the URDF link that carries it, and its pose (4, 4) in that link."""
    touching: frozenset[frozenset[str]]
    """Pairs of links that touch at a joint or turn inside each other. Every other pair may collide."""

    def collision_pairs(self) -> Iterator[tuple[str, str]]:
        """Pairs of the robot's own links that can collide."""
        fixed = {CHASSIS, *(extra.name for extra in self.body.extras)}
        for i, one in enumerate(self.links):
            for other in self.links[i + 1 :]:
                if frozenset((one, other)) not in self.touching and not {one, other} <= fixed:
                    yield one, other

    def visuals(self) -> list[tuple[str, FloatArray, Visual]]:
        """List for each part the URDF link that carries it, its pose (4, 4) in that link, and its visual."""
        found = []
        for link, parts in self.body.parts.items():
            carrier, offset = self.carried.get(link, (link, np.eye(4)))
            for part in parts:
                visual = Visual(part.name, part.shape, part.size_m, part.rgb)
                found.append((carrier, offset @ pose_of(part), visual))
        return found


def build_model(robot: Robot) -> RobotModel:
    """Build the robot's URDF. Its forward kinematics equal those of the description.

    Links without a joint are merged into the link that carries them: fewer links, the same poses.
    """
    body = body_of_parts(robot)
    carried = {"body": (CHASSIS, np.eye(4))}
    joints: list[str] = []
    links = [CHASSIS]
    touching = {frozenset(pair) for pair in robot.solid.touching}
    for extra in body.extras:
        joints.append(_extra_joint(extra))
        links.append(extra.name)
    for name, link in _parents_first(robot.links):
        carrier, offset = carried[link.parent]
        place = offset @ link.fixed()
        if link.joint is None:
            carried[name] = (carrier, place @ turn_z(link.offset_rad))
        else:
            carried[name] = (name, np.eye(4))
            joints.append(_servo_joint(robot, link, carrier, place @ turn_z(link.offset_rad)))
            links.append(name)
            touching.add(frozenset((carrier, name)))
    solid: dict[str, list[tuple[FloatArray, Part]]] = {name: [] for name in links}
    for name, parts in body.parts.items():
        carrier, offset = carried.get(name, (name, np.eye(4)))
        solid[carrier] += [(offset, part) for part in parts]
    text = "\n".join(
        ['<?xml version="1.0"?>', f'<robot name="{robot.name}">']
        + [_link_xml(name, solid[name]) for name in links]
        + joints
        + ["</robot>", ""]
    )
    return RobotModel(text, tuple(links), body, carried, frozenset(touching))


def write_urdf(model: RobotModel, folder: Path) -> Path:
    """Write the file into `folder`, which must belong to this process alone. Returns its path."""
    path = folder / "robot.urdf"
    path.write_text(model.urdf)
    return path


def _parents_first(links: dict[str, Link]) -> Iterator[tuple[str, Link]]:
    known, waiting = {"body"}, dict(links)
    while waiting:
        ready = [name for name, link in waiting.items() if link.parent in known]
        if not ready:
            raise ValueError(f"links {sorted(waiting)} hang on no link that leads to the body")
        for name in ready:
            known.add(name)
            yield name, waiting.pop(name)


# Each element has its own line: PyBullet sometimes misreads a URDF that is one long line.


def _link_xml(name: str, placed: list[tuple[FloatArray, Part]]) -> str:
    lines = [f'  <link name="{name}">', *_inertial_xml(placed)]
    for offset, part in placed:
        if part.solid:
            lines += ["    <collision>", f"      {_origin_xml(offset @ pose_of(part))}", "      <geometry>"]
            lines += [f"        {_geometry_xml(part)}", "      </geometry>", "    </collision>"]
    return "\n".join([*lines, "  </link>"])


def _inertial_xml(placed: list[tuple[FloatArray, Part]]) -> list[str]:
    """Without a mass, which only what is fixed on the body may be, the centre is that of the frame."""
    mass = sum(part.mass_kg for _, part in placed)
    centres = [(offset @ pose_of(part))[:3, 3] for offset, part in placed]
    centre = sum((part.mass_kg * c for c, (_, part) in zip(centres, placed, strict=True)), np.zeros(3))
    centre = centre / mass if mass else centre
    inertia = np.zeros((3, 3))
    for at, (offset, part) in zip(centres, placed, strict=True):
        turn, arm = offset[:3, :3], at - centre
        inertia += turn @ inertia_of(part) @ turn.T
        inertia += part.mass_kg * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    place = np.eye(4)
    place[:3, 3] = centre
    entries = (("ixx", 0, 0), ("ixy", 0, 1), ("ixz", 0, 2), ("iyy", 1, 1), ("iyz", 1, 2), ("izz", 2, 2))
    values = " ".join(f'{label}="{inertia[row, column]:.12g}"' for label, row, column in entries)
    return [
        "    <inertial>",
        f"      {_origin_xml(place)}",
        f'      <mass value="{mass:.12g}"/>',
        f"      <inertia {values}/>",
        "    </inertial>",
    ]


def _geometry_xml(part: Part) -> str:
    if part.shape == "box":
        return f'<box size="{_numbers(*part.size_m)}"/>'
    if part.shape == "cylinder":
        return f'<cylinder radius="{part.size_m[0]:.12g}" length="{part.size_m[1]:.12g}"/>'
    return f'<sphere radius="{part.size_m[0]:.12g}"/>'


def _extra_joint(extra: Extra) -> str:
    place = turn_z(extra.turn_rad) if extra.turn_rad else np.eye(4)
    place[:3, 3] = extra.position_m
    if extra.kind == "hub":
        limit = [f'    <limit lower="-{HUB_SLIDES_M:g}" upper="{HUB_SLIDES_M:g}" effort="0" velocity="0"/>']
        return _joint_xml(extra.name, extra.parent, place, "prismatic", axis="0 1 0", more=limit)
    kind = "continuous" if extra.kind == "wheel" else "fixed"
    return _joint_xml(extra.name, extra.parent, place, kind, axis="0 1 0")


def _servo_joint(robot: Robot, link: Link, parent: str, place: FloatArray) -> str:
    assert link.joint is not None
    joint = robot.joints[link.joint]
    low, high = joint.limits_rad
    limit = f'lower="{low:.12g}" upper="{high:.12g}" effort="{joint.torque_nm:.12g}"'
    return _joint_xml(
        link.name,
        parent,
        place,
        "revolute",
        axis="0 0 1",
        more=[f'    <limit {limit} velocity="{joint.max_speed_radps:.12g}"/>'],
    )


def _joint_xml(child: str, parent: str, place: FloatArray, kind: str, axis: str, more: list[str] | None = None) -> str:
    return "\n".join(
        [
            f'  <joint name="{child}" type="{kind}">',
            f'    <parent link="{parent}"/>',
            f'    <child link="{child}"/>',
            f"    {_origin_xml(place)}",
            *([f'    <axis xyz="{axis}"/>'] if kind != "fixed" else []),
            *(more or []),
            "  </joint>",
        ]
    )


def _origin_xml(place: FloatArray) -> str:
    turn = place[:3, :3]
    pitch = asin(max(-1.0, min(1.0, -turn[2, 0])))
    if abs(turn[2, 0]) < 1.0 - 1e-12:
        roll, yaw = atan2(turn[2, 1], turn[2, 2]), atan2(turn[1, 0], turn[0, 0])
    else:  # gimbal lock: roll and yaw turn about the same axis, so yaw is set to 0
        roll, yaw = atan2(-turn[0, 1] * (1 if pitch < 0 else -1), turn[1, 1]), 0.0
        pitch = pi / 2 if pitch > 0 else -pi / 2
    return f'<origin xyz="{_numbers(*place[:3, 3])}" rpy="{_numbers(roll, pitch, yaw)}"/>'


def _numbers(*values: float) -> str:
    return " ".join(f"{float(value):.12g}" for value in values)
