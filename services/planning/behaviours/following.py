"""Keeping behind a moving target, round what stands between."""

from __future__ import annotations

from math import atan2, cos, hypot

import numpy as np
from msgspec.structs import replace

from cocoro.clock import NS
from cocoro.frames import Pose2
from cocoro.messages import TargetEstimate
from cocoro.messages.actions import Follow
from cocoro.units import Vec3
from services.planning.arm import ArmStep
from services.planning.behaviours.base import Plan, Snapshot, planar_m
from services.planning.behaviours.driving import BackOff
from services.planning.config import FollowConfig
from services.planning.course import Course, Move
from services.planning.head import Aim
from services.planning.navigation import GENTLE
from services.planning.surroundings import Fields

_GLANCE_S = 0.6
"""Age of the target's newest sighting up to which the head may look at the floor ahead instead."""
_LOOK_S = 1.5
"""Time for which it looks at the place where the target must be, before that counts as lost."""
_AHEAD_S = 3.0
"""Time for which a lost target is thought to have gone on as it went."""
_SLOW_S = 1.1
"""Lag of the sight from which it keeps further away: what turns would leave the picture before it is known to."""
_FURTHER_M = 0.25
"""By so much at the most."""
_NO_NEED_M = 0.10
"""A gap below this needs no way."""


class Following:
    """Keeps a set distance to a moving target with head and base. The target's velocity is fed forward, so that the
    distance does not lag. Where something stands between, the robot drives round it and keeps the target in sight. A
    target that is lost is followed to where it was last going."""

    needs_sight = True

    def __init__(self, action: Follow) -> None:
        self._label = action.label
        self._course: Course | None = None
        """The way round; None while the straight way is free."""
        self._back_off = BackOff()
        self._place_m: Vec3 = (0.0, 0.0, 0.0)
        """The target's, odometry frame."""
        self._velocity_mps: Vec3 = (0.0, 0.0, 0.0)
        """The target's when it was last in sight, odometry frame."""
        self._counted_s = 0.0
        """Time of that motion that the estimate of a lost target contains."""
        self._looking_since_ns: int | None = None

    def step(self, snapshot: Snapshot) -> Plan:
        config = snapshot.actuators.config.follow
        target = snapshot.target(self._label)
        if target is None:
            return Plan(snapshot.stand(), snapshot.still(), f"{self._label} is unknown", None, "failed", "lost")
        if target.age_s > config.give_up_s:
            return self._lost(snapshot, target)
        self._place_m = target.odometry_position_m
        head = snapshot.look_at(target.position_m)
        backing = self._back_off.step(snapshot, head)
        if backing is not None:
            return backing
        arm = snapshot.actuators.arm.park(snapshot.angles, snapshot.dt_s)
        fields = snapshot.fields(self._label)
        if target.age_s > config.lost_s + snapshot.estimator.sight_lag_s:
            return self._look_for(snapshot, target, arm, fields)
        self._looking_since_ns = None
        fade_s = snapshot.actuators.config.memory.velocity_fade_s
        self._velocity_mps = target.velocity_mps
        self._counted_s = fade_s + snapshot.estimator.sight_lag_s  # the memory lets a lost target run out by so much
        off_m = abs(planar_m(target) - config.distance_m)
        wanted_m = config.distance_m + self._further_m(target, snapshot)
        gap = planar_m(target) - wanted_m
        move = self._straight(target, snapshot, config, wanted_m)
        if self._free(snapshot, move, gap, fields):
            self._course = None
        elif gap > _NO_NEED_M:
            move = self._round(snapshot, fields)
            move = move._replace(why=f"going round what is between us: {move.why}")
            if move.look_at is not None and target.age_s < _GLANCE_S + snapshot.estimator.sight_lag_s:
                head = self._look_down(snapshot, move)
        else:
            self._course = None
            move = move._replace(speed_mps=0.0, why="near enough; something is in the way")
        pace = 1.0 if self._course is None else GENTLE
        base = snapshot.actuators.driver.command(move.speed_mps, move.turn_radps, snapshot.dt_s, pace=pace)
        return Plan(base, arm, move.why, head, distance_m=off_m)

    # --- in sight ---------------------------------------------------------------------------------

    @staticmethod
    def _further_m(target: TargetEstimate, snapshot: Snapshot) -> float:
        """What a slow sight adds to the distance to a target that moves."""
        speed_mps = hypot(target.velocity_mps[0], target.velocity_mps[1])
        return min(speed_mps * max(snapshot.estimator.sight_lag_s - _SLOW_S, 0.0), _FURTHER_M)

    @staticmethod
    def _straight(target: TargetEstimate, snapshot: Snapshot, config: FollowConfig, wanted_m: float) -> Move:
        x, y, _ = target.position_m
        distance, bearing = hypot(x, y), atan2(y, x)
        vx, vy, _ = snapshot.body.inverse().rotate(target.velocity_mps)
        # Velocity along and across the line of sight.
        along = (vx * x + vy * y) / max(distance, 0.2)
        across = (x * vy - y * vx) / max(distance, 0.2)
        gap = distance - wanted_m
        speed = (along + config.gain_per_s * gap) * max(cos(bearing), 0.0)
        speed = min(max(speed, -0.25), config.max_speed_mps)
        turn = config.turn_gain_per_s * bearing + across / max(distance, 0.3)
        return Move(speed, turn, abs(gap), f"{distance:.2f} m behind it, {gap:+.2f} m to make up", False)

    def _free(self, snapshot: Snapshot, move: Move, gap_m: float, fields: Fields) -> bool:
        """Whether the straight motion meets nothing, now and up to the wanted distance."""
        actuators = snapshot.actuators
        watcher = Course(actuators.robot, actuators.config, (0.0, 0.0), arm="folded")
        if watcher.guarded(move, snapshot.body, fields, actuators.driver):
            return False
        if gap_m <= _NO_NEED_M:
            return True
        body = snapshot.body
        x, y = self._place_m[0] - body.x_m, self._place_m[1] - body.y_m
        along = np.arange(0.10, gap_m, 0.05)[:, None] * np.array([[x, y]]) / max(hypot(x, y), 1e-6)
        clearance = fields.body.at(along + np.array([body.x_m, body.y_m]))
        # Hysteresis: a way round is left only for a straight way with the whole margin.
        share = 0.5 if self._course is None else 1.2
        margin = actuators.robot.base.chassis_diameter_m / 2 + share * actuators.config.navigation.clearance_m
        return bool((clearance >= margin).all())

    def _round(self, snapshot: Snapshot, fields: Fields) -> Move:
        """One step on the way to where the target is seen from the wanted distance."""
        actuators, now_ns = snapshot.actuators, snapshot.now_ns
        config = actuators.config
        if self._course is None:
            quick = replace(config.navigation, detour_speed_mps=config.follow.round_speed_mps)
            self._course = Course(
                actuators.robot, replace(config, navigation=quick), (config.follow.distance_m, 0.0), arm="folded",
                arrive_m=0.15, serves=lambda pose: self._seen_from(snapshot, pose),
            )  # fmt: skip
        around, place = snapshot.estimator.around, self._place_m[:2]
        move = self._course.step(place, snapshot.body, around, fields, actuators.driver, now_ns)
        if move.blocked:
            self._course = None  # which begins anew: what blocks may move
        return move

    def _seen_from(self, snapshot: Snapshot, pose: Pose2) -> bool:
        """Whether nothing known hides the target from the camera of a robot at a pose."""
        return snapshot.estimator.around.sees((pose.x_m, pose.y_m, snapshot.actuators.camera_m), self._place_m)

    @staticmethod
    def _look_down(snapshot: Snapshot, move: Move) -> Aim:
        assert move.look_at is not None
        return snapshot.look_at(snapshot.body.inverse().apply((*move.look_at, 0.0)))

    # --- lost -------------------------------------------------------------------------------------

    def _look_for(self, snapshot: Snapshot, target: TargetEstimate, arm: ArmStep, fields: Fields) -> Plan:
        """Drive to where the target must be by its last motion, and look there."""
        x, y, z = target.odometry_position_m
        extra_s = min(target.age_s, _AHEAD_S) - self._counted_s
        place = (x + extra_s * self._velocity_mps[0], y + extra_s * self._velocity_mps[1], z)
        self._place_m = place
        here = snapshot.body.inverse().apply(place)
        off_m = abs(hypot(here[0], here[1]) - snapshot.actuators.config.follow.distance_m)
        head = snapshot.look_at(here)
        move = self._round(snapshot, fields)
        if move.blocked:
            return self._lost(snapshot, target)
        if not move.arrived:
            self._looking_since_ns = None
            if move.look_at is not None:
                head = self._look_down(snapshot, move)
            base = snapshot.actuators.driver.command(move.speed_mps, move.turn_radps, snapshot.dt_s, pace=GENTLE)
            return Plan(base, arm, f"lost it: {move.why}", head, distance_m=off_m)
        if self._looking_since_ns is None:
            self._looking_since_ns = snapshot.now_ns
        patience_s = _LOOK_S + 2 * snapshot.estimator.sight_lag_s
        if snapshot.now_ns - self._looking_since_ns > patience_s * NS:
            return self._lost(snapshot, target)
        return snapshot.looking("lost it: looking where it was going", head, off_m)

    def _lost(self, snapshot: Snapshot, target: TargetEstimate) -> Plan:
        why = f"{self._label} has not been seen for {target.age_s:.0f} s"
        return Plan(snapshot.stand(), snapshot.still(), why, None, "failed", "lost")
