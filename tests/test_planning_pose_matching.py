"""The sight of walls corrects the body's pose, except where it must not."""

from __future__ import annotations

from collections.abc import Callable
from math import cos, hypot, sin

import numpy as np
import pytest

from cocoro.arrays import FloatArray
from cocoro.frames import Pose2, wrap_rad
from services.planning.pose_matching import Constants, PoseMatching

Wall = tuple[tuple[float, float], tuple[float, float]]
ROOM: tuple[Wall, ...] = (
    ((1.2, -0.4), (1.0, 0.9)),
    ((-0.9, 0.8), (-0.9, -0.6)),
    ((-0.3, -1.1), (0.7, -1.3)),
)
LONG: tuple[Wall, ...] = (((-9.0, 1.0), (9.0, 1.0)),)
PANS = np.linspace(-2.4, 2.4, 9)
VEER_RADPM = 0.11


def points_of(walls: tuple[Wall, ...], body: Pose2, pan: float, rng: np.random.Generator) -> FloatArray:
    """Cells of 4 cm, body frame, of what the depth camera sees of upright walls."""
    bearings = np.linspace(pan - 0.5, pan + 0.5, 80)
    way = np.stack([np.cos(bearings + body.yaw_rad), np.sin(bearings + body.yaw_rad)], axis=1)
    away = np.full(len(bearings), np.inf)
    for (x1, y1), (x2, y2) in walls:
        along, to = np.array([x2 - x1, y2 - y1]), np.array([x1 - body.x_m, y1 - body.y_m])
        across = way[:, 0] * along[1] - way[:, 1] * along[0]
        distance = (to[0] * along[1] - to[1] * along[0]) / across
        share = (to[0] * way[:, 1] - to[1] * way[:, 0]) / across
        hit = (distance > 0.0) & (share >= 0.0) & (share <= 1.0)
        away[hit] = np.minimum(away[hit], distance[hit])
    seen = away < 2.6
    noisy = away[seen] + rng.normal(0.0, 0.008, int(seen.sum()))
    places = noisy[:, None] * np.stack([np.cos(bearings[seen]), np.sin(bearings[seen])], axis=1)
    return np.unique(np.floor(places / 0.04), axis=0) * 0.04 + 0.02


class Drive:
    """A robot whose odometry knows nothing of its veering, and which looks about at every place."""

    def __init__(self, walls: tuple[Wall, ...], clutter: Callable[[FloatArray], FloatArray] | None = None) -> None:
        self.walls, self.clutter = walls, clutter or (lambda points: points)
        self.rng = np.random.default_rng(1)
        self.matching = PoseMatching()
        self.true, self.raw, self.odometry = Pose2(), Pose2(), Pose2()
        self.look(PANS)

    def look(self, pans: FloatArray) -> None:
        for pan in pans:
            points = self.clutter(points_of(self.walls, self.true, float(pan), self.rng))
            self.matching.scan(points, (0.0, 0.0), self.odometry, float(pan))

    def go(self, x_m: float, turn_rad: float, errors: Constants, steps: int) -> None:
        """Drive on, by steps of the odometry."""
        for number in range(steps):
            step = Pose2(x_m, 0.0, turn_rad)
            self.true = self.true.compose(errors.step(step))
            self.raw = self.raw.compose(step)
            after = self.odometry.compose(self.matching.constants.step(step))
            self.matching.moved(self.odometry, after)
            self.odometry = after
            self.look(PANS[number % len(PANS) :][:1])

    def loop(self, errors: Constants) -> None:
        for _ in range(4):
            self.go(0.02, 0.0, errors, 30)
            self.go(0.0, 0.06, errors, 26)


def error(place: Pose2, true: Pose2) -> tuple[float, float]:
    """Distance, m, and angle, rad."""
    return hypot(place.x_m - true.x_m, place.y_m - true.y_m), abs(wrap_rad(place.yaw_rad - true.yaw_rad))


def passer_by(points: FloatArray) -> FloatArray:
    """A scan in which somebody walks past before the walls: all that is seen in 23 degrees is nearer."""
    if not len(points):
        return points
    rng = np.random.default_rng(round(1e6 * float(np.abs(points).sum())))
    bearing = np.arctan2(points[:, 1], points[:, 0])
    hidden = np.abs(bearing - rng.choice(bearing)) < 0.2
    near = rng.uniform(0.5, 0.8) * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
    return np.where(hidden[:, None], near, points)


@pytest.mark.parametrize("clutter", [None, passer_by])
def test_in_a_room_the_pose_stays_right_though_the_wheels_differ(
    clutter: Callable[[FloatArray], FloatArray] | None,
) -> None:
    drive = Drive(ROOM, clutter)
    drive.loop(Constants(veer_radpm=VEER_RADPM))
    raw_m, raw_rad = error(drive.raw, drive.true)
    assert raw_m > 0.10
    assert raw_rad > 0.25
    place = drive.matching.place(drive.odometry)
    assert {type(number) for number in place} == {float}, "it goes into messages"
    off_m, off_rad = error(place, drive.true)
    assert off_m < 0.06
    assert off_rad < 0.04
    assert drive.matching.constants.veer_radpm == pytest.approx(VEER_RADPM, abs=0.02)
    assert drive.matching.doubt_m < 0.08


def test_where_nothing_stands_nothing_is_corrected_and_the_doubt_grows() -> None:
    drive = Drive(())
    drive.loop(Constants(veer_radpm=VEER_RADPM))
    assert drive.matching.shift is None
    assert drive.matching.place(drive.odometry) == drive.raw
    assert drive.matching.doubt_m > 0.15


def test_one_long_wall_corrects_nothing_along_it() -> None:
    drive = Drive(LONG)
    drive.go(0.02, 0.0, Constants(distance=0.06, veer_radpm=-VEER_RADPM), 50)
    place = drive.matching.place(drive.odometry)
    assert drive.raw.x_m == pytest.approx(1.0)
    assert abs(place.y_m - drive.true.y_m) < 0.03
    assert abs(wrap_rad(place.yaw_rad - drive.true.yaw_rad)) < 0.03
    assert place.x_m == pytest.approx(1.0 * cos(place.yaw_rad / 2), abs=0.02)
    assert drive.matching.sigma_m > 0.008


def test_a_robot_that_has_not_moved_is_where_it_was() -> None:
    drive = Drive(ROOM)
    for pan in PANS:
        points = points_of(ROOM, Pose2(0.03, 0.0, 0.05), float(pan), drive.rng)
        assert not drive.matching.scan(points, (0.0, 0.0), drive.odometry, float(pan))
    assert drive.matching.shift is None


def test_a_room_that_does_not_fit_corrects_nothing() -> None:
    drive = Drive(ROOM)
    drive.walls = tuple(((y1, x1), (-y2, x2)) for (x1, y1), (x2, y2) in ROOM)
    drive.go(0.01, 0.0, Constants(), 4)
    moved_m, turned_rad = error(drive.matching.place(drive.odometry), drive.raw)
    assert moved_m < 0.02
    assert turned_rad < 0.03


def seen_at(drive: Drive, place: tuple[float, float]) -> tuple[float, float]:
    x, y, _ = drive.true.inverse().apply((*place, 0.0))
    return x, y


def test_known_objects_correct_the_pose_where_nothing_else_stands() -> None:
    drive, places = Drive(()), {"red_can": (1.2, 0.3), "blue_can": (0.9, -0.6)}
    for number in range(40):
        drive.go(0.03, 0.0, Constants(veer_radpm=VEER_RADPM), int(number >= 20))
        for label, place in places.items():
            drive.matching.sight(label, seen_at(drive, place), drive.odometry)
    off_m, off_rad = error(drive.matching.place(drive.odometry), drive.true)
    assert off_m < 0.02
    assert off_rad < 0.02
    assert error(drive.raw, drive.true)[1] > 0.06


def test_an_object_that_was_moved_corrects_nothing() -> None:
    drive = Drive(())
    for number in range(40):
        drive.go(0.01, 0.0, Constants(), int(number >= 20))
        place = (1.2, 0.3) if number < 20 else (1.2, 0.8)
        drive.matching.sight("red_can", seen_at(drive, place), drive.odometry)
    moved_m, turned_rad = error(drive.matching.place(drive.odometry), drive.raw)
    assert moved_m < 0.01
    assert turned_rad < 0.01


def test_equal_scans_give_equal_poses() -> None:
    places = []
    for _ in range(2):
        drive = Drive(ROOM)
        drive.go(0.02, 0.02, Constants(veer_radpm=VEER_RADPM), 30)
        places.append(drive.matching.place(drive.odometry))
    assert places[0] == places[1]


def test_another_task_begins_anew_and_keeps_what_is_known_of_the_wheels() -> None:
    drive = Drive(ROOM)
    drive.go(0.02, 0.02, Constants(veer_radpm=VEER_RADPM), 40)
    known, place = drive.matching.constants, drive.matching.place(drive.odometry)
    assert drive.matching.doubt_m > 0.0
    drive.matching.follow("another")
    assert drive.matching.doubt_m == 0.0
    assert drive.matching.constants == known != Constants()
    assert drive.matching.place(drive.odometry) == place


def test_a_step_with_known_errors_is_longer_and_bent() -> None:
    step = Constants(distance=0.1, turn=0.5, veer_radpm=0.2).step(Pose2(1.0, 0.0, 0.4))
    assert step.yaw_rad == pytest.approx(0.8)
    assert step.x_m == pytest.approx(1.1 * cos(0.2))
    assert step.y_m == pytest.approx(1.1 * sin(0.2))


def test_the_doubt_grows_along_a_way_on_which_each_wall_is_placed_by_the_one_before() -> None:
    pairs = [(((1.2 * k, 0.9), (1.2 * k + 0.7, 1.3)), ((1.2 * k + 0.5, -1.2), (1.2 * k + 1.1, -0.8))) for k in range(8)]
    drive = Drive(tuple(wall for pair in pairs for wall in pair))
    doubts_m = []
    for _ in range(6):
        drive.go(0.02, 0.0, Constants(veer_radpm=VEER_RADPM), 50)
        doubts_m.append(drive.matching.doubt_m)
    error_m, _ = error(drive.matching.place(drive.odometry), drive.true)
    assert doubts_m == sorted(doubts_m)
    assert error_m < 2 * drive.matching.doubt_m
    assert error_m > 2 * drive.matching.sigma_m, "the filter alone would be too sure"


def test_walls_that_are_seen_again_bound_the_doubt() -> None:
    drive = Drive(ROOM)
    drive.loop(Constants(veer_radpm=VEER_RADPM))
    once_m = drive.matching.doubt_m
    for _ in range(3):
        drive.loop(Constants(veer_radpm=VEER_RADPM))
    assert drive.matching.doubt_m < 1.3 * once_m
