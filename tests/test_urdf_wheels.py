"""A URDF's wheels become the robot's base, and its only jaw faces a fixed finger."""

from __future__ import annotations

from math import cos, pi, radians, sin
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from spelled import asked
from urdf_rig import desk_arm, rolling_arm, wheel

from apps.cli.main import main
from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from apps.urdf.describing import describe
from apps.urdf.missing import FILE, GUESSED
from cocoro.drive import Twist
from cocoro.kinematics import Tree
from cocoro.robot import Robot
from sim.model import build_model
from sim.random_scene import find_scene
from sim.world import World

AT_DEG = {"port": 60.0, "stern": 180.0, "starboard": 300.0}
MIDDLE_M, FAR_M, RADIUS_M = 0.02, 0.11, 0.05


def three(axis: int = -1) -> str:
    """Wheels about a point ahead of the deck's middle."""
    return "".join(
        wheel(name, MIDDLE_M + FAR_M * cos(radians(deg)), FAR_M * sin(radians(deg)), radians(deg) + pi / 2, axis)
        for name, deg in AT_DEG.items()
    )


def two(turned_rad: float = 0.0) -> str:
    """Wheels on one axle through the deck's middle."""
    return "".join(
        wheel(name, -side * sin(turned_rad), side * cos(turned_rad), turned_rad)
        for name, side in (("port", 0.12), ("starboard", -0.12))
    )


def made(tmp_path: Path, wheels: str) -> Robot:
    return describe(desk_arm(tmp_path, rolling_arm(wheels), mesh=False), "cart").robot


def deck_of(robot: Robot) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return Tree(robot.links, ["deck"]).poses(dict.fromkeys(robot.joints, 0.0))["deck"]


def test_three_wheels_whose_axles_meet_are_an_omni_base(tmp_path: Path) -> None:
    robot = made(tmp_path, three())
    assert robot.base.kind == "omni"
    assert [wheel.name for wheel in robot.base.wheel] == list(AT_DEG)
    for row in robot.base.wheel:
        assert (row.distance_m, row.radius_m) == pytest.approx((FAR_M, RADIUS_M))
        assert row.angle_deg % 360.0 == pytest.approx(AT_DEG[row.name])
        assert row.drive_deg is None, "forwards, each turns the body counter-clockwise"
    assert deck_of(robot)[:3, 3] == pytest.approx([-MIDDLE_M, 0.0, RADIUS_M + 0.03])
    assert not set(AT_DEG) & set(robot.joints)
    assert not [part for part in robot.solid.part if "rim" in part.name]


def test_a_wheel_drives_as_its_axis_says(tmp_path: Path) -> None:
    ahead = made(tmp_path, three()).base.drive.wheels(Twist(0.1, 0.3, -0.1))
    back = made(tmp_path, three(axis=1)).base.drive.wheels(Twist(0.1, 0.3, -0.1))
    assert back == pytest.approx([-speed for speed in ahead])


@pytest.mark.parametrize("turned_rad", [0.0, 0.5, -1.2])
def test_two_wheels_on_one_axle_are_a_differential_base_that_drives_across_it(
    tmp_path: Path, turned_rad: float
) -> None:
    robot = made(tmp_path, two(turned_rad))
    assert robot.base.kind == "differential"
    assert (robot.base.wheel_separation_m, robot.base.wheel_radius_m) == pytest.approx((0.24, RADIUS_M))
    assert deck_of(robot)[:2, 0] == pytest.approx([cos(turned_rad), -sin(turned_rad)])
    assert deck_of(robot)[2, 3] == pytest.approx(RADIUS_M + 0.03)


@pytest.mark.parametrize(
    "wheels",
    [
        wheel("port", 0.0, 0.1, 0.0),
        wheel("port", 0.0, 0.1, 0.0) + wheel("starboard", 0.1, -0.1, 0.0),
        "".join(wheel(f"w{x}{y}", 0.1 * x, 0.1 * y, 0.0) for x in (1, 2) for y in (1, 2)),
        wheel("port", 0.0, 0.1, 0.0) + wheel("starboard", 0.0, -0.1, 0.0, radius_m=0.1),
    ],
    ids=["one", "no axle", "four abreast", "heights"],
)
def test_other_wheels_make_no_base_and_are_listed(tmp_path: Path, wheels: str) -> None:
    result = describe(desk_arm(tmp_path, rolling_arm(wheels), mesh=False), "cart")
    assert result.robot.base.wheel_separation_m == 0.24
    assert any(row.where == "`[base]`" and "in the simulator they are rigid" in row.now for row in result.missing)
    assert "nan" not in build_model(result.robot).urdf


def test_a_wheel_without_a_shape_is_listed(tmp_path: Path) -> None:
    bare = three().replace("<cylinder", "<capsule")
    result = describe(desk_arm(tmp_path, rolling_arm(bare), mesh=False), "cart")
    assert {row.radius_m for row in result.robot.base.wheel} == {0.03}
    assert any(row.section == FILE and "radius of the wheels port, stern" in row.what for row in result.missing)


def test_the_fixed_finger_and_the_gap_are_those_of_the_solids(tmp_path: Path) -> None:
    claw = made(tmp_path, three()).claw
    assert claw.open_sign == {"pinch": 1.0}
    assert (claw.fixed_pad_m, claw.jaw_pad_m) == pytest.approx((0.012, 0.018))


def test_a_jaw_opens_away_from_the_fixed_finger(tmp_path: Path) -> None:
    robot = made(tmp_path, three())
    zero = dict.fromkeys(robot.joints, 0.0)
    frame = robot.chain("pinch").pose(zero)
    tip = np.append((np.linalg.inv(frame) @ robot.chain(robot.arm.tip).pose(zero))[:3, 3], 1.0)
    opened = (robot.chain("pinch").pose(zero | {"pinch": 0.2 * robot.claw.open_sign["pinch"]}) @ tip)[:3]
    assert (opened - (frame @ tip)[:3]) @ frame[:3, 0] > 0.005
    assert frame[:3, 0] == pytest.approx([0.0, -1.0, 0.0], abs=1e-9)


def test_a_finger_about_whose_place_nothing_is_known_is_assumed_and_listed(tmp_path: Path) -> None:
    around = '<geometry><box size="0.2 0.2 0.2"/>'
    result = describe(desk_arm(tmp_path, rolling_arm(three(), around), mesh=False), "cart")
    (row,) = [row for row in result.missing if row.where.startswith("`[claw] fixed_pad_m`")]
    assert row.section == GUESSED
    assert "assumed" in row.now
    assert result.robot.claw.fixed_pad_m == result.robot.claw.jaw_pad_m
    assert "nan" not in build_model(result.robot).urdf


@pytest.fixture
def cart(tmp_path: Path) -> Path:
    urdf = desk_arm(tmp_path, rolling_arm(three()), mesh=False)
    assert main(["new", "robot", "cart", "--urdf", str(urdf), "--into", str(tmp_path)]) == 0
    return tmp_path / "cart" / "cart.toml"


@pytest.mark.sim
def test_a_robot_of_three_wheels_stands_still_and_level(cart: Path) -> None:
    robot = Robot.load(cart)
    assert len(robot.base.wheel) == 3
    with World(robot, find_scene("paper", 0)) as world:
        world.set_latch("released")
        start = world.link_pose("body")
        for _ in range(2 * 240):
            world.step()
        end = world.link_pose("body")
        assert np.linalg.norm(end[:3, 3] - start[:3, 3]) < 0.003
        assert end[2, 2] > 0.9999


@pytest.mark.sim
@pytest.mark.parametrize(("task", "place"), [("park", {}), ("go-there", {"x_m": 0.2, "y_m": 0.1})])
def test_it_parks_and_goes_to_a_place(cart: Path, task: str, place: dict[str, Any]) -> None:
    result = rehearse(
        RehearsalRequest(
            task=asked(task, **place).task, description=str(cart), width=320, height=240, frame_rate_hz=15.0
        )
    )
    assert (result["outcome"], result["reason"]) == ("done", "")
    assert not result["truth"]["collisions"]
