"""Touching what hangs within reach, going up to a set distance, and learning on the job."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pytest
from learning_arm import sightings

from apps.learning.study import BEST, fit
from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from cocoro.arrays import FloatArray
from cocoro.clock import NS
from cocoro.learning.handmap import NominalModel
from cocoro.learning.model import Training, arm_model, empty, encode
from cocoro.robot import Robot
from services.executive.tasks import GoToTask, TouchTask
from services.planning.behaviours.base import Actuators
from services.planning.config import PlanningConfig
from services.planning.learned import Learned
from services.planning.reachability import ReachMesh
from services.planning.state_estimator import PostureSighting
from services.planning.teaching import LUMP, Teacher

ARM = Robot.load().arm.joints
LEVEL_ROLL_RAD = Robot.load().claw.level_roll_rad
QUICK: dict[str, Any] = {"width": 160, "height": 120, "frame_rate_hz": 15.0}


@pytest.mark.sim
def test_what_hangs_before_the_robot_is_touched_in_turn() -> None:
    request = RehearsalRequest(
        task=TouchTask(label="red_can"), scene="targets", trace=True, **QUICK,
        then=tuple(TouchTask(label=label) for label in ("green_can", "blue_can", "yellow_ball", "red_can")),
    )  # fmt: skip
    result = rehearse(request)
    assert [step["outcome"] for step in result["tasks"]] == ["done"] * 5
    for step in result["tasks"]:
        assert step["hand_to_target"]["gap_m"] < 0.02
        assert step["longest_stall_s"] < 1.0
        assert step["truth"]["collisions"] == ()
    trace = result["trace"]
    assert len(trace["time_s"]) == len(trace["hand_m"])
    assert {"search", "touch"} <= set(trace["phase"])


@pytest.mark.sim
def test_the_robot_stops_at_the_distance_that_was_asked() -> None:
    request = RehearsalRequest(task=GoToTask(label="blue_can", distance_m=0.35), **QUICK)
    result = rehearse(request)
    assert result["outcome"] == "done"
    assert result["tasks"][0]["target_edge_m"] == pytest.approx(0.35, abs=0.015)
    assert result["truth"]["knocked_over"] == ()


def sighting(number: int, angles: np.ndarray, place: np.ndarray, roll_rad: float = LEVEL_ROLL_RAD) -> PostureSighting:
    posture = dict(zip(ARM, angles.tolist(), strict=True), wrist_roll=roll_rad)
    x, y, z = place.tolist()
    return PostureSighting("hand_marker", number * NS // 10, (x, y, z), 300, posture)


def test_sightings_at_work_teach_a_copy_of_the_map_and_the_mesh(robot: Robot) -> None:
    seen = sightings(robot, draws=60)
    learned = fit(BEST, NominalModel(robot), seen)
    mesh = ReachMesh(seen.places_m)
    had = len(mesh.places_m)
    teacher = Teacher(learned, 0.003, mesh)
    before = learned.network.weights.copy()
    moved = seen.places_m + np.array([0.01, 0.0, 0.0])
    for number, (angles, place) in enumerate(zip(seen.angles_rad, moved, strict=True)):
        teacher.step([sighting(number, angles, place)])
    gap = teacher.map.predict(seen.angles_rad) - moved
    assert float(np.linalg.norm(gap, axis=1).mean()) < 0.006
    assert np.array_equal(learned.network.weights, before)
    assert len(seen) >= LUMP
    assert len(mesh.places_m) == had  # not while it works: that takes long
    teacher.rest()
    assert len(mesh.places_m) > had
    assert f"taught by {len(seen)} sightings" in teacher.text


def test_a_turned_wrist_and_frames_in_quick_succession_teach_nothing(robot: Robot) -> None:
    seen = sightings(robot, draws=60)
    teacher = Teacher(fit(BEST, NominalModel(robot), seen), 0.003, ReachMesh(seen.places_m))
    angles, place = seen.angles_rad[0], seen.places_m[0]
    teacher.step([sighting(1, angles, place, roll_rad=0.0)])
    assert "taught by 0 " in teacher.text
    teacher.step([sighting(2, angles, place), sighting(2, angles, place)])
    assert "taught by 1 " in teacher.text


def test_only_a_planner_that_is_told_to_goes_on_learning_and_it_says_so(robot: Robot) -> None:
    seen = sightings(robot, draws=60)
    drawing = NominalModel(robot)
    training = Training(data="d", samples=len(seen), method=BEST.name, scores={"held_out_rms_m": 0.003})
    arm = arm_model(fit(BEST, drawing, seen), LEVEL_ROLL_RAD, seen.places_m, training)
    base = empty(robot)
    content = encode(type(base)(robot=base.robot, drawing=base.drawing, arm=arm))
    for adapt in (False, True):
        learned = Learned(robot, PlanningConfig(adapt=adapt))
        learned.take(content)
        learned.step([sighting(1, seen.angles_rad[0], seen.places_m[0])], NS // 5)
        assert ("taught by 1 sightings at work" in learned.text) is adapt
        assert learned.mesh is not None


class LongerHand:
    """The drawing's hand, but further out along its own axis."""

    def __init__(self, robot: Robot, more_m: float) -> None:
        self._drawn = robot.chain("pad_centre")
        self._more_m = more_m

    def pose(self, angles: Mapping[str, float]) -> FloatArray:
        pose = self._drawn.pose(angles)
        pose[:3, 3] += self._more_m * pose[:3, 2]
        return pose

    def position(self, angles: Mapping[str, float]) -> FloatArray:
        return np.asarray(self.pose(angles)[:3, 3])

    def jacobian(self, angles: Mapping[str, float], joints: Iterable[str]) -> FloatArray:
        return self._drawn.jacobian(angles, joints)


def test_a_hand_that_is_learned_to_be_further_out_waits_where_the_arm_still_folds(robot: Robot) -> None:
    actuators = Actuators(robot, PlanningConfig())
    drawn_m = actuators.reachability.retreat_m
    assert drawn_m == PlanningConfig().arm.retreat_radius_m
    actuators.reacher.use(LongerHand(robot, 0.03))
    actuators.reachability.use(None, None)
    assert drawn_m + 0.005 < actuators.reachability.retreat_m < drawn_m + 0.04
    assert actuators.reachability.grasp((0.58, -0.1, 0.06)).behind.radius_m == actuators.reachability.retreat_m
