"""Driving to a set distance from a target, the arm folded."""

from __future__ import annotations

from math import hypot

from cocoro.messages.actions import GoTo
from cocoro.units import Vec2
from services.planning.behaviours.base import Plan, Snapshot
from services.planning.behaviours.driving import BackOff
from services.planning.course import Course
from services.planning.navigation import offset_to


class Going:
    """Drives around obstacles until the target is straight ahead, at a distance between the centres."""

    needs_sight = True
    CREEP_MPS = 0.04
    NEAR_ENOUGH_M = 0.003
    """Tolerance of the creep at the end. The driver's own tolerance is larger, because the arm can make up for it."""

    def __init__(self, action: GoTo) -> None:
        self._label = action.label
        self._distance_m = action.distance_m
        self._course: Course | None = None
        self._back_off = BackOff()
        self._creeping = False

    def step(self, snapshot: Snapshot) -> Plan:
        actuators, config = snapshot.actuators, snapshot.actuators.config
        target = snapshot.target(self._label)
        if target is None:
            return Plan(snapshot.stand(), snapshot.still(), f"{self._label} is unknown", None, "failed", "lost")
        if self._course is None:
            self._course = Course(actuators.robot, config, (self._distance_m, 0.0), arm="folded")
        head = snapshot.look_at(target.position_m)
        backing = self._back_off.step(snapshot, head)
        if backing is not None:
            return backing
        arm = actuators.arm.park(snapshot.angles, snapshot.dt_s)
        # The arm works in the camera's frame, tilt error included; the wheels need the true place.
        x, y, _ = straight = actuators.camera_tilt.straight(target.position_m)
        place = snapshot.body.apply(straight)[:2]
        move = self._course.step(
            place,
            snapshot.body,
            snapshot.estimator.around,
            snapshot.fields(self._label),
            actuators.driver,
            snapshot.now_ns,
        )
        # The camera is blind nearby, so on the last stretch a remembered target serves for a while.
        patience_s = config.stale_target_s if move.direct else config.stale_on_way_s
        if target.age_s > patience_s + snapshot.estimator.sight_lag_s:
            why = f"{self._label} has not been seen for {target.age_s:.1f} s"
            return Plan(snapshot.stand(), snapshot.still(), why, None, "failed", "lost")
        self._creeping |= move.arrived
        if self._creeping:
            return self._creep(snapshot, Plan(snapshot.stand(), arm, "", head), (x, y))
        if move.look_at is not None:
            head = snapshot.look_at(snapshot.body.inverse().apply((*move.look_at, 0.0)))
        base = actuators.driver.command(move.speed_mps, move.turn_radps, snapshot.dt_s)
        plan = Plan(base, arm, move.why, head, distance_m=move.left_m)
        if move.blocked:
            plan.base, plan.state, plan.reason = snapshot.stand(), "failed", "blocked"
        return plan

    def _creep(self, snapshot: Snapshot, plan: Plan, place_m: Vec2) -> Plan:
        left_m = offset_to(place_m, (self._distance_m, 0.0)).ahead_m
        plan.distance_m, plan.why = abs(left_m), f"{left_m:+.3f} m to creep"
        if abs(left_m) > self.NEAR_ENOUGH_M:
            speed = min(max(2.0 * left_m, -self.CREEP_MPS), self.CREEP_MPS)
            plan.base = snapshot.actuators.driver.command(speed, 0.0, snapshot.dt_s)
        elif snapshot.standing:
            plan.state, plan.why = "done", f"{self._label} is {hypot(*place_m):.3f} m away"
        return plan
