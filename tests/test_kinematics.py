"""Rigid-body kinematics against the maker's drawing and against itself."""

from __future__ import annotations

from math import cos, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cocoro.arrays import FloatArray
from cocoro.kinematics import Chain, DenavitHartenberg, Link, Origin, turn_z
from cocoro.robot import Robot

ROBOT = Robot.load()
ZERO = dict.fromkeys(ROBOT.joints, 0.0)
TIPS = ("camera", "arm_base", "shoulder", "wrist_roll", "gripper", "pad_centre", "claw_left", "claw_right")
angle = st.floats(-2.6, 2.6)
angles_of_all = st.fixed_dictionaries(dict.fromkeys(ROBOT.joints, angle))


def turn_x(angle_rad: float) -> FloatArray:
    c, s = cos(angle_rad), sin(angle_rad)
    return np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1]], dtype=float)


def shift(x: float, z: float) -> FloatArray:
    total = np.eye(4)
    total[0, 3], total[2, 3] = x, z
    return total


@given(theta=angle, d=st.floats(-1, 1), alpha=angle, r=st.floats(-1, 1))
def test_a_row_turns_about_z_goes_along_z_goes_along_x_and_turns_about_x(
    theta: float, d: float, alpha: float, r: float
) -> None:
    link = Link("link", "body", None, DenavitHartenberg(theta, d, alpha, r))
    assert link.fixed() == pytest.approx(turn_z(theta) @ shift(0, d) @ shift(r, 0) @ turn_x(alpha), abs=1e-12)


@given(xyz=st.tuples(*[st.floats(-1, 1)] * 3), rpy=st.tuples(angle, angle, angle))
def test_a_row_as_in_a_urdf_goes_to_its_origin_and_rolls_pitches_and_yaws_about_fixed_axes(
    xyz: tuple[float, float, float], rpy: tuple[float, float, float]
) -> None:
    roll, pitch, yaw = rpy
    about_y = np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], dtype=float)  # x to y, y to z
    expected = turn_z(yaw) @ about_y @ turn_x(pitch) @ about_y.T @ turn_x(roll)
    expected[:3, 3] = xyz
    assert Link("link", "body", None, Origin(xyz, rpy)).fixed() == pytest.approx(expected, abs=1e-12)


@given(xyz=st.tuples(*[st.floats(-1, 1)] * 3), rpy=st.tuples(angle, st.sampled_from([0.3, pi / 2, -pi / 2]), angle))
def test_the_origin_of_a_transform_is_the_same_place(
    xyz: tuple[float, float, float], rpy: tuple[float, float, float]
) -> None:
    place = Origin(xyz, rpy).transform()
    assert Origin.of(place).transform() == pytest.approx(place, abs=1e-8)


@pytest.mark.parametrize(
    ("tip", "place_mm"),
    [
        ("arm_base", (97.9, -100.0, 134.3)),
        ("shoulder", (199.8, -91.1, 134.3)),
        ("gripper", (641.9, -53.8, 111.8)),
        ("camera", (60.3, 0.0, 733.1)),
    ],
)
def test_at_the_zero_pose_everything_is_where_the_drawing_has_it(tip: str, place_mm: tuple[float, ...]) -> None:
    assert 1000 * ROBOT.chain(tip).position(ZERO) == pytest.approx(place_mm, abs=0.06)


def test_at_the_zero_pose_the_camera_looks_ahead_and_level() -> None:
    pose = ROBOT.chain("camera").pose(ZERO)
    assert pose[:3, 2] == pytest.approx([1, 0, 0], abs=1e-9)  # its z
    assert pose[:3, 0] == pytest.approx([0, -1, 0], abs=1e-9)  # its x: to the right
    assert pose[:3, 1] == pytest.approx([0, 0, -1], abs=1e-9)  # its y: down


def test_turning_the_neck_left_and_up_turns_the_view_left_and_up() -> None:
    assert ROBOT.chain("camera").pose(ZERO | {"neck_pan": 0.5})[:3, 2] == pytest.approx(
        [cos(0.5), sin(0.5), 0], abs=1e-9
    )
    assert ROBOT.chain("camera").pose(ZERO | {"neck_tilt": 0.5})[:3, 2] == pytest.approx(
        [cos(0.5), 0, sin(0.5)], abs=1e-9
    )


@pytest.mark.parametrize("tip", TIPS)
@settings(max_examples=20)
@given(angles=angles_of_all)
def test_a_pose_is_a_rigid_motion(tip: str, angles: dict[str, float]) -> None:
    pose = ROBOT.chain(tip).pose(angles)
    assert pose[:3, :3] @ pose[:3, :3].T == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    assert pose[3] == pytest.approx([0, 0, 0, 1])
    assert ROBOT.chain(tip).position(angles) == pytest.approx(pose[:3, 3])


@pytest.mark.parametrize("tip", TIPS)
@settings(max_examples=20)
@given(angles=angles_of_all)
def test_the_jacobian_is_what_small_turns_of_the_joints_do(tip: str, angles: dict[str, float]) -> None:
    chain, step = ROBOT.chain(tip), 1e-6
    jacobian = chain.jacobian(angles)
    for column, joint in enumerate(chain.joints):
        more = chain.pose(angles | {joint: angles[joint] + step})
        less = chain.pose(angles | {joint: angles[joint] - step})
        assert jacobian[:3, column] == pytest.approx((more - less)[:3, 3] / (2 * step), abs=1e-6)
        spin = (more[:3, :3] - less[:3, :3]) / (2 * step) @ chain.pose(angles)[:3, :3].T
        assert jacobian[3:, column] == pytest.approx([spin[2, 1], spin[0, 2], spin[1, 0]], abs=1e-6)


def test_a_joint_that_does_not_move_the_tip_has_a_column_of_zeros() -> None:
    jacobian = ROBOT.chain("shoulder").jacobian(ZERO, ("elbow", "arm_base", "neck_pan"))
    assert jacobian.shape == (6, 3)
    assert not jacobian[:, [0, 2]].any()
    assert jacobian[:, 1].any()


def test_a_joint_of_the_tips_own_row_turns_the_tip_and_does_not_move_it() -> None:
    assert ROBOT.chain("shoulder").jacobian(ZERO, ("shoulder",))[:3] == pytest.approx(np.zeros((3, 1)))


def test_the_hands_roll_turns_about_the_hand() -> None:
    chain = ROBOT.chain("pad_centre")
    assert chain.position(ZERO | {"wrist_roll": pi / 2}) == pytest.approx(chain.position(ZERO), abs=1e-9)


@pytest.mark.parametrize("links", [{}, {"tip": Link("tip", "elsewhere", None, Origin((0, 0, 0), (0, 0, 0)))}])
def test_a_link_that_is_not_described_is_named(links: dict[str, Link]) -> None:
    with pytest.raises(KeyError, match="tip" if not links else "elsewhere"):
        Chain(links, "tip")
