"""URDFs of a made-up arm on a desk and of one on wheels, and kinematics computed from a file by other means than the
project's."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from cocoro.arrays import FloatArray

LIMIT = '<limit lower="-2" upper="1.8" effort="3" velocity="4"/>'
MASS = (
    '<inertial><origin xyz="0.01 0.02 0.03" rpy="0 0 0.3"/><mass value="0.4"/>'
    '<inertia ixx="4e-4" ixy="0" ixz="0" iyy="5e-4" iyz="0" izz="6e-4"/></inertial>'
)
SMALL = '<inertial><mass value="0.1"/><inertia ixx="1e-4" ixy="0" ixz="0" iyy="1e-4" iyz="0" izz="1e-4"/></inertial>'
DESK_ARM = f"""<?xml version="1.0"?>
<robot name="desk arm">
  <link name="foot">
    <inertial><mass value="1.5"/><inertia ixx="1e-3" ixy="0" ixz="0" iyy="1e-3" iyz="0" izz="1e-3"/></inertial>
    <collision><origin xyz="0 0 0.03"/><geometry><box size="0.1 0.08 0.06"/></geometry></collision>
  </link>
  <link name="turret">{MASS}
    <collision><origin rpy="0 1.5707963 0"/><geometry><cylinder radius="0.02" length="0.05"/></geometry></collision>
  </link>
  <link name="upper">{MASS}
    <collision><origin xyz="0 0 0.1" rpy="0.4 0.2 0"/><geometry><box size="0.03 0.03 0.2"/></geometry></collision>
  </link>
  <link name="lower">{MASS}<collision><geometry><mesh filename="lower.stl" scale="0.001 0.001 0.001"/></geometry>
    </collision></link>
  <link name="wrist">{MASS}<collision><geometry><sphere radius="0.02"/></geometry></collision></link>
  <link name="palm">{MASS}<collision><origin xyz="0 -0.03 0"/><geometry><box size="0.06 0.04 0.03"/></geometry>
    </collision></link>
  <link name="grasp_point"/>
  <link name="finger_left">{MASS}</link>
  <link name="finger_right"/>
  <link name="wrist_camera"/>
  <joint name="swivel" type="revolute"><parent link="foot"/><child link="turret"/><origin xyz="0.01 0 0.07"/>
    <axis xyz="0 0 1"/>{LIMIT}</joint>
  <joint name="lift" type="revolute"><parent link="turret"/><child link="upper"/>
    <origin xyz="0.02 0.01 0.03" rpy="0.1 -0.2 0.05"/><axis xyz="0 1 0"/>{LIMIT}</joint>
  <joint name="bend" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0 0 0.2"/>
    <axis xyz="0 1 0"/>{LIMIT}</joint>
  <joint name="tilt" type="revolute"><parent link="lower"/><child link="wrist"/>
    <origin xyz="0.02 0 0.18" rpy="0 0 1.2"/><axis xyz="1 -2 0.5"/>{LIMIT}</joint>
  <joint name="spin" type="revolute"><parent link="wrist"/><child link="palm"/><origin xyz="0 -0.05 0"/>
    <axis xyz="0 -1 0"/>{LIMIT}</joint>
  <joint name="to_grasp" type="fixed"><parent link="palm"/><child link="grasp_point"/>
    <origin xyz="0 -0.12 0" rpy="1.5707963267948966 0 0"/></joint>
  <joint name="left" type="revolute"><parent link="palm"/><child link="finger_left"/><origin xyz="0.03 -0.05 0"/>
    <axis xyz="0 0 -1"/><limit lower="-1.5" upper="0.2"/></joint>
  <joint name="right" type="revolute"><parent link="palm"/><child link="finger_right"/><origin xyz="-0.03 -0.05 0.01"/>
    <axis xyz="0 0 -1"/><limit lower="-0.2" upper="1.5" effort="2" velocity="3"/></joint>
  <joint name="to_camera" type="fixed"><parent link="wrist"/><child link="wrist_camera"/>
    <origin xyz="0 0 0.06" rpy="0 0 -1.57"/></joint>
</robot>
"""

_WHEEL = """<link name="{name}_rim"><inertial><mass value="0.2"/>
    <inertia ixx="1e-4" ixy="0" ixz="0" iyy="1e-4" iyz="0" izz="1e-4"/></inertial><collision><geometry>
    <cylinder radius="{radius}" length="0.02"/></geometry></collision></link>
  <joint name="{name}" type="continuous"><parent link="deck"/><child link="{name}_rim"/>
    <origin xyz="{x} {y} -0.03" rpy="1.5707963267948966 0 {yaw}"/><axis xyz="0 0 {axis}"/></joint>"""


def wheel(name: str, x_m: float, y_m: float, yaw_rad: float, axis: int = -1, radius_m: float = 0.05) -> str:
    """A wheel of a link `deck`, whose axle lies along the deck's y turned by the yaw. By an axis of -1 it drives along
    the deck's x turned by the yaw."""
    return _WHEEL.format(name=name, x=x_m, y=y_m, yaw=yaw_rad, axis=axis, radius=radius_m)


def rolling_arm(wheels: str, jaw_box: str = '<origin xyz="0 0.04 0"/><geometry><box size="0.006 0.08 0.02"/>') -> str:
    """A URDF of a small arm with one jaw on a round deck, 80 mm above the middle of the wheels' axles. The fixed finger
    is 12 mm left of the roll's axis, the jaw's inner face 18 mm right of it."""
    return f"""<robot name="cart">
  <link name="deck"><inertial><mass value="2"/><inertia ixx="1e-2" ixy="0" ixz="0" iyy="1e-2" iyz="0" izz="1e-2"/>
    </inertial><collision><origin xyz="0.01 0 0.04"/><geometry><cylinder radius="0.1" length="0.02"/></geometry>
    </collision></link>
  <link name="turret">{SMALL}</link><link name="upper">{SMALL}</link><link name="lower">{SMALL}</link>
  <link name="wrist">{SMALL}</link>
  <link name="palm">{SMALL}<collision><origin xyz="0 0.015 0.05"/><geometry><box size="0.02 0.006 0.1"/></geometry>
    </collision></link>
  <link name="grasp_point"/>
  <link name="thumb">{SMALL}<collision>{jaw_box}</geometry></collision></link>
  {wheels}
  <joint name="swivel" type="revolute"><parent link="deck"/><child link="turret"/><origin xyz="0.05 0 0.07"/>
    <axis xyz="0 0 1"/>{LIMIT}</joint>
  <joint name="lift" type="revolute"><parent link="turret"/><child link="upper"/><origin xyz="0 0 0.05"/>
    <axis xyz="0 -1 0"/>{LIMIT}</joint>
  <joint name="bend" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0 0 0.12"/>
    <axis xyz="0 -1 0"/>{LIMIT}</joint>
  <joint name="tilt" type="revolute"><parent link="lower"/><child link="wrist"/><origin xyz="0.12 0 0"/>
    <axis xyz="0 -1 0"/>{LIMIT}</joint>
  <joint name="spin" type="revolute"><parent link="wrist"/><child link="palm"/>
    <origin xyz="0.05 0 0" rpy="0 1.5707963267948966 0"/><axis xyz="0 0 1"/>{LIMIT}</joint>
  <joint name="to_grasp" type="fixed"><parent link="palm"/><child link="grasp_point"/><origin xyz="0 0 0.09"/></joint>
  <joint name="pinch" type="revolute"><parent link="palm"/><child link="thumb"/>
    <origin xyz="0 -0.021 0.02" rpy="1.5707963267948966 0 1.5707963267948966"/><axis xyz="0 0 1"/>
    <limit lower="-0.2" upper="1.7" effort="2" velocity="3"/></joint>
</robot>
"""


def desk_arm(folder: Path, text: str = DESK_ARM, *, mesh: bool = True) -> Path:
    """The file, and the mesh of its link `lower`: one triangle, 40 x 50 x 170 mm, in millimetres."""
    if mesh:
        corners = np.array([[-20, -25, 0], [20, 25, 0], [0, 0, 170]], dtype="<f4")
        body = struct.pack("<I", 1) + np.zeros(3, "<f4").tobytes() + corners.tobytes() + b"\0\0"
        (folder / "lower.stl").write_bytes(b"solid, though binary".ljust(80) + body)
    path = folder / "desk.urdf"
    path.write_text(text, encoding="utf-8")
    return path


def poses(path: Path, angles_rad: Mapping[str, float]) -> dict[str, FloatArray]:
    """Each link's frame (4, 4) in the root's, m."""
    robot = ElementTree.parse(path).getroot()
    joints = {joint.find("child").get("link"): joint for joint in robot.findall("joint")}  # type: ignore[union-attr]

    def pose(link: str) -> FloatArray:
        joint = joints.get(link)
        if joint is None:
            return np.eye(4)
        origin, axis = joint.find("origin"), joint.find("axis")
        here = np.eye(4)
        if origin is not None:
            here[:3, 3] = numbers(origin.get("xyz"))
            here[:3, :3] = Rotation.from_euler("xyz", numbers(origin.get("rpy"))).as_matrix()
        if axis is not None and joint.get("type") != "fixed":
            along = numbers(axis.get("xyz"))
            turn = angles_rad[joint.get("name", "")] * along / np.linalg.norm(along)
            here[:3, :3] = here[:3, :3] @ Rotation.from_rotvec(turn).as_matrix()
        return np.asarray(pose(joint.find("parent").get("link")) @ here)  # type: ignore[union-attr, arg-type]

    return {link.get("name", ""): pose(link.get("name", "")) for link in robot.findall("link")}


def numbers(text: str | None) -> FloatArray:
    return np.array([float(word) for word in (text or "0 0 0").split()])
