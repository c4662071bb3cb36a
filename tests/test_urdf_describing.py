"""A description from a URDF: its links are where the URDF has them, and what was read, guessed and assumed is told."""

from __future__ import annotations

import tomllib
from math import degrees, pi
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from urdf_rig import DESK_ARM, LIMIT, MASS, desk_arm, poses

from apps.urdf.assumed import CAMERA_DOWN_DEG
from apps.urdf.describing import Made, describe
from apps.urdf.missing import FILE, GUESSED, NEVER
from apps.urdf.writing import description_text, page_text
from cocoro.arrays import FloatArray
from cocoro.errors import ConfigError
from cocoro.kinematics import Tree
from cocoro.robot import Robot
from sim.model import build_model

JOINTS = ("swivel", "lift", "bend", "tilt", "spin", "left", "right")
angles = st.fixed_dictionaries(dict.fromkeys(JOINTS, st.floats(-pi, pi)))


@pytest.fixture
def made(tmp_path: Path) -> Made:
    return describe(desk_arm(tmp_path), "desk")


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(angles_rad=angles)
def test_every_link_is_where_the_urdf_has_it_at_all_angles(
    made: Made, tmp_path: Path, angles_rad: dict[str, float]
) -> None:
    robot = made.robot
    found = Tree(robot.links, robot.links).poses(dict.fromkeys(robot.joints, 0.0) | angles_rad)
    root = found["foot"]
    for link, pose in poses(tmp_path / "desk.urdf", angles_rad).items():
        assert found[link] == pytest.approx(root @ pose, abs=1e-8), link


def test_joints_have_the_urdfs_limits_torque_and_speed_or_are_listed(made: Made) -> None:
    joints = made.robot.joints
    assert [joint.id for joint in joints.values()] == list(range(1, len(joints) + 1))
    assert joints["tilt"].limits_deg == pytest.approx((degrees(-2.0), degrees(1.8)), abs=1e-4)
    assert (joints["tilt"].torque_nm, joints["tilt"].max_speed_radps) == (3.0, 4.0)
    lacking = {row.what for row in made.missing if row.section == FILE}
    assert {"torque of left", "speed of left", "mass of right"} <= lacking


def test_what_the_joints_are_for_follows_from_order_and_names(made: Made) -> None:
    arm = made.robot.arm
    assert (arm.joints, arm.bend, arm.roll, arm.tip) == (
        ("swivel", "lift", "bend", "tilt"),
        "bend",
        "spin",
        "grasp_point",
    )
    assert made.robot.claw.open_sign == {"left": -1.0, "right": 1.0}
    guessed = {row.where for row in made.missing if row.section == GUESSED}
    assert {"`[arm]`", "`[arm] tip`", "`[claw] open_sign`"} <= guessed
    assert any(row.what == "the camera's place" and "fixed on the body" in row.now for row in made.missing)


def test_nothing_is_added_that_the_urdf_does_not_have(made: Made) -> None:
    robot = made.robot
    assert (robot.head, robot.marker, robot.eye.mount, robot.hull.kinect) == (None, None, None, None)
    assert set(robot.joints) == set(JOINTS)
    assert {joint.network for joint in robot.joints.values()} == {"bus"}


def looks(robot: Robot, **angles_rad: float) -> FloatArray:
    return robot.camera_chain.pose(dict.fromkeys(robot.joints, 0.0) | angles_rad)


def test_a_camera_on_the_arm_is_not_the_robots(made: Made) -> None:
    robot = made.robot
    assert robot.camera_chain.joints == ()
    down = np.radians(CAMERA_DOWN_DEG)
    assert looks(robot)[:3, 2] == pytest.approx([np.cos(down), 0, -np.sin(down)], abs=1e-9)
    assert looks(robot)[:3, 0] == pytest.approx([0, -1, 0], abs=1e-9)
    assert any("wrist_camera is not used: swivel, lift, bend, tilt turn it" in row.what for row in made.missing)


@pytest.mark.parametrize(("name", "lens"), [("front_camera", 0), ("camera_optical", 2)])
def test_a_camera_on_the_body_looks_along_x_of_its_link_or_along_z_of_an_optical_frame(
    tmp_path: Path, name: str, lens: int
) -> None:
    on_arm = '<parent link="wrist"/><child link="wrist_camera"/>'
    text = DESK_ARM.replace(on_arm, f'<parent link="foot"/><child link="{name}"/>').replace("wrist_camera", name)
    robot = describe(desk_arm(tmp_path, text), "desk").robot
    zero = dict.fromkeys(robot.joints, 0.0)
    link = Tree(robot.links, [name]).poses(zero)[name]
    assert looks(robot)[:3, 2] == pytest.approx(link[:3, lens], abs=1e-9)
    assert looks(robot)[:3, 3] == pytest.approx(link[:3, 3], abs=1e-9)


def test_two_joints_above_a_camera_are_the_head(tmp_path: Path) -> None:
    neck = f"""<link name="neck">{MASS}</link><link name="skull">{MASS}</link><link name="camera"/>
      <joint name="shake" type="revolute"><parent link="foot"/><child link="neck"/><axis xyz="0 0 1"/>{LIMIT}</joint>
      <joint name="nod" type="revolute"><parent link="neck"/><child link="skull"/><axis xyz="0 -1 0"/>{LIMIT}</joint>
      <joint name="to_eye" type="fixed"><parent link="skull"/><child link="camera"/></joint></robot>"""
    made = describe(desk_arm(tmp_path, DESK_ARM.replace("</robot>", neck)), "desk")
    robot = made.robot
    assert robot.head is not None
    assert (robot.head.pan, robot.head.tilt) == ("shake", "nod")
    assert robot.camera_chain.joints == ("shake", "nod")
    assert "`[head]`" not in {row.where for row in made.missing}


def test_masses_their_centres_and_moments_are_the_urdfs(made: Made) -> None:
    parts = {part.name: part for part in made.robot.solid.part}
    mass = parts["upper_mass"]
    x, y, z = mass.size_m
    moments = [mass.mass_kg / 12 * sum(sides) for sides in ((y * y, z * z), (x * x, z * z), (x * x, y * y))]
    turned = 4e-4 * np.cos(0.3) ** 2 + 5e-4 * np.sin(0.3) ** 2
    assert moments == pytest.approx([turned, 9e-4 - turned, 6e-4], rel=1e-3)
    assert (mass.mass_kg, mass.position_m, mass.solid) == (0.4, (0.01, 0.02, 0.03), False)
    assert parts["foot_part"].mass_kg == 1.5


def test_shapes_lie_as_in_the_urdf(made: Made) -> None:
    parts = {part.name: part for part in made.robot.solid.part}
    assert (parts["turret_part"].axis, parts["turret_part"].size_m) == ("x", (0.02, 0.05))
    assert parts["palm_part"].size_m == (0.06, 0.04, 0.03)
    aslant = made.robot.links[parts["upper_part"].link]
    assert (aslant.parent, aslant.joint) == ("upper", None)
    assert aslant.fixed()[:3, 3] == pytest.approx([0, 0, 0.1])
    assert parts["lower_part"].size_m == pytest.approx((0.04, 0.05, 0.17))


def test_the_robot_stands_on_its_chassis_and_the_simulator_has_a_mass_for_all_that_moves(made: Made) -> None:
    foot = next(part for part in made.robot.solid.part if part.name == "foot_part")
    base = made.robot.base
    assert foot.position_m[2] - foot.size_m[2] / 2 == pytest.approx(0.010 + base.chassis_height_m)
    assert "nan" not in build_model(made.robot).urdf


def test_the_written_description_is_read_as_it_was_made(made: Made, tmp_path: Path) -> None:
    file = tmp_path / "desk.toml"
    file.write_text(description_text(made.data, "desk.urdf"), encoding="utf-8")
    assert Robot.load(file).to_data() == made.robot.to_data()
    assert tomllib.loads(file.read_text())["link"] == made.data["link"]


def test_the_page_has_a_line_for_all_that_no_urdf_says(made: Made) -> None:
    page = page_text("desk", "desk.urdf", made.missing)
    assert page.index(NEVER) < page.index(GUESSED) < page.index(FILE)
    for word in ("[base]", "IDs", "direction", "centre_count", "[[camera]]", "[pose.*]", "command counts"):
        assert word in page
    rows = [line for line in page.splitlines() if line.startswith("| ") and not line.startswith(("| what |", "| ---"))]
    assert len(rows) == len(made.missing)
    assert all(row.count(" | ") == 3 for row in rows)


def test_names_that_a_link_and_a_joint_share_and_odd_names_make_a_description(tmp_path: Path) -> None:
    text = DESK_ARM.replace('"upper"', '"lift"').replace('"lower"', '"body"').replace('"left"', '"left jaw „1“"')
    robot = describe(desk_arm(tmp_path, text), "desk").robot
    zero = dict.fromkeys(robot.joints, 0.0)
    found = Tree(robot.links, robot.links).poses(zero)
    expected = poses(tmp_path / "desk.urdf", zero)
    assert found["lift_link"] == pytest.approx(found["foot"] @ expected["lift"], abs=1e-8)
    assert found["body_link"] == pytest.approx(found["foot"] @ expected["body"], abs=1e-8)
    assert "left jaw „1“" in robot.joints


def test_wheels_are_no_joints_and_an_arms_endless_joint_is_one(tmp_path: Path) -> None:
    wheel = (
        '<link name="rim"/><joint name="roller" type="continuous"><parent link="foot"/><child link="rim"/>'
        '<origin xyz="0 0.1 0"/><axis xyz="0 1 0"/></joint></robot>'
    )
    text = DESK_ARM.replace("</robot>", wheel).replace('name="spin" type="revolute"', 'name="spin" type="continuous"')
    made = describe(desk_arm(tmp_path, text), "desk")
    assert "roller" not in made.robot.joints
    assert any("roller" in row.now for row in made.missing)
    assert made.robot.joints["spin"].limits_deg == (-150.0, 150.0)
    assert any(row.what == "limits of spin" for row in made.missing)


def test_a_hand_without_a_tip_gets_one_before_its_jaws(tmp_path: Path) -> None:
    robot = describe(desk_arm(tmp_path, DESK_ARM.replace("grasp_point", "badge")), "desk").robot
    assert robot.arm.tip == "tip"
    zero = dict.fromkeys(robot.joints, 0.0)
    places = Tree(robot.links, robot.links).poses(zero)
    in_palm = np.linalg.inv(places["palm"]) @ places["tip"]
    assert in_palm[:3, 3] == pytest.approx([0, -0.10, 0])
    assert in_palm[:3, 2] == pytest.approx([0, -1, 0])


def test_a_robot_without_an_arm_is_refused(tmp_path: Path) -> None:
    short = f"""<robot name="r"><link name="a"/><link name="b">{MASS}</link><link name="c"/>
        <joint name="pan" type="revolute"><parent link="a"/><child link="b"/>{LIMIT}</joint>
        <joint name="nod" type="revolute"><parent link="b"/><child link="c"/>{LIMIT}</joint></robot>"""
    with pytest.raises(ConfigError, match=r"desk\.urdf: has no arm: 3 joints .* the longest chain has pan, nod"):
        describe(desk_arm(tmp_path, short), "desk")
    with pytest.raises(ConfigError, match="the longest chain has none"):
        describe(desk_arm(tmp_path, '<robot name="r"><link name="a"/></robot>'), "desk")


def test_a_robot_whose_hand_cannot_close_is_refused(tmp_path: Path) -> None:
    text = DESK_ARM.replace('name="left" type="revolute"', 'name="left" type="fixed"')
    text = text.replace('name="right" type="revolute"', 'name="right" type="fixed"')
    with pytest.raises(ConfigError, match=r"desk\.urdf: has no hand that closes: no joint turns behind spin"):
        describe(desk_arm(tmp_path, text), "desk")
