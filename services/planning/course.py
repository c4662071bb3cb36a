"""The path to a target: an arc where that is free, else a detour to a pose from which it is free.

Paths are planned on the floor map for the round body with the arm folded. On the last stretch the hand is extended, so
the arm's footprint must be free too. `guarded` checks every wheel command: the robot must be able to stop before it
reaches an obstacle. Where that blocks every drive because the robot stands within an obstacle's margin, it first leaves
the margin (`services/planning/escape.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from math import atan2, cos, hypot, pi, sin
from typing import NamedTuple

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.clock import NS
from cocoro.frames import Pose2, wrap_rad
from cocoro.robot import Robot
from services.planning.config import PlanningConfig
from services.planning.escape import Escape
from services.planning.floor_plan import Way
from services.planning.footprint import ArmOut, Footprint
from services.planning.gaze import gaze_of
from services.planning.navigation import Driver, Offset, offset_to
from services.planning.routes import Routes
from services.planning.surroundings import Fields, Surroundings, placed
from services.planning.unfolding import NOT_HERE, Unfolding

_HEADINGS = 48
_REPLAN_NS = NS // 2
_LOOKAHEAD_M = 0.35
_WAITING_RADPS = 0.05
_CHORD = np.linspace(0.0, 1.0, 18)[1:]
"""Places along the straight way to a place ahead, as shares: 2 cm apart at the most."""


class Move(NamedTuple):
    """The motion that the course wants now."""

    speed_mps: float
    turn_radps: float
    left_m: float
    """Remaining length of the chosen path."""
    why: str
    direct: bool
    """On the last stretch: the hand may be extended."""
    arrived: bool = False
    blocked: bool = False
    look_at: tuple[float, float] | None = None
    """A place ahead, odometry frame, that the camera has not seen yet."""


class Detour(NamedTuple):
    """An intermediate pose and the path to it, odometry frame."""

    before: Pose2
    path: tuple[tuple[float, float], ...]
    stretch_m: float
    """Length of the last stretch, which begins there."""


class Course:
    """One drive to a target, which ends with the target at `aim_m`, body frame."""

    def __init__(
        self,
        robot: Robot,
        config: PlanningConfig,
        aim_m: tuple[float, float],
        *,
        arm: ArmOut,
        arrive_m: float | None = None,
        swing_m: FloatArray | None = None,
        serves: Callable[[Pose2], bool] | None = None,
    ) -> None:
        """`arm`: where the arm is extended: on the `last` stretch, all the way (`out`), or nowhere (`folded`).

        `arrive_m`: distance from the aim that counts as arrived; None: the driver's tolerances. `swing_m`: floor
        positions (n, 2), body frame, metres, that the arm sweeps while it unfolds; they must be free before the last
        stretch. `serves`: which poses before the target are good for what comes then; None: all.
        """
        self._unfolding = Unfolding(config.navigation, swing_m)
        self._serves = serves or (lambda pose: True)
        self._config = config.navigation
        self._aim_m, self._arrive_m = aim_m, arrive_m
        self._arm_out = arm == "out"
        self._stretch_m = 0.0 if arm == "folded" else self._config.last_stretch_m
        self._footprint = Footprint(robot, config.navigation, aim_m, arm)
        self._body_m, self._arm = self._footprint.body_m, self._footprint.arm
        self._glance: tuple[tuple[float, float], int] | None = None
        self._folded = False
        self._detour: Detour | None = None
        self._planned_ns: int | None = None
        self._stuck_since_ns: int | None = None
        self._last_stretch = False
        self.walled = False
        """The newest plan found no way: neither is the arc free nor is there a detour."""
        self._escape = Escape(self._body_m, self._config.clearance_m)
        self._blind_m = gaze_of(robot, config.head).nearest_m

    def step(
        self,
        target_m: tuple[float, float],
        body: Pose2,
        around: Surroundings,
        fields: Fields,
        driver: Driver,
        now_ns: int,
        *,
        folded: bool = False,
    ) -> Move:
        """One step towards a target (odometry frame). `folded`: the arm is not unfolded yet."""
        self._folded = folded
        around.way = Way(target_m, np.empty((0, 2)))
        x, y, _ = body.inverse().apply((*target_m, 0.0))
        offset = offset_to((x, y), self._aim_m)
        near_enough = self._arrive_m is not None and hypot(x - self._aim_m[0], y - self._aim_m[1]) < self._arrive_m
        there = (near_enough or driver.arrived(offset)) and self._serves(body)
        if there and self._roomy_here(body, fields):
            return Move(0.0, 0.0, abs(offset.ahead_m), "there", True, arrived=True)
        elsewhere = not there or self._unfolding.leave()
        leaving = self._leave(abs(offset.ahead_m), body, fields, driver, now_ns)
        if leaving is not None:
            return leaving
        if self._planned_ns is None or now_ns - self._planned_ns >= _REPLAN_NS:
            self._planned_ns = now_ns
            self._plan(target_m, body, around, fields, driver, offset)
        if there and (self._detour is None or not elsewhere):
            return self._no_room(abs(offset.ahead_m), body, fields, now_ns)
        if self._detour is None:
            speed, turn = driver.law(offset)
            why = f"{offset.ahead_m:.2f} m to drive, {offset.heading_rad:+.2f} rad to turn"
            ahead = placed(np.array([[pose.x_m, pose.y_m] for pose in driver.preview((x, y), self._aim_m)]), body)
            move = Move(speed, turn, abs(offset.ahead_m), why, self._last_stretch)
        else:
            move, ahead = self._along(self._detour, body, fields, driver)
        around.way = Way(target_m, ahead)
        return self._watch(move, ahead, body, around, fields, driver, now_ns)

    # --- planning ---------------------------------------------------------------------------------

    def _plan(
        self,
        target_m: tuple[float, float],
        body: Pose2,
        around: Surroundings,
        fields: Fields,
        driver: Driver,
        offset: Offset,
    ) -> None:
        x, y, _ = body.inverse().apply((*target_m, 0.0))
        preview = [body.compose(pose) for pose in driver.preview((x, y), self._aim_m)]
        # Hysteresis: on the last stretch, with the hand extended, smaller margins do.
        share = 0.5 if self._last_stretch else 1.0
        unfolds = not self._folded or self._unfolding.roomy_on(preview, fields)
        free = self._footprint.free(preview, fields, share, arm_from_m=self._stretch_m) and unfolds
        if free and self._serves(preview[-1]):
            self._detour = None
            self._last_stretch, self.walled = True, False
            self._unfolding.gone_on()
            return
        self._last_stretch = False
        if self._detour is not None and self._still_good(self._detour, fields, target_m):
            return
        self._detour = self._around(target_m, body, around, fields)
        self.walled = self._detour is None

    def roomy(self, pose: Pose2, fields: Fields) -> bool:
        """Whether the arm can unfold at a pose without touching a known obstacle."""
        return self._unfolding.roomy(pose, fields)

    def _roomy_here(self, body: Pose2, fields: Fields) -> bool:
        return not self._folded or self._unfolding.roomy(body, fields)

    def _no_room(self, left_m: float, body: Pose2, fields: Fields, now_ns: int) -> Move:
        """At the target, where the arm has no room to unfold, and no way to where it has: the camera looks at what is
        in the way, and then the robot gives up."""
        place = self._unfolding.in_the_way(body, fields)
        move = Move(0.0, 0.0, left_m, f"{NOT_HERE}: looking at what is in the way", False, look_at=place)
        if place is None or not self._unfolding.given_up(now_ns):
            return move
        return move._replace(blocked=True, why=self._unfolding.why_not(body, place))

    def _around(
        self, target_m: tuple[float, float], body: Pose2, around: Surroundings, fields: Fields
    ) -> Detour | None:
        """The cheapest pose before the target from which the last stretch is free, and the path to it."""
        config = self._config
        radius = self._body_m + config.clearance_m
        routes = around.routes(fields.body, body, radius, config.comfort_m)
        for stretch_m, spare_m in self._unfolding.tries if self._stretch_m else ((0.0, 0.0),):
            before = self._nearest_before(target_m, body, routes, fields, stretch_m, spare_m)
            if before is not None:
                return Detour(before, tuple(routes.path(before.x_m, before.y_m)), stretch_m)
        return None

    def _nearest_before(
        self,
        target_m: tuple[float, float],
        body: Pose2,
        routes: Routes,
        fields: Fields,
        stretch_m: float,
        spare_m: float,
    ) -> Pose2 | None:
        """The cheapest pose so far before the target, with so much room to spare for the arm."""
        best: tuple[float, Pose2] | None = None
        for number in range(_HEADINGS):
            yaw = -pi + 2 * pi * number / _HEADINGS
            c, s = cos(yaw), sin(yaw)
            end = Pose2(
                target_m[0] - c * self._aim_m[0] + s * self._aim_m[1],
                target_m[1] - s * self._aim_m[0] - c * self._aim_m[1],
                yaw,
            )
            back = np.linspace(stretch_m, 0.0, 8)
            stretch = [Pose2(end.x_m - c * step, end.y_m - s * step, yaw) for step in back]
            cost = routes.cost(stretch[0].x_m, stretch[0].y_m)
            if not np.isfinite(cost) or not self._footprint.free_stretch(stretch, fields):
                continue
            if not self._unfolding.roomy(stretch[0], fields, spare_m) or not self._serves(end):
                continue
            bearing = atan2(stretch[0].y_m - body.y_m, stretch[0].x_m - body.x_m)
            cost += 0.25 * abs(wrap_rad(yaw - bearing))
            if best is None or cost < best[0]:
                best = (cost, stretch[0])
        return best[1] if best is not None else None

    def _still_good(self, detour: Detour, fields: Fields, target_m: tuple[float, float]) -> bool:
        """Whether the path is still free and still ends in front of the target."""
        end = detour.before.compose(Pose2(detour.stretch_m))
        aim = end.apply((*self._aim_m, 0.0))
        if hypot(aim[0] - target_m[0], aim[1] - target_m[1]) > 0.06:
            return False
        path = np.array(detour.path)
        return bool((fields.body.at(path)[4:] >= self._body_m + 0.5 * self._config.clearance_m).all())

    # --- driving ----------------------------------------------------------------------------------

    def _along(self, detour: Detour, body: Pose2, fields: Fields, driver: Driver) -> tuple[Move, FloatArray]:
        config = self._config
        path = np.array(detour.path)
        gaps = np.hypot(path[:, 0] - body.x_m, path[:, 1] - body.y_m)
        nearest = int(gaps.argmin())
        rest = path[nearest:]
        left_m = hypot(detour.before.x_m - body.x_m, detour.before.y_m - body.y_m)
        if left_m < 0.06 or (len(rest) <= 2 and left_m < 0.12):
            turn = wrap_rad(detour.before.yaw_rad - body.yaw_rad)
            if abs(turn) < 0.08:
                # The last stretch begins here, whatever the next plan finds.
                self._detour, self._last_stretch = None, True
                self._unfolding.gone_on()
            return Move(0.0, 1.8 * turn, left_m, f"{turn:+.2f} rad to turn before the last stretch", False), rest
        point, round_corner = self._ahead(rest, detour, body, fields)
        heading = wrap_rad(atan2(point[1] - body.y_m, point[0] - body.x_m) - body.yaw_rad)
        way_m = left_m + 0.05 * max(len(rest) - 2, 0) if len(rest) > 2 else left_m
        speed = min(config.detour_speed_mps, (config.acceleration_mps2 * left_m) ** 0.5)
        if round_corner:
            speed = min(speed, driver.stopping_mps(hypot(point[0] - body.x_m, point[1] - body.y_m)))
        if abs(heading) > 0.6:
            speed = 0.0
        else:
            speed *= 1.0 - abs(heading) / 0.6
        return Move(speed, 1.8 * heading, way_m, f"{way_m:.2f} m to go around what is in the way", False), rest

    def _ahead(self, rest: FloatArray, detour: Detour, body: Pose2, fields: Fields) -> tuple[FloatArray, bool]:
        """The place on a path to steer to, as far ahead as the straight way to it cuts no corner, and whether a corner
        keeps it nearer than the look-ahead."""
        away = np.hypot(rest[:, 0] - body.x_m, rest[:, 1] - body.y_m)
        beyond = np.flatnonzero(away >= _LOOKAHEAD_M)
        end = np.array([[detour.before.x_m, detour.before.y_m]])
        points = rest[: int(beyond[0]) + 1] if beyond.size else np.concatenate([rest, end])
        here = np.array([body.x_m, body.y_m])
        chords = here + _CHORD[None, :, None] * (points - here)[:, None, :]
        clearance = fields.body.at(chords.reshape(-1, 2)).reshape(len(points), len(_CHORD)).min(axis=1)
        least_m = min(self._body_m + self._config.clearance_m / 2, self._clearance_m(body, fields))
        clear = np.flatnonzero(clearance >= least_m)
        last = len(points) - 1
        chosen = int(clear[-1]) if clear.size else min(1, last)
        return points[chosen], chosen < last

    def _watch(
        self,
        move: Move,
        ahead: FloatArray,
        body: Pose2,
        around: Surroundings,
        fields: Fields,
        driver: Driver,
        now_ns: int,
    ) -> Move:
        """Look at unseen places ahead, and stop before obstacles. `ahead`: path (n, 2), odometry frame, metres."""
        gaps = np.hypot(ahead[:, 0] - body.x_m, ahead[:, 1] - body.y_m)
        near = ahead[(gaps > 0.30) & (gaps < 1.1)]
        hidden = around.unseen(near) if len(near) else np.zeros(0, dtype=bool)
        if hidden.any():
            x, y = near[int(np.flatnonzero(hidden)[0])].tolist()
            move = self._over_unseen(move, (x, y), hypot(x - body.x_m, y - body.y_m), around, now_ns)
        careful = self.careful(move, body, fields, driver)
        if careful.speed_mps == 0.0 and move.speed_mps != 0.0 and self._planned_ns is not None:
            self._planned_ns = min(self._planned_ns, now_ns - _REPLAN_NS // 2)
        held = careful.speed_mps == 0.0 and move.speed_mps != 0.0 and abs(careful.turn_radps) < _WAITING_RADPS
        self._escape.held(
            held, body, fields.body, around.unseen, lambda turn: self._footprint.may_turn(turn, body, fields), now_ns
        )  # fmt: skip
        move = careful
        waiting = move.speed_mps == 0.0 and abs(move.turn_radps) < _WAITING_RADPS
        if not waiting:
            self._stuck_since_ns = None
        elif self._stuck_since_ns is None:
            self._stuck_since_ns = now_ns
        elif (now_ns - self._stuck_since_ns) / NS > self._config.stuck_s:
            return move._replace(blocked=True, why="there is no free way")
        return move

    def _over_unseen(
        self, move: Move, place: tuple[float, float], away_m: float, around: Surroundings, now_ns: int
    ) -> Move:
        """The move towards a place ahead that was not seen: the camera looks there first, where it can."""
        if away_m < self._blind_m:
            share = min(self._config.blind_mps / max(abs(move.speed_mps), 1e-6), 1.0)
            why = f"slowly, for the floor just ahead was not seen; {move.why}" if share < 1.0 else move.why
            return move._replace(speed_mps=share * move.speed_mps, why=why)
        if self._glance is None or hypot(self._glance[0][0] - place[0], self._glance[0][1] - place[1]) > 0.1:
            self._glance = place, now_ns
        if now_ns - self._glance[1] > self._config.glance_s * NS:
            around.floor.pass_over(place)  # something hides it, and no obstacle was seen there
        move = move._replace(look_at=place)
        if away_m < 0.55 and move.speed_mps > 0:
            move = move._replace(speed_mps=0.0, why=f"looking where to go; {move.why}")
        return move

    def careful(self, move: Move, body: Pose2, fields: Fields, driver: Driver) -> Move:
        """The move, without speed where an obstacle is too near to stop before it. Before an aim that stands near an
        obstacle the robot goes so slowly that it can stop at the aim."""
        if not self.guarded(move, body, fields, driver):
            return move
        if move.direct:
            share = min(driver.stopping_mps(move.left_m) / abs(move.speed_mps), 1.0)
            slower = move._replace(speed_mps=share * move.speed_mps, turn_radps=share * move.turn_radps)
            if not self.guarded(slower, body, fields, driver):
                return slower
        return move._replace(speed_mps=0.0, why=f"something is in the way; {move.why}")

    def guarded(self, move: Move, body: Pose2, fields: Fields, driver: Driver) -> bool:
        """Whether body or hand would reach an obstacle before the robot could stop."""
        if move.speed_mps == 0.0:
            return False
        poses = [body.compose(pose) for pose in driver.stopping_poses(move.speed_mps, move.turn_radps)]
        centres = np.array([[body.x_m, body.y_m], *([pose.x_m, pose.y_m] for pose in poses)])
        clearance = fields.body.at(centres) - self._body_m
        nearer = clearance[1:].min() < min(float(clearance[0]), self._config.clearance_m / 2)
        if bool(nearer) and clearance[1:].min() < self._config.clearance_m / 2:
            return True
        if not len(self._arm) or not (move.direct or self._arm_out):
            return False
        field = fields.arm if self._arm_out else fields.body
        now_m = float(field.at(placed(self._arm, body)).min())
        then_m = float(field.at(placed(self._arm, poses[-1])).min())
        return then_m < min(self._config.hand_half_width_m * 0.7, now_m)

    # --- out of a margin --------------------------------------------------------------------------

    def _leave(self, left_m: float, body: Pose2, fields: Fields, driver: Driver, now_ns: int) -> Move | None:
        """One step on the way out of a margin; None when there is none, or it has ended. Then the course plans anew."""
        if not self._escape.under_way:
            return None
        speed, turn = self._escape.drive(body)
        move = Move(speed, turn, left_m, "too near to an obstacle: leaving its margin", False)
        if self.guarded(move, body, fields, driver) or self._escape.over(body, fields.body, now_ns):
            self._escape.end()
            self._detour, self._planned_ns = None, None
            return None
        self._stuck_since_ns = None
        return move

    @staticmethod
    def _clearance_m(body: Pose2, fields: Fields) -> float:
        return float(fields.body.at(np.array([[body.x_m, body.y_m]]))[0])
