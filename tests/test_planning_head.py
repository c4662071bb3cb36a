"""The head: it brings what it looks at into the middle of the image, and searches everywhere."""

from __future__ import annotations

from math import cos, sin

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from cocoro.frames import Pose2
from cocoro.robot import Robot
from services.planning.config import HeadConfig
from services.planning.gaze import Neck
from services.planning.head import neck_sweep

ROBOT = Robot.load()
CONFIG = HeadConfig()
GAZE = Neck(ROBOT, CONFIG)
PAN, TILT = ROBOT.head_joints
CAMERA = ROBOT.chain("camera")


def off_centre_px(point_m: tuple[float, float, float], pan: float, tilt: float) -> float:
    """Distance, pixels, between the middle of the image and a point of the body frame; infinity behind the camera."""
    pose = CAMERA.pose({PAN: pan, TILT: tilt})
    x, y, z = pose[:3, :3].T @ (np.array(point_m) - pose[:3, 3])
    return float(np.hypot(ROBOT.camera.fx * x / z, ROBOT.camera.fy * y / z)) if z > 0 else float("inf")


def place(distance_m: float, bearing_rad: float, height_m: float) -> tuple[float, float, float]:
    return distance_m * cos(bearing_rad), distance_m * sin(bearing_rad), height_m


@given(
    distance_m=st.floats(0.5, 4.0),
    bearing_rad=st.floats(-2.5, 2.5),
    height_m=st.floats(0.0, 1.0),
    pan=st.floats(-2.6, 2.6),
    tilt=st.floats(-1.0, 0.3),
)
def test_what_it_looks_at_comes_to_the_middle_from_wherever_it_looked(
    distance_m: float, bearing_rad: float, height_m: float, pan: float, tilt: float
) -> None:
    point = place(distance_m, bearing_rad, height_m)
    goal = GAZE.at_one(point, {PAN: pan, TILT: tilt})
    assume(CONFIG.tilt_range_rad[0] + 0.01 < goal[1] < CONFIG.tilt_range_rad[1] - 0.01)
    for _ in range(2):  # it is asked anew at every step, from where it has got to
        goal = GAZE.at_one(point, {PAN: goal[0], TILT: goal[1]})
    assert off_centre_px(point, *goal) < 5.0


@given(
    point=st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(0, 2)),
    pan=st.floats(-2.6, 2.6),
    tilt=st.floats(-2.6, 2.6),
)
def test_it_never_looks_further_than_the_neck_turns(point: tuple[float, float, float], pan: float, tilt: float) -> None:
    goal_pan, goal_tilt = GAZE.at_one(point, {PAN: pan, TILT: tilt})
    low, high = ROBOT.joints[PAN].limits_rad
    assert low <= goal_pan <= high
    assert CONFIG.tilt_range_rad[0] <= goal_tilt <= CONFIG.tilt_range_rad[1]


def swept(pan: float) -> list[tuple[float, float]]:
    """The aims of a sweep, in order."""
    sweep = neck_sweep(CONFIG, pan)
    aims: list[tuple[float, float]] = []
    for _ in range(100):
        if sweep.done:
            return aims
        aims.append(sweep.aim)
        sweep.go_on()
    raise AssertionError("a sweep has an end")


@pytest.mark.parametrize("start_pan", [-2.6, -0.4, 0.0, 0.4, 2.6])
def test_the_pictures_of_a_sweep_show_the_floor_in_every_direction_from_near_to_far(start_pan: float) -> None:
    half_wide, half_high = ROBOT.eye.horizontal_fov_rad / 2, ROBOT.eye.vertical_fov_rad / 2
    aims = swept(start_pan)
    for bearing in np.linspace(-2.6 - half_wide, 2.6 + half_wide, 60):
        tilts = [tilt for pan, tilt in aims if abs(bearing - pan) <= half_wide + 1e-9]
        for below in np.arctan2(CAMERA.position({PAN: 0.0, TILT: 0.0})[2], np.linspace(0.25, 2.6, 20)):
            assert min(abs(-below - tilt) for tilt in tilts) < half_high


def test_a_sweep_looks_ahead_first_and_then_to_both_sides() -> None:
    (first, ahead, other), near = [pan for pan, _ in swept(-0.4)][:3], CONFIG.sweep_step_rad
    assert (first, -other) == (0.0, ahead)
    assert -near <= ahead < 0.0


def test_a_sweep_counts_its_own_progress() -> None:
    sweep = neck_sweep(CONFIG, 0.0)
    assert (sweep.share, sweep.done) == (0.0, False)
    shares = []
    while not sweep.done:
        sweep.go_on()
        shares.append(sweep.share)
    assert shares == sorted(shares)
    assert sweep.share == 1.0


@given(
    near_m=st.floats(0.4, 0.8),
    far_m=st.floats(0.9, 2.0),
    bearing_rad=st.floats(-2.0, 2.0),
    apart_rad=st.floats(-0.4, 0.4),
)
def test_one_picture_shows_two_places_that_are_near_enough_to_each_other(
    near_m: float, far_m: float, bearing_rad: float, apart_rad: float
) -> None:
    far, near = place(far_m, bearing_rad, 0.06), place(near_m, bearing_rad + apart_rad, 0.0)
    both = GAZE.at(far, [near], {PAN: 0.0, TILT: 0.0}, Pose2())
    alone = GAZE.at_one(far, {PAN: 0.0, TILT: 0.0})
    assert both == alone or all(in_picture(point, *both) for point in (far, near))


def in_picture(point_m: tuple[float, float, float], pan: float, tilt: float) -> bool:
    pose = CAMERA.pose({PAN: pan, TILT: tilt})
    x, y, z = pose[:3, :3].T @ (np.array(point_m) - pose[:3, 3])
    camera = ROBOT.camera
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    return bool(z > 0 and 0 <= u < camera.width and 0 <= v < camera.height)
