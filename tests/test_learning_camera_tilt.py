"""The tilt of the camera, from targets of known height."""

from __future__ import annotations

import numpy as np
import pytest

from apps.learning.dataset import WheelRow
from apps.learning.lesson import LEAST_TRIALS, camera_tilt
from cocoro.messages import Obstacles
from cocoro.robot import Robot
from cocoro.units import Vec3
from services.planning.config import PlanningConfig
from services.planning.head import CameraTilt
from services.planning.state_estimator import StateEstimator


def seen(robot: Robot, true_m: Vec3, tilt_rad: float) -> Vec3:
    """The nominal model's position, m, of a true one that a camera sees on a neck whose tilt is off by `tilt_rad`."""
    neck = robot.chain("camera")
    angles = {"neck_pan": float(np.arctan2(true_m[1], true_m[0] - 0.032685)), "neck_tilt": -0.4}
    really = neck.pose(angles | {"neck_tilt": -0.4 - tilt_rad})
    x, y, z, _ = (neck.pose(angles) @ np.linalg.inv(really) @ np.array([*true_m, 1.0])).tolist()
    return x, y, z


def row(after_m: Vec3) -> WheelRow:
    return WheelRow(
        stamp_ns=1, trial=2, left_mps=0.1, right_mps=-0.1, left_m=0.1, right_m=-0.1, before_m=(1.5, 0.0),
        after_m=after_m[:2], turned_rad=0.0, height_m=after_m[2],
    )  # fmt: skip


@pytest.mark.parametrize("tilt_rad", [-0.04, 0.0, 0.03])
def test_what_a_tilted_camera_sees_is_put_straight(robot: Robot, tilt_rad: float) -> None:
    camera = CameraTilt(robot, tilt_rad)
    for place in ((1.5, 0.0, 0.06), (0.4, -0.2, 0.3), (0.9, 0.8, 0.0)):
        assert camera.straight(seen(robot, place, tilt_rad)) == pytest.approx(place, abs=1e-6)


def test_the_tilt_is_learned_from_a_can_on_the_floor(robot: Robot) -> None:
    places = [(1.5 + 0.02 * n, 0.1 * n, 0.06) for n in range(LEAST_TRIALS)]
    trials = [row(seen(robot, place, 0.025)) for place in places]
    assert camera_tilt(trials, 0.06, robot) == pytest.approx(0.025, abs=1e-6)


def test_without_the_targets_height_or_with_few_trials_no_tilt_is_learned(robot: Robot) -> None:
    trials = [row((1.5, 0.0, 0.1))] * LEAST_TRIALS
    assert camera_tilt(trials, None, robot) is None
    assert camera_tilt(trials[1:], 0.06, robot) is None


def test_a_camera_that_is_as_in_the_nominal_model_changes_nothing(robot: Robot) -> None:
    assert CameraTilt(robot).straight((1.0, 0.3, 0.2)) == (1.0, 0.3, 0.2)


def test_the_floor_that_a_tilted_camera_lifts_is_no_obstacle(robot: Robot) -> None:
    floor, box = seen(robot, (1.9, 0.2, 0.0), 0.03), seen(robot, (1.9, -0.2, 0.2), 0.03)
    assert floor[2] > 0.05  # higher than what counts as floor so far off
    estimator = StateEstimator(PlanningConfig(), robot)
    obstacles = Obstacles(points_m=(floor, box), lowest_m=(0.04, 0.15), origin_m=(0.06, 0.0))
    assert estimator._standing(obstacles).points_m == (floor, box)
    estimator.camera_tilt = CameraTilt(robot, 0.03)
    standing = estimator._standing(obstacles)
    assert (standing.points_m, standing.lowest_m) == ((box,), (0.15,))
