"""Perception without depth: where objects are, which floor is free, and how sure the planner is of it."""

from __future__ import annotations

from math import cos, hypot, pi, sin
from pathlib import Path

import cv2
import numpy as np
import pytest
from perception_scenes import seen as seen_with_depth
from test_lekiwi import fetched

from cocoro.arrays import FloatArray, ImageArray
from cocoro.core import Sample
from cocoro.frames import Pose2
from cocoro.messages import Detection, Detections, Frame, Obstacles, ServoState
from cocoro.objects import Catalogue
from cocoro.robot import Robot
from cocoro.topics import ARM_STATE, FRAME
from services.perception.config import PerceptionConfig
from services.perception.core import PerceptionCore
from services.perception.own_body import own_picture
from services.planning.config import MemoryConfig, PlanningConfig
from services.planning.core import PlanningCore
from services.planning.memory import TargetMemory

ROBOT = Robot.load(Path("lekiwi-colour"))
CATALOGUE = Catalogue.load()
CAN = CATALOGUE["blue_can"]
POSE = ROBOT.camera_chain.pose({})
CAMERA = ROBOT.camera
FLOOR = (120, 120, 116)
NS = 1_000_000_000
TURN = np.linspace(0.0, 2 * pi, 90)


def pixels(points: FloatArray) -> FloatArray:
    """Where points (n, 3), body frame, m, are in the picture, (n, 2)."""
    x, y, z = ((points - POSE[:3, 3]) @ POSE[:3, :3]).T
    return np.stack([CAMERA.cx + CAMERA.fx * x / z, CAMERA.cy + CAMERA.fy * y / z], axis=1)


def painted(picture: ImageArray, points: FloatArray, rgb: tuple[float, ...]) -> None:
    """Paint the convex hull of points (n, 3); pixels at its edge are blended, as a camera blends them."""
    fine = np.zeros((4 * CAMERA.height, 4 * CAMERA.width), dtype=np.uint8)
    cv2.fillConvexPoly(fine, cv2.convexHull(np.rint(4 * pixels(points) + 1.5).astype(np.int32)), (255,))
    share = cv2.resize(fine, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA)[:, :, None] / 255
    picture[:] = np.rint(share * np.array(rgb) + (1 - share) * picture)


def can_points(x: float, y: float, low_m: float = 0.0, high_m: float | None = None, wide: float = 1.0) -> FloatArray:
    """The rims of a can, or of a part of it."""
    assert CAN.radius_m is not None
    radius_m, top_m = wide * CAN.radius_m, CAN.size_m[2] if high_m is None else high_m
    return np.array([[x + radius_m * cos(t), y + radius_m * sin(t), z] for z in (low_m, top_m) for t in TURN])


def floor() -> ImageArray:
    return np.full((CAMERA.height, CAMERA.width, 3), FLOOR, dtype=np.uint8)


BLUE = tuple(200.0 * channel for channel in CAN.rgb)


class Looking:
    """A perception that looks at one picture after the other, with the arm parked."""

    def __init__(self) -> None:
        self.core = PerceptionCore(ROBOT, PerceptionConfig(), CATALOGUE)
        self.now_ns = NS

    def at(self, picture: ImageArray, arm_rad: float = 0.0) -> tuple[list[Detection], Obstacles | None]:
        """What is seen in a picture; `arm_rad`: how far the arm is from its parked pose."""
        self.now_ns += NS // 10
        height, width = picture.shape[:2]
        colour = np.ascontiguousarray(picture).reshape(-1).data
        joints = ROBOT.poses["park"]
        state = ServoState(
            stamp_ns=self.now_ns, joints=tuple(joints), position_rad=tuple(a + arm_rad for a in joints.values()),
            speed_radps=(0.0,) * len(joints), load=(0.0,) * len(joints),
        )  # fmt: skip
        frame = Frame(stamp_ns=self.now_ns, width=width, height=height, colour=colour, depth=memoryview(b""))
        told = [one.message for one in self.core.step([Sample(ARM_STATE, state), Sample(FRAME, frame)], self.now_ns)]
        detections = next(one for one in told if isinstance(one, Detections))
        return list(detections.detections), next((one for one in told if isinstance(one, Obstacles)), None)

    def only(self, picture: ImageArray, label: str = "blue_can") -> Detection:
        found, _ = self.at(picture)
        assert [one.label for one in found] == [label]
        assert found[0].position_m is not None
        assert found[0].sigma_m is not None
        return found[0]


@pytest.fixture
def looking() -> Looking:
    return Looking()


def off_m(found: Detection, x: float, y: float) -> float:
    assert found.position_m is not None
    return hypot(found.position_m[0] - x, found.position_m[1] - y)


def test_a_whole_object_is_where_it_stands_and_surer_the_nearer(looking: Looking) -> None:
    sigmas = []
    for x, y in ((0.42, -0.05), (0.7, 0.2), (1.0, -0.3), (1.4, 0.1)):
        picture = floor()
        painted(picture, can_points(x, y), BLUE)
        found = looking.only(picture)
        assert (found.note, found.depth_m) == ("", None)
        assert off_m(found, x, y) < (found.sigma_m or 0.0)
        assert found.position_m is not None
        assert found.position_m[2] == pytest.approx(CAN.size_m[2] / 2)
        sigmas.append(found.sigma_m or 0.0)
    assert sigmas == sorted(sigmas)
    assert sigmas[0] < 0.009 < 0.02 < sigmas[-1]


def test_one_whose_foot_is_hidden_is_placed_by_its_top_and_doubtful(looking: Looking) -> None:
    whole = floor()
    painted(whole, can_points(0.6, 0.0), BLUE)
    sure = looking.only(whole)
    painted(whole, can_points(0.55, 0.0, 0.0, 0.05, wide=1.5), (90, 90, 90))
    found = looking.only(whole)
    assert found.note == "occluded"
    assert off_m(found, 0.6, 0.0) < 0.012
    assert (found.sigma_m or 0.0) > 1.4 * (sure.sigma_m or 1.0)


def test_one_that_is_hidden_at_a_side_is_doubtful(looking: Looking) -> None:
    picture = floor()
    painted(picture, can_points(0.6, 0.0), BLUE)
    picture[:, : CAMERA.width // 2 + 4] = FLOOR
    found = looking.only(picture)
    assert found.note == "occluded"
    assert off_m(found, 0.6, 0.0) < CAN.radius_m  # type: ignore[operator]


@pytest.mark.parametrize("away_m", [1.9, 0.21])
def test_one_that_the_pictures_edge_cuts_is_doubtful(looking: Looking, away_m: float) -> None:
    """By its foot at the upper edge, by its top at the lower one."""
    picture = floor()
    painted(picture, can_points(away_m, 0.25 if away_m < 1 else 0.0), BLUE)
    found = looking.only(picture)
    assert found.note == "cut"
    assert off_m(found, away_m, 0.25 if away_m < 1 else 0.0) < 0.03


def test_one_that_is_held_up_is_not_taken_to_stand(looking: Looking) -> None:
    picture = floor()
    painted(picture, can_points(0.45, 0.0, 0.12, 0.24), BLUE)
    found = looking.only(picture)
    assert found.note == "occluded"
    assert found.position_m == pytest.approx((0.45, 0.0, 0.18), abs=0.05)


@pytest.mark.parametrize(("wide", "high_m"), [(4.0, 0.5), (0.25, 0.03)])
def test_what_is_much_larger_or_smaller_is_no_such_object(looking: Looking, wide: float, high_m: float) -> None:
    picture = floor()
    painted(picture, can_points(0.8, 0.0, 0.0, high_m, wide), BLUE)
    assert not looking.at(picture)[0]


def test_a_can_behind_the_own_hand_is_no_ball(looking: Looking) -> None:
    """Of a can whose lower part is hidden as much is seen as of a ball."""
    picture = floor()
    painted(picture, can_points(0.5, 0.0), BLUE)
    looking.only(picture)
    for hidden_m in (0.03, 0.06, 0.08):
        painted(picture, can_points(0.46, 0.0, 0.0, hidden_m, wide=1.5), (90, 90, 90))
        looking.only(picture)


def test_a_robot_with_depth_that_gets_none_places_nothing() -> None:
    colour = np.full((480, 640, 3), FLOOR, dtype=np.uint8)
    colour[200:300, 300:350] = BLUE
    frame = Frame(stamp_ns=NS, width=640, height=480, colour=colour.reshape(-1).data, depth=memoryview(b""))
    found = seen_with_depth(frame).detections
    assert "blue_can" in [one.label for one in found]
    assert {(one.position_m, one.note, one.sigma_m) for one in found} == {(None, "no depth", None)}


# --- the floor -------------------------------------------------------------------------------------


def ahead_m(seen: Obstacles | None) -> float:
    """How far the floor is free straight ahead."""
    assert seen is not None
    return max((far for bearing, _, far in seen.free if abs(bearing) < 0.05), default=0.0)


def box(x: float, y: float, side_m: float, high_m: float) -> FloatArray:
    half = side_m / 2
    return np.array([[x + a, y + b, z] for a in (-half, half) for b in (-half, half) for z in (0.0, high_m)])


def test_floor_of_its_own_colour_is_free_up_to_what_stands_there(looking: Looking) -> None:
    empty = ahead_m(looking.at(floor())[1])
    assert empty > 1.8
    picture = floor()
    painted(picture, box(1.1, 0.0, 0.3, 0.3), (160, 90, 40))
    _, seen = looking.at(picture)
    camera_x = POSE[0, 3]
    assert seen is not None
    assert 0.8 < ahead_m(seen) + camera_x < 0.95
    nearest = min(x for x, y, _ in seen.points_m if abs(y) < 0.1)
    assert nearest == pytest.approx(0.95, abs=0.06)
    assert max((far for bearing, _, far in seen.free if bearing > 0.35)) > 1.5


def test_a_floor_of_another_colour_than_at_the_start_is_none(looking: Looking) -> None:
    assert ahead_m(looking.at(floor())[1]) > 1.8
    wall = floor()
    wall[:] = (40, 60, 150)
    assert looking.at(wall)[1] is None


def test_slowly_changing_light_leaves_the_floor_a_floor(looking: Looking) -> None:
    for dimmed in range(40):
        picture = (floor() * (1.0 - 0.01 * dimmed)).astype(np.uint8)
        assert ahead_m(looking.at(picture)[1]) > 1.8


def test_no_floor_is_told_while_the_arm_may_be_in_the_picture(looking: Looking) -> None:
    assert looking.at(floor(), arm_rad=0.4)[1] is None
    assert looking.at(floor())[1] is not None


def test_the_own_arm_is_no_obstacle(looking: Looking) -> None:
    own = own_picture(ROBOT, CAMERA.scaled(80, 60), ROBOT.poses["park"])
    assert 0.05 < own.mean() < 0.4
    assert not own[:30].any()
    picture = floor()
    picture[np.kron(own, np.ones((8, 8), dtype=bool))] = (30, 30, 30)
    _, seen = looking.at(picture)
    assert seen is not None
    assert not seen.points_m
    assert ahead_m(seen) > 1.8


# --- the planner -----------------------------------------------------------------------------------


def sigma_m(memory: TargetMemory, now_ns: int) -> float:
    estimate = memory.estimate("blue_can", Pose2(), now_ns)
    assert estimate is not None
    return estimate.sigma_m


def test_more_pictures_by_colour_alone_make_no_surer(looking: Looking) -> None:
    """Errors of mount and outline are alike in all of them. With depth they are not."""
    place = np.array([1.0, 0.0, 0.06])
    colour, depth = TargetMemory(MemoryConfig()), TargetMemory(MemoryConfig())
    for number in range(60):
        at_ns = number * NS // 15
        colour.see("blue_can", place, 1.0, at_ns, doubtful=False, own_sigma_m=0.02)
        depth.see("blue_can", place, 1.0, at_ns, doubtful=False)
    assert sigma_m(colour, at_ns) == pytest.approx(0.02, abs=1e-6)
    assert sigma_m(depth, at_ns) < 0.01
    colour.see("blue_can", place, 0.5, at_ns + NS // 15, doubtful=False, own_sigma_m=0.008)
    near = sigma_m(colour, at_ns + NS // 15)
    assert near < 0.012 < PlanningConfig().arm.grasp_sigma_m
    colour.see("blue_can", place, 0.5, at_ns + 2 * NS // 15, doubtful=True, own_sigma_m=0.02)
    assert sigma_m(colour, at_ns + 2 * NS // 15) < 1.3 * near, "a hidden part does not undo what was seen"


def test_without_depth_the_base_is_slow_everywhere(robot: Robot) -> None:
    slow = PlanningCore(ROBOT, PlanningConfig()).actuators.config
    most = PlanningConfig().navigation.blind_mps
    speeds = (slow.navigation.max_speed_mps, slow.navigation.detour_speed_mps, slow.follow.max_speed_mps)
    assert {*speeds, slow.follow.round_speed_mps, slow.search.max_speed_mps} == {most}
    assert PlanningCore(robot, PlanningConfig()).actuators.config == PlanningConfig()


@pytest.mark.sim
def test_it_fetches_a_small_can_by_colour_alone(tmp_path: Path) -> None:
    result = fetched(tmp_path, 0.02, 0.1, "lekiwi-colour")
    assert (result["outcome"], result["reason"]) == ("done", "")
    assert result["truth"]["held"]
    assert not result["truth"]["collisions"]
