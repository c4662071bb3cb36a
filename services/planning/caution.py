"""How fast the base may move as an operator wants it: not into what is known, slower where nothing is known."""

from __future__ import annotations

from collections import deque
from math import atan2, copysign, cos, hypot, pi, sin
from typing import NamedTuple

import numpy as np

from cocoro.arrays import BoolArray, FloatArray
from cocoro.clock import NS
from cocoro.frames import Pose2, wrap_rad
from cocoro.robot import Robot
from services.planning.config import PlanningConfig
from services.planning.course import Course, Move
from services.planning.navigation import Driver
from services.planning.surroundings import Fields, Surroundings, placed

_SHARES = (1.0, 0.7, 0.5, 0.35, 0.25, 0.15, 0.1)
"""Parts of the wanted speed that are tried."""
_LOOK_M = np.arange(0.35, 1.11, 0.10)
"""Places on the way ahead, from the body's centre, whose floor must have been seen; nearer ones no camera aim shows."""
_ASIDE_M = (0.0, 0.13, -0.13)
_TRAIL_M = 0.03
"""Way between two places that the robot remembers to have stood on."""
_RIM = np.linspace(-1.0, 1.0, 5)
"""Bearings of places on the body's rim, against the direction of motion, rad."""
_VIEW_RAD = 0.8
"""Directions of motion up to here from ahead are ones that the camera looks into."""


class Allowed(NamedTuple):
    """What is left of a wanted motion of the base."""

    speed_mps: float
    turn_radps: float
    why: str = ""
    """Why it is less than what was wanted; '' when it is not."""
    look_at: tuple[float, float] | None = None
    """A place ahead, odometry frame, m, whose floor was not seen yet."""
    aside_mps: float = 0.0


class ArmHull(NamedTuple):
    """The unfolded arm and what it holds, seen from above: balls (n, 2), body frame, m, their radii, (n,), m, and which
    of them are so low that they do not pass over known objects, (n,)."""

    places_m: FloatArray
    radii_m: FloatArray
    low: BoolArray


class Caution:
    """Knows where the robot has just been. One drive by hand has one."""

    def __init__(self, robot: Robot, config: PlanningConfig) -> None:
        self._config = config.by_hand
        self._margin_m = config.navigation.clearance_m
        self._body_m = robot.base.chassis_diameter_m / 2
        self._watcher = Course(robot, config, (0.0, 0.0), arm="folded")
        self._trail: deque[tuple[int, float, float]] = deque(maxlen=1000)
        self._glance: tuple[tuple[float, float], int] | None = None
        self._glance_ns = round(config.navigation.glance_s * NS)

    def forget(self) -> None:
        """The odometry frame is a new one."""
        self._trail.clear()
        self._glance = None

    def stood(self, body: Pose2, now_ns: int) -> None:
        """Note where the robot stands now."""
        trail = self._trail
        while trail and not 0 <= now_ns - trail[0][0] <= self._config.just_been_s * NS:
            trail.popleft()
        if not trail or np.hypot(trail[-1][1] - body.x_m, trail[-1][2] - body.y_m) >= _TRAIL_M:
            trail.append((now_ns, body.x_m, body.y_m))

    def allow(
        self,
        speed_mps: float,
        turn_radps: float,
        body: Pose2,
        around: Surroundings,
        fields: Fields,
        driver: Driver,
        now_ns: int,
        *,
        arm: ArmHull | None,
        looks: bool,
        aside_mps: float = 0.0,
    ) -> Allowed:
        """The part of a motion that is safe. `arm`: None when it is folded. `looks`: the head goes where `look_at` of
        the answer says.

        A motion with a part aside is one straight ahead, or back where the camera does not look, of a body that is
        turned into its direction: the chassis is round, and the arm is turned with it.
        """
        heading = 0.0
        if aside_mps:
            bearing = atan2(aside_mps, speed_mps)
            into_view = abs(bearing) <= _VIEW_RAD
            heading = bearing if into_view else wrap_rad(bearing + pi)
            speed_mps = hypot(speed_mps, aside_mps) * (1.0 if into_view else -1.0)
            body = body.compose(Pose2(0.0, 0.0, heading))
            arm = arm and arm._replace(places_m=placed(arm.places_m, Pose2(0.0, 0.0, -heading)))
        wanted = Allowed(speed_mps, turn_radps)
        if speed_mps < 0.0:
            wanted = self._backwards(wanted, body, around, driver, aside=aside_mps != 0.0)
        elif speed_mps > 0.0:
            wanted = self._ahead(wanted, body, around, driver, now_ns, looks=looks)
        part = self._clear(wanted, body, fields, driver, arm)
        if not aside_mps:
            return part
        return part._replace(speed_mps=part.speed_mps * cos(heading), aside_mps=part.speed_mps * sin(heading))

    def _backwards(self, wanted: Allowed, body: Pose2, around: Surroundings, driver: Driver, *, aside: bool) -> Allowed:
        slower = max(wanted.speed_mps, -self._config.crawl_mps)
        poses = driver.stopping_poses(slower, wanted.turn_radps)
        rim = np.array([[np.cos(np.pi + bearing), np.sin(np.pi + bearing)] for bearing in _RIM])
        places = np.concatenate([placed((self._body_m + 0.02) * rim, body.compose(pose)) for pose in poses])
        hidden = places[around.unseen(places)]
        if len(hidden) and self._trail:
            trail = np.array([(x, y) for _, x, y in self._trail])
            away_m = np.linalg.norm(hidden[:, None, :] - trail[None, :, :], axis=2).min(axis=1)
            hidden = hidden[away_m > self._body_m + 0.01]
        if len(hidden):
            where, how = ("on that side", "turn there") if aside else ("behind", "turn round")
            return wanted._replace(speed_mps=0.0, why=f"the floor {where} was never seen: {how} to drive there")
        slowly = "slowly, where the camera does not look" if aside else "slowly backwards"
        return wanted._replace(speed_mps=slower, why="" if slower == wanted.speed_mps else slowly)

    def _ahead(
        self, wanted: Allowed, body: Pose2, around: Surroundings, driver: Driver, now_ns: int, *, looks: bool
    ) -> Allowed:
        curve = wanted.turn_radps / max(wanted.speed_mps, 0.05)
        away = np.repeat(_LOOK_M, len(_ASIDE_M))
        angle = curve * away
        aside = np.tile(np.array(_ASIDE_M), len(_LOOK_M))
        # Along an arc: the chord at half of its angle.
        half = np.sinc(angle / (2 * np.pi)) * away
        x = half * np.cos(angle / 2) - aside * np.sin(angle)
        y = half * np.sin(angle / 2) + aside * np.cos(angle)
        places = placed(np.stack([x, y], axis=1), body)
        unseen = np.flatnonzero(around.unseen(places))
        if not len(unseen):
            self._glance = None
            return wanted
        first = int(unseen[0])
        place = (float(places[first, 0]), float(places[first, 1]))
        if looks:
            self._count_as_seen(place, around, now_ns)
        # Before the first place that can be seen all is unseen, too, if that one is.
        room_m = float(away[first]) - self._body_m - self._margin_m if away[first] > _LOOK_M[0] else 0.0
        most_mps = max(driver.stopping_mps(room_m), self._config.unseen_mps)
        if most_mps >= wanted.speed_mps:
            return wanted._replace(look_at=place)
        why = "slower, for the floor ahead was not seen yet"
        return wanted._replace(speed_mps=most_mps, why=why, look_at=place)

    def _count_as_seen(self, place_m: tuple[float, float], around: Surroundings, now_ns: int) -> None:
        """Floor ahead that stays hidden though the head looks there counts as seen after a while, as on every way."""
        if self._glance is None or np.hypot(*np.subtract(self._glance[0], place_m)) > 0.1:
            self._glance = place_m, now_ns
        if not 0 <= now_ns - self._glance[1] <= self._glance_ns:
            around.floor.pass_over(place_m)

    def _clear(self, wanted: Allowed, body: Pose2, fields: Fields, driver: Driver, arm: ArmHull | None) -> Allowed:
        """The greatest part of a motion from which the robot stops before everything known."""
        speed, turn = wanted.speed_mps, wanted.turn_radps
        if speed == 0.0 and (turn == 0.0 or arm is None):
            return wanted  # the body is round
        for share in _SHARES:
            move = Move(share * speed, turn if speed else share * turn, 0.0, "", False)
            if self._watcher.guarded(move, body, fields, driver):
                continue
            if arm is not None and self._arm_meets(move, arm, body, fields, driver):
                continue
            if share == 1.0:
                return wanted
            return wanted._replace(
                speed_mps=move.speed_mps, turn_radps=move.turn_radps, why="slower, for something is near"
            )
        if speed and turn:  # it may still turn on the spot
            left = self._clear(wanted._replace(speed_mps=0.0), body, fields, driver, arm)
            return left._replace(why="something is in the way: only turning")
        return wanted._replace(speed_mps=0.0, turn_radps=0.0, why="something is in the way")

    def _arm_meets(self, move: Move, arm: ArmHull, body: Pose2, fields: Fields, driver: Driver) -> bool:
        poses = driver.stopping_poses(move.speed_mps, move.turn_radps, turning=True)
        now_m = room_m(arm, body, fields)
        then_m = np.min([room_m(arm, body.compose(pose), fields) for pose in poses], axis=0)
        return bool((then_m < np.minimum(now_m, self._config.hull_m)).any())


def room_m(arm: ArmHull, body: Pose2, fields: Fields) -> FloatArray:
    """Distance of each ball from obstacles, (n,), m."""
    places = placed(arm.places_m, body)
    room: FloatArray = np.where(arm.low, fields.body.at(places), fields.arm.at(places)) - arm.radii_m
    return room


def limited(value: float, limit: float) -> float:
    """A value within plus and minus its limit."""
    return copysign(min(abs(value), limit), value)
