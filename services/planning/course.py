"""The path to a target: an arc where that is free, else a detour to a pose from which it is free.

Paths are planned on the floor map for the round body with the arm folded. On the last stretch the hand is extended, so
the arm's footprint must be free too. `guarded` checks every wheel command: the robot must be able to stop before it
reaches an obstacle. Where that blocks every drive because the robot stands within an obstacle's margin, it first leaves
the margin (`services/planning/escape.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from math import atan2, cos, hypot, pi, sin
from typing import Literal, NamedTuple

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.clock import NS
from cocoro.frames import Pose2, wrap_rad
from cocoro.robot import Robot
from services.planning.config import PlanningConfig
from services.planning.escape import Escape
from services.planning.floor_plan import Way
from services.planning.gaze import gaze_of
from services.planning.navigation import Driver, Offset, offset_to
from services.planning.surroundings import Fields, Surroundings, placed

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


class Course:
    """One drive to a target, which ends with the target at `aim_m`, body frame."""

    def __init__(
        self,
        robot: Robot,
        config: PlanningConfig,
        aim_m: tuple[float, float],
        *,
        arm: Literal["last", "out", "folded"],
        arrive_m: float | None = None,
        swing_m: FloatArray | None = None,
        serves: Callable[[Pose2], bool] | None = None,
    ) -> None:
        """`arm`: where the arm is extended: on the `last` stretch, all the way (`out`), or nowhere (`folded`).

        `arrive_m`: distance from the aim that counts as arrived; None: the driver's tolerances. `swing_m`: floor
        positions (n, 2), body frame, metres, that the arm sweeps while it unfolds; they must be free before the last
        stretch. `serves`: which poses before the target are good for what comes then; None: all.
        """
        self._swing = swing_m
        self._serves = serves or (lambda pose: True)
        self._config = config.navigation
        self._aim_m, self._arrive_m = aim_m, arrive_m
        self._arm_out = arm == "out"
        self._stretch_m = 0.0 if arm == "folded" else self._config.last_stretch_m
        self._body_m = robot.base.chassis_diameter_m / 2
        # Footprint of the hand with open claws along the arm's line in front of the robot.
        reach = () if arm == "folded" else np.arange(0.22, aim_m[0] + 0.09, 0.04)
        self._arm = np.array([[x, aim_m[1]] for x in reach]).reshape(-1, 2)
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
        if (near_enough or driver.arrived(offset)) and self._serves(body):
            return Move(0.0, 0.0, abs(offset.ahead_m), "there", True, arrived=True)
        leaving = self._leave(abs(offset.ahead_m), body, fields, driver, now_ns)
        if leaving is not None:
            return leaving
        if self._planned_ns is None or now_ns - self._planned_ns >= _REPLAN_NS:
            self._planned_ns = now_ns
            self._plan(target_m, body, around, fields, driver, offset)
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
        free = self._free(preview, fields, share, arm_from_m=self._stretch_m) and self._unfolds_on(preview, fields)
        if free and self._serves(preview[-1]):
            self._detour = None
            self._last_stretch, self.walled = True, False
            return
        self._last_stretch = False
        if self._detour is not None and self._still_good(self._detour, fields, target_m):
            return
        self._detour = self._around(target_m, body, around, fields)
        self.walled = self._detour is None

    def _free(self, poses: list[Pose2], fields: Fields, share: float, arm_from_m: float) -> bool:
        """Whether body and (over the last `arm_from_m`) hand pass all poses with this share of their margins."""
        centres = np.array([[pose.x_m, pose.y_m] for pose in poses])
        clearance = fields.body.at(centres) - self._body_m
        # The robot may always leave the place where it stands.
        leaving = np.hypot(*(centres - centres[0]).T) < 0.10
        if (clearance[~leaving] < share * self._config.clearance_m).any():
            return False
        end = centres[-1]
        half_m = self._config.hand_half_width_m * (0.4 + 0.6 * share)
        for pose in [*poses[::3], poses[-1]]:
            near_end = hypot(pose.x_m - end[0], pose.y_m - end[1]) <= (0.02 if self._arm_out else arm_from_m)
            if not self._arm_free(pose, fields, half_m, near_end=near_end):
                return False
        return True

    def _unfolds_on(self, poses: list[Pose2], fields: Fields) -> bool:
        """Whether a folded arm has room to unfold before it must be extended."""
        if not self._folded or self._swing is None:
            return True
        end = poses[-1]
        early = [p for p in poses if hypot(p.x_m - end.x_m, p.y_m - end.y_m) >= self._config.unfold_by_m] or poses[:1]
        return any(self.roomy(pose, fields) for pose in early[:: max(len(early) // 6, 1)])

    def roomy(self, pose: Pose2, fields: Fields) -> bool:
        """Whether the arm can unfold at a pose without touching a known obstacle."""
        if self._swing is None:
            return True
        return bool((fields.arm.at(placed(self._swing, pose)) > self._config.swing_room_m).all())

    def _around(
        self, target_m: tuple[float, float], body: Pose2, around: Surroundings, fields: Fields
    ) -> Detour | None:
        """The cheapest pose before the target from which the last stretch is free, and the path to it."""
        config = self._config
        radius = self._body_m + config.clearance_m
        routes = around.routes(fields.body, body, radius, config.comfort_m)
        best: tuple[float, Pose2] | None = None
        for number in range(_HEADINGS):
            yaw = -pi + 2 * pi * number / _HEADINGS
            c, s = cos(yaw), sin(yaw)
            end = Pose2(
                target_m[0] - c * self._aim_m[0] + s * self._aim_m[1],
                target_m[1] - s * self._aim_m[0] - c * self._aim_m[1],
                yaw,
            )
            back = np.linspace(self._stretch_m, 0.0, 8)
            stretch = [Pose2(end.x_m - c * step, end.y_m - s * step, yaw) for step in back]
            cost = routes.cost(stretch[0].x_m, stretch[0].y_m)
            if not np.isfinite(cost) or not self._free_stretch(stretch, fields):
                continue
            if not self.roomy(stretch[0], fields) or not self._serves(end):
                continue
            bearing = atan2(stretch[0].y_m - body.y_m, stretch[0].x_m - body.x_m)
            cost += 0.25 * abs(wrap_rad(yaw - bearing))
            if best is None or cost < best[0]:
                best = (cost, stretch[0])
        if best is None:
            return None
        path = routes.path(best[1].x_m, best[1].y_m)
        return Detour(best[1], tuple(path))

    def _free_stretch(self, stretch: list[Pose2], fields: Fields) -> bool:
        centres = np.array([[pose.x_m, pose.y_m] for pose in stretch])
        if (fields.body.at(centres) < self._body_m + self._config.clearance_m).any():
            return False
        half_m = self._config.hand_half_width_m + 0.01
        last = len(stretch) - 1
        return all(
            self._arm_free(pose, fields, half_m, near_end=not self._arm_out or number == last)
            for number, pose in enumerate(stretch)
        )

    def _arm_free(self, pose: Pose2, fields: Fields, half_m: float, *, near_end: bool) -> bool:
        """Whether the hand passes a pose. Carried high it passes over known objects; near the end it is low."""
        if not len(self._arm) or not (near_end or self._arm_out):
            return True
        field = fields.arm if self._arm_out and not near_end else fields.body
        return not (field.at(placed(self._arm, pose)) < half_m).any()

    def _still_good(self, detour: Detour, fields: Fields, target_m: tuple[float, float]) -> bool:
        """Whether the path is still free and still ends in front of the target."""
        end = detour.before.compose(Pose2(self._stretch_m))
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
            held, body, fields.body, around.unseen, lambda turn: self._may_turn(turn, body, fields), now_ns
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

    def _may_turn(self, turn_rad: float, body: Pose2, fields: Fields) -> bool:
        """Whether the extended arm meets nothing while the robot turns on the spot; the body is round."""
        if not self._arm_out or not len(self._arm):
            return True
        now_m = float(fields.arm.at(placed(self._arm, body)).min())
        turns = np.linspace(0.0, turn_rad, max(2, round(abs(turn_rad) / 0.1)))
        poses = [Pose2(body.x_m, body.y_m, body.yaw_rad + float(turned)) for turned in turns]
        least_m = min(float(fields.arm.at(placed(self._arm, pose)).min()) for pose in poses)
        return least_m >= min(self._config.hand_half_width_m * 0.7, now_m)

    @staticmethod
    def _clearance_m(body: Pose2, fields: Fields) -> float:
        return float(fields.body.at(np.array([[body.x_m, body.y_m]]))[0])
