"""Judges tasks and pursuits by the simulator's truth, never by the robot's own belief."""

from __future__ import annotations

from collections import deque
from math import acos, atan2, degrees, hypot, sqrt

import msgspec
import numpy as np

from cocoro.arrays import FloatArray
from cocoro.messages import TrueObject, Truth
from cocoro.robot import Robot
from cocoro.units import Vec3
from sim.rigid import rotation
from sim.scene import Scene, SceneObject
from sim.stage import FLOOR

HELD_HEIGHT_M = 0.10
HELD_S = 2.0
TILTED_DEG = 30.0
MOVED_M = 0.05
STANDING_DEG = 5.0


class Verdict(msgspec.Struct, frozen=True, kw_only=True):
    """The outcome of a run up to the newest truth."""

    lifted_m: float
    """Height gained by the target's lowest point since the start."""
    held: bool
    """For the last 2 s the target's lowest point was at least 0.10 m above the floor, and the target touched both claws
    and nothing else."""
    knocked_over: tuple[str, ...]
    """Objects that tilted by more than 30 degrees (balls excepted) or moved by more than 5 cm; the target counts only
    until both claws first touched it, and objects that move by themselves or are held at the start never count."""
    collisions: tuple[str, ...]
    """Unwanted contacts of the robot ('elbow~green_can'), each once, in order of appearance."""
    target_moved_m: float
    """Largest horizontal distance of the target from its first place, until both claws first touched it."""
    target_from_start_m: float | None = None
    """Horizontal distance of the target from the robot's first place; None without a target."""
    target_standing: bool | None = None
    """Whether the target stands upright on the floor and touches nothing else; None without a target."""


class Judge:
    """Judges a task. Feed it every truth (30 to 60 a second) from the start of the task on.

    `target` is the label of the object to fetch, or '' for a task without one. Raises KeyError for a label that is not
    in the scene.
    """

    def __init__(self, robot: Robot, scene: Scene, target: str = "") -> None:
        self._scene = scene
        self._jaws = frozenset(robot.fingers)
        self._target = scene.object(target).label if target else ""
        self._first: dict[str, Vec3] = {}
        self._first_bottom_m = 0.0
        self._bottom_m = 0.0
        self._now_ns = 0
        self._held_since_ns: int | None = None
        self._grasped = False
        self._carried: set[str] = set()
        self._moved_m = 0.0
        self._knocked: dict[str, None] = {}
        self._collisions: dict[str, None] = {}
        self._start_m: Vec3 | None = None
        self._newest: TrueObject | None = None

    def feed(self, truth: Truth) -> None:
        self._now_ns = truth.stamp_ns
        if self._start_m is None:
            self._start_m = truth.body_m
        self._collisions.update(dict.fromkeys(truth.collisions))
        for item in truth.objects:
            if item.kind == "object":
                self._feed_object(item)

    def result(self) -> Verdict:
        held_ns = self._now_ns - self._held_since_ns if self._held_since_ns is not None else 0
        return Verdict(
            lifted_m=self._bottom_m - self._first_bottom_m,
            held=held_ns >= HELD_S * 1e9,
            knocked_over=tuple(self._knocked),
            collisions=tuple(self._collisions),
            target_moved_m=self._moved_m,
            target_from_start_m=self._from_start_m(),
            target_standing=self._standing(),
        )

    def _from_start_m(self) -> float | None:
        if self._newest is None or self._start_m is None:
            return None
        x, y, _ = self._newest.position_m
        return hypot(x - self._start_m[0], y - self._start_m[1])

    def _standing(self) -> bool | None:
        if self._newest is None:
            return None
        upright = self._scene.object(self._target).shape == "sphere" or _tilt_deg(self._newest) < STANDING_DEG
        return upright and set(self._newest.touching) == {FLOOR}

    def _feed_object(self, item: TrueObject) -> None:
        known = self._scene.object(item.label)
        first = self._first.setdefault(item.label, item.position_m)
        moved_m = hypot(item.position_m[0] - first[0], item.position_m[1] - first[1])
        is_target = item.label == self._target
        if is_target:
            self._newest = item
            self._feed_target(item, known, fresh=first is item.position_m)
            if not self._grasped:
                self._moved_m = max(self._moved_m, moved_m)
        if first is item.position_m and set(item.touching) >= self._jaws:
            self._carried.add(item.label)
        if known.kinematic or item.label in self._carried or (is_target and self._grasped):
            return
        if moved_m > MOVED_M or (known.shape != "sphere" and _tilt_deg(item) > TILTED_DEG):
            self._knocked[item.label] = None

    def _feed_target(self, item: TrueObject, known: SceneObject, *, fresh: bool) -> None:
        self._bottom_m = item.position_m[2] - _bottom_depth_m(known, item)
        if fresh:
            self._first_bottom_m = self._bottom_m
        self._grasped |= set(item.touching) >= self._jaws
        if self._bottom_m < HELD_HEIGHT_M or set(item.touching) != self._jaws:
            self._held_since_ns = None
        elif self._held_since_ns is None:
            self._held_since_ns = self._now_ns


def _upright(item: TrueObject) -> tuple[float, float, float]:
    """The world's z axis in the object's frame."""
    x, y, z, w = item.orientation
    return 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)


def _tilt_deg(item: TrueObject) -> float:
    return degrees(acos(min(max(_upright(item)[2], -1.0), 1.0)))


def _bottom_depth_m(known: SceneObject, item: TrueObject) -> float:
    """Height of the object's centre above its lowest point."""
    sizes = known.dimensions_m
    if known.shape == "sphere":
        return sizes[0]
    up = _upright(item)
    if known.shape == "box":
        return sum(abs(share) * size / 2 for share, size in zip(up, sizes, strict=True))
    radius_m, height_m = sizes
    return abs(up[2]) * height_m / 2 + sqrt(max(0.0, 1.0 - up[2] ** 2)) * radius_m


class Pursuit(msgspec.Struct, frozen=True, kw_only=True):
    """The figures of a follow task, from the moment at which following began."""

    mean_gap_m: float
    """Horizontal distance from the robot's centre to the target's nearest edge."""
    max_gap_m: float
    min_gap_m: float
    lost_s: float
    """Longest time for which the target's centre was outside the camera's picture."""
    contacts: int
    """How many times the robot began to touch anything except the floor."""
    near_share: float = 0.0
    """Share of the time for which it was off its distance by at most `within_m`, from when it first was, at the latest
    `catch_up_s` after following began; 0 where it was not and that time did not come."""
    stood_s: float = 0.0
    """Longest time for which the robot neither drove nor turned although it was off its distance by more than
    `STOOD_M`."""
    off_m: float = 0.0
    """Root mean square of how far it was off its distance, without the first `SETTLE_S` of following."""
    off_axis_rad: float = 0.0
    """Root mean square of the angle between the camera's axis and the target, over the same time."""


SETTLE_S = 5.0
"""Time to come to the asked distance."""
STOOD_M, STOOD_MPS, STOOD_RADPS = 0.15, 0.02, 0.05
"""Off its distance by more than this, and slower than this, a robot that follows stands."""


class PursuitJudge:
    """Judges a pursuit. Feed it every truth, and call `begin` when following begins. Raises KeyError for a target that
    is not in the scene."""

    def __init__(
        self,
        robot: Robot,
        scene: Scene,
        target: str,
        *,
        distance_m: float = 0.8,
        within_m: float = 0.4,
        catch_up_s: float = 10.0,
    ) -> None:
        """`distance_m`: that which the robot is to keep from centre to centre, over the floor."""
        self._distance_m, self._within_m, self._catch_up_s = distance_m, within_m, catch_up_s
        self._began_ns = self._last_ns = 0
        self._from_ns: int | None = None
        self._near_ns = 0
        self._off_m2: list[float] = []
        self._off_axis_rad2: list[float] = []
        self._moving_ns = self._stood_ns = 0
        self._poses: deque[tuple[int, FloatArray]] = deque(maxlen=5)
        """Stamps and poses (x, y, yaw), from which speeds are taken."""
        self._camera = robot.camera
        self._chain = robot.camera_chain
        self._radius_m = scene.object(target).dimensions_m[0]
        self._target = target
        self._begun = False
        self._gaps_m: list[float] = []
        self._seen_ns: int | None = None
        self._longest_ns = 0
        self._touching: frozenset[str] = frozenset()
        self._contacts = 0

    def begin(self) -> None:
        self._begun = True

    def feed(self, truth: Truth) -> None:
        if not self._begun:
            return
        target = next(item for item in truth.objects if item.label == self._target)
        distance_m = hypot(target.position_m[0] - truth.body_m[0], target.position_m[1] - truth.body_m[1])
        self._feed_distance(truth, target, abs(distance_m - self._distance_m))
        self._gaps_m.append(distance_m - self._radius_m)
        if self._seen_ns is None or self._in_picture(truth, target):
            self._seen_ns = truth.stamp_ns
        self._longest_ns = max(self._longest_ns, truth.stamp_ns - self._seen_ns)
        touching = frozenset(truth.collisions)
        self._contacts += len(touching - self._touching)
        self._touching = touching

    def _feed_distance(self, truth: Truth, target: TrueObject, off_m: float) -> None:
        now_ns = truth.stamp_ns
        if not self._gaps_m:
            self._began_ns = self._last_ns = self._moving_ns = now_ns
        near = off_m <= self._within_m
        if self._from_ns is None and (near or now_ns - self._began_ns > self._catch_up_s * 1e9):
            self._from_ns = self._last_ns = now_ns
        if now_ns - self._began_ns > SETTLE_S * 1e9:
            self._off_m2.append(off_m**2)
            self._off_axis_rad2.append(self._off_axis_rad(truth, target) ** 2)
        if near:
            self._near_ns += now_ns - self._last_ns
        self._last_ns = now_ns
        turn = rotation(truth.body_orientation)
        self._poses.append((now_ns, np.array([*truth.body_m[:2], np.arctan2(turn[1, 0], turn[0, 0])])))
        (then_ns, then), (_, here) = self._poses[0], self._poses[-1]
        way = here - then
        time_s = max((now_ns - then_ns) / 1e9, 1e-3)
        turned = abs((way[2] + np.pi) % (2 * np.pi) - np.pi)
        if off_m <= STOOD_M or hypot(way[0], way[1]) > STOOD_MPS * time_s or turned > STOOD_RADPS * time_s:
            self._moving_ns = now_ns
        self._stood_ns = max(self._stood_ns, now_ns - self._moving_ns)

    def _near_share(self) -> float:
        if self._from_ns is None:
            return 0.0
        return self._near_ns / (self._last_ns - self._from_ns) if self._last_ns > self._from_ns else 1.0

    def _from_camera_m(self, truth: Truth, target: TrueObject) -> FloatArray:
        """The target's place in the camera's optical frame, (3,), m."""
        body = np.eye(4)
        body[:3, :3] = rotation(truth.body_orientation)
        body[:3, 3] = truth.body_m
        pose: FloatArray = body @ self._chain.pose(truth.joints_rad)
        place: FloatArray = pose[:3, :3].T @ (np.array(target.position_m) - pose[:3, 3])
        return place

    def _off_axis_rad(self, truth: Truth, target: TrueObject) -> float:
        x, y, z = self._from_camera_m(truth, target).tolist()
        return atan2(hypot(x, y), z)

    def _in_picture(self, truth: Truth, target: TrueObject) -> bool:
        x, y, z = self._from_camera_m(truth, target).tolist()
        if z <= 0:
            return False
        u, v = self._camera.cx + self._camera.fx * x / z, self._camera.cy + self._camera.fy * y / z
        return bool(0 <= u < self._camera.width and 0 <= v < self._camera.height)

    def result(self) -> Pursuit:
        gaps = self._gaps_m or [float("nan")]
        return Pursuit(
            mean_gap_m=float(np.mean(gaps)),
            max_gap_m=max(gaps),
            min_gap_m=min(gaps),
            lost_s=self._longest_ns / 1e9,
            contacts=self._contacts,
            near_share=round(self._near_share(), 3),
            stood_s=round(self._stood_ns / 1e9, 3),
            off_m=round(sqrt(float(np.mean(self._off_m2 or [0.0]))), 4),
            off_axis_rad=round(sqrt(float(np.mean(self._off_axis_rad2 or [0.0]))), 4),
        )
