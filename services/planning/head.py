"""What a camera is turned to: the aims of a search, the floor that is hidden from it; and its tilt error."""

from __future__ import annotations

from collections.abc import Sequence
from math import atan2, ceil, cos, hypot, sin
from typing import NamedTuple

import numpy as np

from cocoro.arrays import BoolArray, FloatArray
from cocoro.robot import Robot
from cocoro.units import Vec3
from services.planning.config import HeadConfig

_MOUNT_M = 0.01
"""Margin about the camera's mount."""


class Aim(NamedTuple):
    """What the camera is turned to: pan and tilt, rad, and the speed, rad/s."""

    pan_rad: float
    tilt_rad: float
    speed_radps: float


class Sweep:
    """Aims all around. The camera jumps from one to the next and rests at each: one that turns blurs its picture, so a
    jump shows more in a second than a steady turn."""

    def __init__(self, aims: Sequence[tuple[float, float]]) -> None:
        """`aims`: pan and tilt, rad, of each."""
        self._aims = aims
        self._passed = 0

    @property
    def done(self) -> bool:
        return self._passed >= len(self._aims)

    @property
    def share(self) -> float:
        return self._passed / len(self._aims)

    @property
    def aim(self) -> tuple[float, float]:
        """(pan, tilt), rad, to look at now; the last one when it is done."""
        return self._aims[min(self._passed, len(self._aims) - 1)]

    def go_on(self) -> None:
        """Take the next aim: the present one was looked at."""
        self._passed += 1


def neck_sweep(config: HeadConfig, pan_rad: float) -> Sweep:
    """Over the whole pan range at two tilts, for the far and the near floor. It begins ahead, then looks to the nearer
    side, to the other side and round it, round the first side, and last at the near floor."""
    side = 1.0 if pan_rad >= 0 else -1.0
    count = ceil(config.sweep_pan_rad / config.sweep_step_rad)
    pans = [side * config.sweep_pan_rad * number / count for number in range(count + 1)]
    far, near = config.sweep_tilts_rad
    ahead, first, rest = pans[0], pans[1], pans[2:]
    aims = [(ahead, config.middle_tilt_rad)]  # shows the floor that the robot would drive over first, too
    aims += [(pan, far) for pan in (first, -first, *(-pan for pan in rest), *rest)]
    aims += [(pan, near) for pan in (*reversed(pans), *(-pan for pan in pans[1:]))]
    return Sweep(aims)


def round_sweep(config: HeadConfig, pan_rad: float, tilt_rad: float) -> Sweep:
    """Once all round at one tilt, counter-clockwise, from where the camera looks now."""
    count = ceil(2 * np.pi / config.sweep_step_rad)
    return Sweep([(pan_rad + 2 * np.pi * number / count, tilt_rad) for number in range(count)])


def neck_glances(config: HeadConfig, pan_rad: float, floor: FloatArray) -> list[Aim]:
    """The way of the head over parts of the floor: bearings, rad, and distances, m, of places (n, 2), body frame.

    It passes slowly over the parts and fast between them, at one tilt, or where floor near the robot is wanted at two.
    """
    far, near = config.sweep_tilts_rad
    close = floor[:, 1] < config.middle_m[0]
    rows = [(far, floor[floor[:, 1] >= config.middle_m[1]]), (near, floor[floor[:, 1] < config.middle_m[1]])]
    if not close.any():
        rows = [(config.middle_tilt_rad, floor)]
    return glances(config, pan_rad, rows, config.sweep_pan_rad)


def glances(
    config: HeadConfig, pan_rad: float, rows: Sequence[tuple[float, FloatArray]], limit_rad: float
) -> list[Aim]:
    """The way of the camera over the floor's parts, each row at its tilt: slowly over the parts and fast between them.
    `limit_rad`: the greatest pan to both sides."""
    way: list[Aim] = []
    for tilt, places in rows:
        if not len(places):
            continue
        parts = _parts(np.sort(places[:, 0]), config, limit_rad)
        last = way[-1].pan_rad if way else pan_rad
        if abs(parts[0][0] - last) > abs(parts[-1][1] - last):
            parts = [(end, begin) for begin, end in reversed(parts)]
        for begin, end in parts:
            way.append(Aim(begin, tilt, config.between_speed_radps))
            way.append(Aim(end, tilt, config.sweep_speed_radps))
    return way


def _parts(bearings_rad: FloatArray, config: HeadConfig, limit: float) -> list[tuple[float, float]]:
    """First and last pan, rad, for each group of bearings (n,), sorted."""
    groups = np.split(bearings_rad, np.flatnonzero(np.diff(bearings_rad) > 2 * config.view_rad) + 1)
    parts = []
    for group in groups:
        low, high = float(group[0]) + config.view_rad, float(group[-1]) - config.view_rad
        if low > high:
            low = high = (low + high) / 2
        parts.append((min(max(low, -limit), limit), min(max(high, -limit), limit)))
    return parts


class CameraTilt:
    """Corrects positions that were computed with the nominal neck, or the nominal mounting of a fixed camera, for a
    camera that is tilted against it.

    A camera that is tilted too far up sees everything as if the room were turned about its tilt axis: far things
    too high, and things below it too far away. The first shows the angle, the second disturbs driving by sight
    (derived). All positions are in the body frame, metres.
    """

    def __init__(self, robot: Robot, tilt_rad: float = 0.0) -> None:
        """`tilt_rad`: the angle by which things are seen higher than they are."""
        self._axis_x_m, _, self._axis_z_m = robot.chain(robot.camera_pivot).position(robot.head_angles()).tolist()
        self.tilt_rad = tilt_rad

    def straight(self, seen_m: Vec3) -> Vec3:
        """The true position (x, y, z) of what is seen at `seen_m`."""
        if self.tilt_rad == 0.0:
            return seen_m
        x, y, up = seen_m[0] - self._axis_x_m, seen_m[1], seen_m[2] - self._axis_z_m
        level = hypot(x, y)
        c, s = cos(self.tilt_rad), sin(self.tilt_rad)
        share = (c * level + s * up) / max(level, 1e-6)
        return self._axis_x_m + share * x, share * y, self._axis_z_m + c * up - s * level

    def heights(self, seen_m: FloatArray) -> FloatArray:
        """True heights above the floor (b,), metres, of what is seen at positions (b, 3)."""
        level = np.hypot(seen_m[:, 0] - self._axis_x_m, seen_m[:, 1])
        up = seen_m[:, 2] - self._axis_z_m
        return np.asarray(self._axis_z_m + np.cos(self.tilt_rad) * up - np.sin(self.tilt_rad) * level)

    def tilt_of(self, seen_m: Vec3, height_m: float) -> float:
        """The tilt, radians, by one sighting of something of a known height."""
        level, up = hypot(seen_m[0] - self._axis_x_m, seen_m[1]), seen_m[2] - self._axis_z_m
        # It is as far from the tilt axis as it is seen, and at the known height.
        away = hypot(level, up)
        true_up = height_m - self._axis_z_m
        return atan2(up, level) - atan2(true_up, max(away**2 - true_up**2, 1e-9) ** 0.5)


def behind_mount(robot: Robot, pan_rad: FloatArray, bearing_rad: FloatArray, distance_m: FloatArray) -> BoolArray:
    """Mark the places on the floor, by bearing, rad, and distance, m, body frame, that the mount hides from a camera
    with its neck at a pan, rad, each (n,) (slabs, Kay and Kajiya 1986); returns shape (n,)."""
    if robot.eye.mount is None:
        return np.zeros(len(bearing_rad), dtype=bool)
    low_m, high_m = robot.eye.mount
    neck, camera = (robot.chain(link).position(robot.head_angles()) for link in (robot.camera_pivot, robot.eye.link))
    ahead_m = camera[0] - neck[0]
    eye = np.stack(
        [neck[0] + ahead_m * np.cos(pan_rad), neck[1] + ahead_m * np.sin(pan_rad), np.full(len(pan_rad), camera[2])],
        axis=1,
    )
    place = distance_m[:, None] * np.stack([np.cos(bearing_rad), np.sin(bearing_rad), 0 * bearing_rad], axis=1)
    way = np.where(np.abs(place - eye) < 1e-9, 1e-9, place - eye)
    one = (np.array(low_m) - _MOUNT_M - eye) / way
    other = (np.array(high_m) + _MOUNT_M - eye) / way
    hidden: BoolArray = np.minimum(one, other).max(axis=1) < np.maximum(one, other).min(axis=1)
    return hidden
