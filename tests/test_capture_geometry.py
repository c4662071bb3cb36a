"""The geometry that viewers show: links, points of depth images, quaternions."""

from __future__ import annotations

from math import pi
from pathlib import Path

import numpy as np
import pytest
from capture_rig import ROBOT

from apps.captures.export.geometry import Posture, about_z, conjugate, points, quaternion, rotated
from apps.captures.export.story import catalogue_of, robot_of
from cocoro.capture.reader import Capture
from cocoro.kinematics import turn_z
from cocoro.messages import Frame, ServoState

GOLDEN = Path(__file__).parent / "golden" / "fetch.mcap"


@pytest.mark.parametrize("yaw_rad", [0.0, 0.3, pi / 2, 3.0, -2.0])
def test_quaternions_turn_as_their_matrices_do(yaw_rad: float) -> None:
    yaw = turn_z(yaw_rad)[:3, :3]
    tilt = np.array([[1.0, 0, 0], [0, 0.6, -0.8], [0, 0.8, 0.6]])
    for turn in (yaw, yaw @ tilt, tilt @ yaw):
        q = quaternion(turn)
        assert rotated(q, (1.0, 2.0, 3.0)) == pytest.approx(tuple(turn @ (1.0, 2.0, 3.0)))
        assert rotated(conjugate(q), rotated(q, (1.0, 2.0, 3.0))) == pytest.approx((1.0, 2.0, 3.0))
    assert rotated(about_z(yaw_rad), (1.0, 0.0, 0.0)) == pytest.approx((np.cos(yaw_rad), np.sin(yaw_rad), 0.0))


def test_points_stand_where_the_depth_says() -> None:
    depth = np.full((12, 16), 2047, dtype="<u2")
    depth[6, 8] = ROBOT.depth_code(np.array([1.5]))[0]
    colour = np.full((12, 16, 3), 7, dtype=np.uint8)
    frame = Frame(width=16, height=12, colour=memoryview(colour.tobytes()), depth=memoryview(depth.tobytes()))
    places, colours = points(frame, ROBOT, 1)
    ray = ROBOT.camera.scaled(16, 12).ray(8, 6) * 1.5 + np.array(ROBOT.eye.depth_offset_m)
    assert places == pytest.approx(ray.reshape(1, 3), abs=0.01)
    assert colours.tolist() == [[7, 7, 7]]


def test_the_links_are_known_once_every_joint_is() -> None:
    posture = Posture(ROBOT)
    assert posture.links() == {}
    joints = tuple(ROBOT.joints)
    zero = (0.0,) * len(joints)
    posture.bend(ServoState(joints=joints, position_rad=zero, speed_radps=zero, load=zero))
    links = posture.links()
    assert links["camera"][:3, 3] == pytest.approx((0.0603, 0.0, 0.7331), abs=1e-3)
    assert len(posture.bones(links)) == len(links) == len(ROBOT.links)


def test_robot_and_objects_are_those_that_the_capture_has() -> None:
    with Capture.open(GOLDEN) as capture:
        assert "red_can" in catalogue_of(capture)
        assert robot_of(capture).eye == ROBOT.eye
