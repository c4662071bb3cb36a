"""Postures and distances of an arm that its description does not say, chosen by its kinematics."""

from __future__ import annotations

from collections.abc import Mapping
from math import atan2, degrees, hypot, pi
from typing import Any, NamedTuple

import numpy as np

from apps.urdf.rows import rounded
from cocoro.robot import Robot
from services.planning.clearance import Clearance
from services.planning.config import ArmConfig
from services.planning.reach import HandPose, Reacher

LOW_M, TRAVEL_M, RISE_M = 0.05, 0.20, (0.12, 0.08, 0.05)
"""Heights: of a thing on the floor, of the empty hand on its way, and by how much a thing is lifted, in this order."""
BEHIND_M, APART_M = 0.005, 0.04
"""The hand waits so far beyond the least distance that it reaches; and there it leaves so much to the things that it
grasps."""
ROOM_M = 0.015
"""Least distance of the arm from chassis, mount and floor."""
ASIDE_RAD = 1.45
"""Where the folded arm is turned to; the planner takes an arm that is turned by 1.3 for folded."""
DRAWN, TRIED = 1500, 2
"""Postures that are drawn at random, and those of each way of bending that are tried."""
_COARSE_M, _STEP_M = 0.04, 0.01
_LEAST_M2 = 1e-6
_NEAREST_M, _FARTHEST_M = 0.10, 1.0
_BETWEEN_M = 0.03
"""Along the arm, between the surfaces of balls that must not overlap where it folds."""


class Postures(NamedTuple):
    """What a description has in `[pose]` and `[reach]`."""

    poses: dict[str, dict[str, float]]
    reach: dict[str, Any]


def straight_deg(robot: Robot) -> float | None:
    """Angle of the bend at which the joint before it and the one behind it are the farthest apart; None where they are
    always the same distance apart."""
    arm = robot.arm
    number = arm.joints.index(arm.bend)
    if number == 0:
        return None
    before = robot.link_of(arm.joints[number - 1])
    behind = robot.link_of((*arm.joints, arm.roll)[number + 1])
    tree, still = robot.tree(before, behind), dict.fromkeys(robot.joints, 0.0)

    def square_m2(angle_rad: float) -> float:
        poses = tree.poses(still | {arm.bend: angle_rad})
        return float(np.sum((poses[behind] - poses[before])[:3, 3] ** 2))

    ahead, aside, back = (square_m2(angle) for angle in (0.0, pi / 2, pi))
    even = (ahead + back) / 2
    if hypot(ahead - even, aside - even) < _LEAST_M2:
        return None
    return rounded(degrees(atan2(aside - even, ahead - even)), 3)


class _Arm:
    def __init__(self, robot: Robot) -> None:
        self.config = ArmConfig()
        self.robot = robot
        self.reacher = Reacher(robot, self.config.damping)
        self.still = dict.fromkeys(robot.joints, 0.0) | {robot.arm.roll: robot.claw.level_roll_rad}
        self._clearance = Clearance(robot)

    def angles(self, arm: Mapping[str, float]) -> dict[str, float]:
        return self.still | dict(arm)

    def clear(self, arm: Mapping[str, float]) -> bool:
        angles = self.angles(arm)
        return self._clearance.of(angles) > ROOM_M and not self._folds_into_itself(angles)

    def _folds_into_itself(self, angles: Mapping[str, float]) -> bool:
        """Whether two balls of the hull overlap that are farther from each other along the arm."""
        centres, radii = self._clearance.hull(angles)
        arm, hand = sum(tube.balls for tube in self.robot.hull.tube), self._clearance.on_hand
        steps = np.linalg.norm(np.diff(centres[:arm], axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        root = int(np.argmax(hand[:arm])) if hand[:arm].any() else arm - 1
        fingers = along[root] + np.linalg.norm(centres[arm:] - centres[root], axis=1)
        along = np.concatenate([along, fingers])
        apart = np.linalg.norm(centres[:, None] - centres[None], axis=2) - radii[:, None] - radii[None]
        far = np.abs(along[:, None] - along[None]) > radii[:, None] + radii[None] + _BETWEEN_M
        return bool((far & (apart < 0.0) & ~(hand[:, None] & hand[None])).any())

    def found(self, start: Mapping[str, float], radius_m: float, height_m: float) -> dict[str, float] | None:
        """The arm's angles with the hand ahead at that place, clear of everything; None where there are none."""
        pose = HandPose(radius_m, 0.0, height_m, self.config.pitch_rad)
        arm = self.reacher.solve(self.angles(start), pose)
        bend, straight_rad = self.robot.arm.bend, self.robot.arm.straight_rad
        if arm is None or (arm[bend] - straight_rad) * (start[bend] - straight_rad) < 0.0:
            return None
        return arm if self.clear(arm) else None


def postures_of(robot: Robot, wide_m: float) -> Postures | None:
    """Postures and distances for things of that width on the floor; None for an arm that reaches none there with a
    level hand."""
    arm = _Arm(robot)
    ways = [_way(arm, start) for start in _starts(arm, _drawn(arm))]
    best = max((way for way in ways if way is not None), key=lambda way: way.room_m, default=None)
    if best is None:
        return None
    azimuth, upright = arm.reacher.azimuth, best.upright
    unfolded = {name: angle for name, angle in upright.items() if name != azimuth}
    low, high = best.low_m, best.high_m
    retreat = low + BEHIND_M
    near = min(retreat + wide_m / 2 + APART_M, (retreat + high) / 2)
    distances_m = {
        "grasp_radius_m": (near + high) / 2,
        "retreat_radius_m": retreat,
        "travel_radius_m": best.travel_m,
        "travel_height_m": TRAVEL_M,
        "carry_radius_m": best.carry_m,
        "carry_rise_m": best.rise_m,
    }
    ranges_m = {
        "grasp_radius_range_m": (near, high),
        "touch_radius_range_m": ((retreat + near) / 2, high + BEHIND_M),
    }
    reach: dict[str, Any] = {name: rounded(value, 3) for name, value in distances_m.items()}
    reach |= {name: [rounded(value, 3) for value in pair] for name, pair in ranges_m.items()}
    poses = {"park": _folded(arm, best), "unfolded": unfolded, "upright": upright}
    return Postures(
        {name: {joint: rounded(angle, 4) for joint, angle in pose.items()} for name, pose in poses.items()}, reach
    )


class _Way(NamedTuple):
    """One way of reaching what stands ahead."""

    upright: dict[str, float]
    travel_m: float
    carry_m: float
    rise_m: float
    low_m: float
    high_m: float

    @property
    def room_m(self) -> float:
        return self.high_m - self.low_m


def _drawn(arm: _Arm) -> list[dict[str, float]]:
    """Postures of the joints behind the azimuth, at random, within one turn."""
    draws = np.random.default_rng(0)
    joints = [name for name in arm.reacher.joints if name != arm.reacher.azimuth]
    limits = np.clip([arm.robot.joints[name].limits_rad for name in joints], -pi, pi)
    rows = draws.uniform(limits[:, 0], limits[:, 1], (DRAWN, len(joints)))
    low, high = arm.robot.joints[arm.reacher.azimuth].limits_rad
    ahead = {arm.reacher.azimuth: min(max(0.0, low), high)}
    return [ahead | dict(zip(joints, row, strict=True)) for row in rows.tolist()]


def _starts(arm: _Arm, drawn: list[dict[str, float]]) -> list[dict[str, float]]:
    """Of each way of bending the postures whose hand is the most nearly level, ahead and a little above the floor."""
    bend, straight_rad = arm.robot.arm.bend, arm.robot.arm.straight_rad
    scored: dict[bool, list[tuple[float, int]]] = {False: [], True: []}
    for number, posture in enumerate(drawn):
        pose = arm.reacher.pose(arm.angles(posture))
        off = abs(pose.pitch_rad - arm.config.pitch_rad) + 2.0 * abs(pose.height_m - TRAVEL_M) + abs(pose.azimuth_rad)
        scored[posture[bend] > straight_rad].append((off, number))
    return [drawn[number] for rows in scored.values() for _, number in sorted(rows)[:TRIED]]


def _way(arm: _Arm, start: Mapping[str, float]) -> _Way | None:
    """How far the arm reaches from there; None where it does not come low, or does not travel or lift."""
    low = _reached(arm, start)
    if len(low) < 3:
        return None
    first, last = low[0][0], low[-1][0]
    radii = [*np.arange(first - _STEP_M, _NEAREST_M, -_STEP_M).tolist(), *(radius for radius, _ in low)]
    travels = ((radius, arm.found(low[0][1], radius, TRAVEL_M)) for radius in radii)
    travel_m, upright = next(((radius, found) for radius, found in travels if found is not None), (0.0, None))
    amid = low[len(low) // 2][1]
    carries = ((rise, radius) for rise in RISE_M for radius in radii if arm.found(amid, radius, LOW_M + rise))
    rise_m, carry_m = next(carries, (None, 0.0))
    if upright is None or rise_m is None:
        return None
    return _Way(upright, travel_m, carry_m, rise_m, first, last)


def _reached(arm: _Arm, start: Mapping[str, float]) -> list[tuple[float, dict[str, float]]]:
    """The distances that a low hand reaches one after another, rising, about the first that is found, with the arm's
    angles there."""
    for radius in np.arange(_NEAREST_M, _FARTHEST_M, _COARSE_M).tolist():
        if (first := arm.found(start, radius, LOW_M)) is not None:
            return [*reversed(_run(arm, first, radius, -_STEP_M)), (radius, first), *_run(arm, first, radius, _STEP_M)]
    return []


def _run(arm: _Arm, start: dict[str, float], radius_m: float, step_m: float) -> list[tuple[float, dict[str, float]]]:
    """What is reached from a distance on in steps, each from the one before."""
    found: list[tuple[float, dict[str, float]]] = []
    while _NEAREST_M <= radius_m + step_m <= _FARTHEST_M:
        radius_m += step_m
        angles = arm.found(start, radius_m, LOW_M)
        if angles is None:
            break
        found.append((radius_m, angles))
        start = angles
    return found


def _folded(arm: _Arm, way: _Way) -> dict[str, float]:
    """The hand drawn in as far as the arm does it level, and turned to a side. Low, so that no camera looks at it."""
    azimuth = arm.reacher.azimuth
    low, high = arm.robot.joints[azimuth].limits_rad
    aside = {azimuth: ASIDE_RAD if high >= ASIDE_RAD else max(low, -ASIDE_RAD) if -low > high else high}
    best, radius_m = way.upright, way.travel_m
    while radius_m > _NEAREST_M and (nearer := arm.found(best, radius_m - _STEP_M, TRAVEL_M)) is not None:
        if not arm.clear(nearer | aside):
            break
        best, radius_m = nearer, radius_m - _STEP_M
    return best | aside
