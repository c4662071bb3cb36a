"""Driving to a place on the floor, the arm folded."""

from __future__ import annotations

from math import hypot

import numpy as np

from cocoro.clock import NS
from cocoro.messages.actions import GoThere
from cocoro.units import Vec3
from services.planning.behaviours.base import Plan, Snapshot, State
from services.planning.behaviours.driving import BackOff
from services.planning.course import Course, Move
from services.planning.head import Aim
from services.planning.surroundings import Fields


class GoingThere:
    """Drives around obstacles until the body's centre is at a place, whatever its heading then. While there is no room
    at the place, or no way there, it stands and looks there; when that lasts, it fails as `unreachable`."""

    needs_sight = True
    NEAR_ENOUGH_M = 0.05
    DOUBT_S = 2.0
    """Time for which the map must say that the place cannot be reached: what it has from one side may be wrong."""
    FLOOR_M = 0.55
    """Distance of the floor that is looked at on the way to a place that is further away."""

    def __init__(self, action: GoThere) -> None:
        self._place_m = action.place_m
        self._course: Course | None = None
        self._back_off = BackOff()
        self._hopeless_since_ns: int | None = None

    def step(self, snapshot: Snapshot) -> Plan:
        actuators = snapshot.actuators
        if self._course is None:
            self._course = Course(
                actuators.robot, actuators.config, (0.0, 0.0), arm="folded", arrive_m=self.NEAR_ENOUGH_M
            )
        place = snapshot.body.inverse().apply((*self._place_m, 0.0))
        head = self._look(snapshot, place)
        backing = self._back_off.step(snapshot, head)
        if backing is not None:
            return backing
        arm = actuators.arm.park(snapshot.angles, snapshot.dt_s)
        fields = snapshot.fields("")
        move = self._course.step(
            self._place_m, snapshot.body, snapshot.estimator.around, fields, actuators.driver, snapshot.now_ns
        )
        left_m = hypot(place[0], place[1])
        stands = self._stands(snapshot, fields, move, self._course)
        if stands is not None:
            why, state, reason = stands
            looks = state == "running" and not move.arrived
            base = actuators.gaze.turn(head, snapshot) if looks else snapshot.stand()
            return Plan(base, arm, why, head, state, reason, left_m)
        if move.look_at is not None:
            head = snapshot.look_at(snapshot.body.inverse().apply((*move.look_at, 0.0)))
        base = actuators.driver.command(move.speed_mps, move.turn_radps, snapshot.dt_s)
        return Plan(base, arm, move.why, head, distance_m=left_m)

    def _stands(self, snapshot: Snapshot, fields: Fields, move: Move, course: Course) -> tuple[str, State, str] | None:
        """Why the robot stands, with the state and the reason of the plan; None when it drives."""
        if move.arrived:
            return "there", "done" if snapshot.standing else "running", ""
        why_not = self._why_not(snapshot, fields, course)
        if why_not:
            lasts = self._lasts(snapshot.now_ns)
            return why_not, "failed" if lasts else "running", "unreachable" if lasts else ""
        self._hopeless_since_ns = None
        if move.blocked:
            return move.why, "failed", "blocked"
        if not snapshot.actuators.arm.parked(snapshot.angles):
            return "folding the arm first", "running", ""
        return None

    def _look(self, snapshot: Snapshot, place_m: Vec3) -> Aim:
        x, y, _ = place_m
        share = min(self.FLOOR_M / max(hypot(x, y), 1e-6), 1.0)
        return snapshot.look_at(place_m, (share * x, share * y, 0.0))

    def _why_not(self, snapshot: Snapshot, fields: Fields, course: Course) -> str:
        """Why the place cannot be reached by what is known now; '' when it can."""
        robot, config = snapshot.actuators.robot, snapshot.actuators.config.navigation
        need_m = robot.base.chassis_diameter_m / 2 + config.clearance_m
        away_m = float(fields.body.at(np.array([self._place_m]))[0])
        where = f"({self._place_m[0]:.2f}, {self._place_m[1]:.2f})"
        if away_m < need_m:
            return f"no room at {where}: something is {away_m:.2f} m from it, and the robot needs {need_m:.2f} m"
        return f"what stands around leaves no way to {where}" if course.walled else ""

    def _lasts(self, now_ns: int) -> bool:
        if self._hopeless_since_ns is None:
            self._hopeless_since_ns = now_ns
        return now_ns - self._hopeless_since_ns > self.DOUBT_S * NS
