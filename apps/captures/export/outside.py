"""The camera that films a simulated run from outside: it keeps robot and target in the picture, and moves smoothly.

The whole run is known, so the path is smoothed forwards and backwards: the camera does not lag behind the robot.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import cos, radians, sin, tan

import numpy as np
import scipy  # loads its parts when they are needed

from apps.captures.export.stage import recorded_stage
from apps.captures.export.story import Story, read
from cocoro.arrays import FloatArray, ImageArray
from cocoro.capture.conventions import CaptureError
from cocoro.capture.reader import Capture
from cocoro.clock import NS
from cocoro.messages import Truth
from cocoro.topics import TRUTH
from cocoro.units import Vec3
from sim.outside import OutsideStage
from sim.render.outside import FAST, VIEW_RAD, OutsideRenderer, look_at
from sim.rigid import rotation
from sim.scene import Scene

SIDES_RAD = tuple(radians(angle) for angle in (-62.0, 62.0, -110.0, 110.0))
"""Where the camera stands, from the direction to the target; the first from which nothing hides the robot."""
UP_RAD = radians(24.0)
FARTHEST_TARGET_M = 2.5
"""A target that is farther away is not in the picture: it would make the robot small."""
NEAREST_M = 1.55
MARGIN_M = 0.42
"""Kept free beside what is in the picture."""
MIDDLE_M = 0.35
"""Height of the picture's middle above the floor."""
SHIFT_S, TURN_S = 0.8, 2.5
"""Standard deviations of the smoothing, of place and distance, and of direction."""
ROOM_M = 9.6
"""The camera stays within the room's walls."""
LAMP: Vec3 = (0.45, 0.60, -1.0)
"""Direction of the lamp's light, with the camera looking along x and y to its left: from its right, and behind it."""


class CameraPath:
    """The camera's pose and what it looks at, for each of the truths, `targets` being the labels of interest then."""

    def __init__(self, scene: Scene, times_s: Sequence[float], truths: Sequence[Truth], targets: Sequence[str]) -> None:
        self._step_s = max((times_s[-1] - times_s[0]) / max(len(times_s) - 1, 1), 1e-3)
        bodies = np.array([truth.body_m[:2] for truth in truths])
        ahead = np.array([rotation(truth.body_orientation)[:2, 0] for truth in truths])
        middle, half, toward = bodies.copy(), np.zeros(len(truths)), ahead
        for n, (truth, label) in enumerate(zip(truths, targets, strict=True)):
            there = next((item.position_m for item in truth.objects if item.label == label), None)
            if there is None:
                continue
            offset = np.array(there[:2]) - bodies[n]
            distance_m = float(np.linalg.norm(offset))
            if 1e-3 < distance_m < FARTHEST_TARGET_M:
                middle[n] += offset / 2
                half[n] = distance_m / 2
                toward[n] = offset / distance_m
        self._middle = self._smooth(middle, SHIFT_S)
        self._toward = self._smooth(toward, TURN_S)
        tangent = tan(VIEW_RAD / 2) * 16 / 9
        self._away_m = np.maximum(self._smooth(half + MARGIN_M, SHIFT_S) / (0.8 * tangent), NEAREST_M)
        hidden = [self._hidden(scene, bodies, side_rad) for side_rad in SIDES_RAD]
        self._side_rad = SIDES_RAD[int(np.argmin(hidden))]

    def pose(self, n: int) -> FloatArray:
        """World pose (4, 4) of the camera."""
        return look_at(self._eye(n, self._side_rad), self.about(n))

    def about(self, n: int) -> FloatArray:
        """The point in the middle of the picture, (3,), m."""
        return np.array((*self._middle[n], MIDDLE_M))

    def lamp(self, n: int) -> Vec3:
        """Direction in which the light travels."""
        forward = self.pose(n)[:2, 2]
        x, y = forward / np.linalg.norm(forward)
        return x * LAMP[0] - y * LAMP[1], y * LAMP[0] + x * LAMP[1], LAMP[2]

    def _eye(self, n: int, side_rad: float) -> FloatArray:
        bearing = np.arctan2(self._toward[n, 1], self._toward[n, 0]) + side_rad
        away_m = self._away_m[n]
        level_m = away_m * cos(UP_RAD)
        place = self._middle[n] + level_m * np.array((np.cos(bearing), np.sin(bearing)))
        return np.array((*np.clip(place, -ROOM_M, ROOM_M), MIDDLE_M + away_m * sin(UP_RAD)))

    def _hidden(self, scene: Scene, bodies: FloatArray, side_rad: float) -> float:
        """Share of the time in which an obstacle is between the camera and the robot."""
        count = 0
        looks = range(0, len(bodies), 10)
        for n in looks:
            eye = self._eye(n, side_rad)
            robot = np.array((*bodies[n], MIDDLE_M))
            for share in np.linspace(0.05, 0.9, 18):
                x, y, z = eye + share * (robot - eye)
                count += any(
                    np.hypot(x - at[0], y - at[1]) < item.half_width_m and z < at[2] + item.standing_height_m
                    for item in scene.obstacles
                    for at in (scene.to_world(item.centre_m),)
                )
        return count / max(len(looks), 1)

    def _smooth(self, values: FloatArray, deviation_s: float) -> FloatArray:
        smooth: FloatArray = scipy.ndimage.gaussian_filter1d(values, deviation_s / self._step_s, axis=0, mode="nearest")
        return smooth


class OutsideFilm:
    """The pictures of a capture's run from outside."""

    def __init__(self, capture: Capture, story: Story, width: int, height: int, samples: int = FAST) -> None:
        """Raises CaptureError for a capture without the truth, or whose scene is not known."""
        self.stage: OutsideStage = recorded_stage(capture)
        read_truths = [(record.log_ns, truth) for record, truth in read(capture, TRUTH)]
        if not read_truths:
            raise CaptureError(f"{capture.path}: it has no {TRUTH.name}, from which the view from outside is drawn")
        self._truths = [truth for _, truth in read_truths]
        self._logs_ns = [log_ns for log_ns, _ in read_truths]
        self._start_ns = capture.start_ns
        tasks = [story.tasks.at(log_ns) for log_ns in self._logs_ns]
        targets = [task.label if task is not None else "" for task in tasks]
        for n in reversed(range(len(targets) - 1)):
            targets[n] = targets[n] or targets[n + 1]  # before a task the camera has its target already
        self.path = CameraPath(self.stage.scene, [at_ns / NS for at_ns in self._logs_ns], self._truths, targets)
        self._renderer = OutsideRenderer(self.stage.visuals, width, height, samples)

    def pictures(self, every_s: float) -> Iterator[tuple[int, ImageArray]]:
        """Log time and picture, RGB, at most one for each `every_s`."""
        due_ns = self._logs_ns[0]
        for n, (log_ns, truth) in enumerate(zip(self._logs_ns, self._truths, strict=True)):
            if log_ns < due_ns:
                continue
            due_ns = log_ns + round(0.9 * every_s * NS)
            path = self.path
            yield log_ns, self._renderer.picture(self.stage.poses(truth), path.pose(n), path.about(n), path.lamp(n))

    def close(self) -> None:
        self._renderer.close()
