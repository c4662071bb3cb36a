"""The head: it brings what it looks at into the middle of the image, and searches everywhere."""

from __future__ import annotations

from math import cos, sin

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from cocoro.robot import Robot
from services.planning.config import HeadConfig
from services.planning.head import PAN, TILT, Gaze, Sweep

ROBOT = Robot.load()
CONFIG = HeadConfig()
GAZE = Gaze(ROBOT, CONFIG)
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
    goal = GAZE.at(point, {PAN: pan, TILT: tilt})
    assume(CONFIG.tilt_range_rad[0] + 0.01 < goal[1] < CONFIG.tilt_range_rad[1] - 0.01)
    for _ in range(2):  # it is asked anew at every step, from where it has got to
        goal = GAZE.at(point, {PAN: goal[0], TILT: goal[1]})
    assert off_centre_px(point, *goal) < 5.0


@given(
    point=st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(0, 2)),
    pan=st.floats(-2.6, 2.6),
    tilt=st.floats(-2.6, 2.6),
)
def test_it_never_looks_further_than_the_neck_turns(point: tuple[float, float, float], pan: float, tilt: float) -> None:
    goal_pan, goal_tilt = GAZE.at(point, {PAN: pan, TILT: tilt})
    low, high = ROBOT.joints[PAN].limits_rad
    assert low <= goal_pan <= high
    assert CONFIG.tilt_range_rad[0] <= goal_tilt <= CONFIG.tilt_range_rad[1]


def swept(pan: float) -> list[tuple[float, float]]:
    """The directions of a head that goes 2 degrees a step during a sweep."""
    sweep, tilt, looked = Sweep(CONFIG, pan), 0.0, [(pan, 0.0)]
    for _ in range(2000):
        goal_pan, goal_tilt = sweep.next(pan, tilt)
        if sweep.done:
            return looked
        pan += min(max(goal_pan - pan, -0.035), 0.035)
        tilt += min(max(goal_tilt - tilt, -0.035), 0.035)
        looked.append((pan, tilt))
    raise AssertionError("a sweep has an end")


@pytest.mark.parametrize("start_pan", [-2.6, -0.4, 0.0, 0.4, 2.6])
def test_a_sweep_sees_every_bearing_at_every_tilt_and_ends(start_pan: float) -> None:
    looked = swept(start_pan)
    half_view = ROBOT.kinect.horizontal_fov_rad / 2
    for tilt in CONFIG.sweep_tilts_rad:
        pans = [pan for pan, at in looked if abs(at - tilt) < 0.1]
        for bearing in np.linspace(-2.6 - half_view, 2.6 + half_view, 40):
            assert min(abs(bearing - pan) for pan in pans) <= half_view + 0.1


def test_a_sweep_counts_its_own_progress() -> None:
    sweep = Sweep(CONFIG, 0.0)
    assert (sweep.share, sweep.done) == (0.0, False)
    pan, tilt, shares = 0.0, 0.0, []
    while not sweep.done:
        pan, tilt = sweep.next(pan, tilt)
        shares.append(sweep.share)
    assert shares == sorted(shares)
    assert sweep.share == 1.0
