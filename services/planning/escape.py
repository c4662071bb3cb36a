"""The way out of an obstacle's margin: slowly to where the clearance grows.

A robot whose pose was corrected, or beside which something appeared, may stand nearer to an obstacle than a path may
lead. From there every drive onwards may be blocked. It then backs off, or turns and drives ahead, along the shortest
straight line on which the clearance never gets less than it is now, until it has the whole margin again.
"""

from __future__ import annotations

from collections.abc import Callable
from math import hypot, pi
from typing import NamedTuple

import numpy as np

from cocoro.arrays import BoolArray, FloatArray
from cocoro.clock import NS
from cocoro.frames import Pose2, wrap_rad
from services.planning.floor_map import CELL_M, ClearanceField

SPEED_MPS = 0.08
_FARTHEST_M = 0.35
_STEP_M = CELL_M / 2
_BEARINGS = 32
_WORTH_M = 0.02
"""Least gain of clearance for which the robot moves when no line reaches the whole margin."""
_NOISE_M = 0.002
"""By so much the clearance may get less: the map's cells are coarser."""
_TURN_M_PER_RAD = 0.1
"""What a turn costs beside the length of a line."""
_ALIGNED_RAD = 0.15
_TURN_GAIN_PER_S = 1.8
_MOST_RADPS = 0.8
_HELD_NS = NS // 2
"""Time for which the robot is held within a margin before it looks for a way out."""
_LONGEST_NS = 12 * NS
"""Longest time on one way out, with the folding of the arm."""
_MOST = 3
"""Ways out that it takes near one place."""
_ELSEWHERE_M = 0.5
_BEHIND_RAD = np.radians((-50, -25, 0, 25, 50))
"""Bearings about the direction of a drive backwards at which the floor must have been seen."""


class WayOut(NamedTuple):
    """A straight line from where the robot stands."""

    bearing_rad: float
    """Odometry frame."""
    length_m: float
    backwards: bool

    def turn_rad(self, body: Pose2) -> float:
        """The turn, counter-clockwise positive, after which the robot drives along the line."""
        return wrap_rad(self.bearing_rad + (pi if self.backwards else 0.0) - body.yaw_rad)

    def drive(self, body: Pose2) -> tuple[float, float]:
        """Speed, m/s, and turn rate, rad/s: first the turn on the spot, then the line."""
        turn = self.turn_rad(body)
        rate = min(max(_TURN_GAIN_PER_S * turn, -_MOST_RADPS), _MOST_RADPS)
        if abs(turn) > _ALIGNED_RAD:
            return 0.0, rate
        return -SPEED_MPS if self.backwards else SPEED_MPS, rate


class Escape:
    """The ways out that a robot takes on one course."""

    def __init__(self, body_m: float, clearance_m: float) -> None:
        """`body_m`: radius of the body; `clearance_m`: the margin."""
        self._body_m, self._radius_m = body_m, body_m + clearance_m
        self._way: tuple[WayOut, int] | None = None
        """The present one, and since when, ns."""
        self._from = Pose2()
        """Where the last one began."""
        self._held_since_ns: int | None = None
        self._count = 0

    @property
    def under_way(self) -> bool:
        return self._way is not None

    def held(
        self,
        is_held: bool,
        body: Pose2,
        field: ClearanceField,
        unseen: Callable[[FloatArray], BoolArray],
        may_turn: Callable[[float], bool],
        now_ns: int,
    ) -> None:
        """Note whether the robot is held before an obstacle, and choose a way out where it was held for a while within
        a margin. `unseen`, `may_turn`: as for `way_out`."""
        if not is_held or _clearance_m(body, field) >= self._radius_m:
            self._held_since_ns = None
            return
        if self._held_since_ns is None:
            self._held_since_ns = now_ns
        if hypot(self._from.x_m - body.x_m, self._from.y_m - body.y_m) > _ELSEWHERE_M:
            self._count = 0
        if now_ns - self._held_since_ns < _HELD_NS or self._count >= _MOST:
            return
        # A cell more than the margin, or the next plan would begin at its edge.
        way = way_out(body, field, self._radius_m + CELL_M, unseen, may_turn, self._body_m)
        if way is not None:
            self._way, self._from, self._held_since_ns = (way, now_ns), body, None
            self._count += 1

    def drive(self, body: Pose2) -> tuple[float, float]:
        """Speed, m/s, and turn rate, rad/s, on the way that is under way."""
        return self._way[0].drive(body) if self._way is not None else (0.0, 0.0)

    def over(self, body: Pose2, field: ClearanceField, now_ns: int) -> bool:
        """Whether the robot is out, has driven the way's length, or has taken too long."""
        if self._way is None or _clearance_m(body, field) >= self._radius_m + CELL_M:
            return True
        way, since_ns = self._way
        gone_m = hypot(body.x_m - self._from.x_m, body.y_m - self._from.y_m)
        return gone_m >= way.length_m or now_ns - since_ns > _LONGEST_NS

    def end(self) -> None:
        self._way = None


def way_out(
    body: Pose2,
    field: ClearanceField,
    radius_m: float,
    unseen: Callable[[FloatArray], BoolArray],
    may_turn: Callable[[float], bool],
    body_m: float,
) -> WayOut | None:
    """The line that costs least to where the clearance is `radius_m`, or else to where it is greatest; None when no
    line gains anything.

    `unseen` marks places (n, 2), odometry frame, m, whose floor was not seen: the robot, of radius `body_m`, does not
    back onto them. `may_turn`: whether it may turn on the spot by an angle, rad.
    """
    bearings = body.yaw_rad + 2 * pi * np.arange(_BEARINGS) / _BEARINGS
    steps = np.arange(0.0, _FARTHEST_M + _STEP_M / 2, _STEP_M)
    toward = np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
    here = np.array([body.x_m, body.y_m])
    places = here + steps[None, :, None] * toward[:, None, :]
    clearance = field.at(places.reshape(-1, 2)).reshape(_BEARINGS, len(steps))
    now_m = float(clearance[0, 0])
    best: tuple[bool, float, WayOut] | None = None
    for bearing, direction, along in zip(bearings.tolist(), toward, clearance, strict=True):
        nearer = np.flatnonzero(np.diff(along) < -_NOISE_M)
        grows = along[: int(nearer[0]) + 1] if nearer.size else along
        out = np.flatnonzero(grows >= radius_m)
        at = int(out[0]) if out.size else int(grows.argmax())
        if grows[at] < min(now_m + _WORTH_M, radius_m):
            continue
        length_m = float(steps[at])
        for backwards in (False, True):
            way = WayOut(bearing, length_m, backwards)
            turn = way.turn_rad(body)
            short = grows[at] < radius_m
            cost = length_m + _TURN_M_PER_RAD * abs(turn) - (float(grows[at]) if short else 0.0)
            if best is not None and (short, cost) >= best[:2]:
                continue
            if not may_turn(turn) or (backwards and _onto_unseen(here, direction, bearing, length_m, body_m, unseen)):
                continue
            best = (short, cost, way)
    return best[2] if best is not None else None


def _onto_unseen(
    here_m: FloatArray,
    direction: FloatArray,
    bearing_rad: float,
    length_m: float,
    body_m: float,
    unseen: Callable[[FloatArray], BoolArray],
) -> bool:
    """Whether the edge of a body that moves along a line comes onto floor that was not seen."""
    edge = body_m * np.stack([np.cos(bearing_rad + _BEHIND_RAD), np.sin(bearing_rad + _BEHIND_RAD)], axis=1)
    moved = np.arange(_STEP_M, length_m + _STEP_M, _STEP_M)
    places = here_m + moved[:, None, None] * direction + edge[None]
    return bool(unseen(places.reshape(-1, 2)).any())


def _clearance_m(body: Pose2, field: ClearanceField) -> float:
    return float(field.at(np.array([[body.x_m, body.y_m]]))[0])
