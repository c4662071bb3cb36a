"""Touching: brings the open hand around a target within the arm's reach."""

from __future__ import annotations

from cocoro.clock import NS
from cocoro.frames import Spherical, to_spherical, wrap_rad
from cocoro.messages.actions import Reach, Touch
from services.planning.behaviours.base import Plan, Snapshot, hand_place
from services.planning.behaviours.handling import Reaching
from services.planning.reach import HandPose

REACHED = Spherical(0.02, 0.034, 0.034)
"""The paper's limits of the distance between hand and target in egocentric coordinates: m, rad, rad."""


class Touching:
    """Backs the hand out, then brings it behind the target and around it; the base stands. The target is reached when
    hand and target are in one place, as the robot sees and feels them, within the paper's limits."""

    needs_sight = False
    IN_VIEW_S = 0.2
    LOOK_S = 1.5

    def __init__(self, action: Touch) -> None:
        self._label = action.label
        self._reach = Reaching(Reach(action.label), touching=True)
        self._back: HandPose | None = None
        self._begun = False
        self._seen = False
        self._looking_since_ns: int | None = None

    def step(self, snapshot: Snapshot) -> Plan:
        actuators, config = snapshot.actuators, snapshot.actuators.config.arm
        reference = actuators.arm.reference or snapshot.angles
        if not self._begun:
            self._begun = True
            have = actuators.reacher.pose({**snapshot.angles, **reference})
            if not actuators.arm.folded(reference) and have.radius_m > actuators.reachability.retreat_m + 0.02:
                self._back = have._replace(radius_m=actuators.reachability.retreat_m, pitch_rad=config.pitch_rad)
        if self._back is not None:
            return self._back_out(snapshot, self._back)
        plan = self._look(snapshot) or self._reach.step(snapshot)
        if plan.state == "done":
            self._judge(snapshot, plan)
        return plan

    def _back_out(self, snapshot: Snapshot, goal: HandPose) -> Plan:
        """Back the hand out along its own axis, from around the previous target."""
        actuators, config = snapshot.actuators, snapshot.actuators.config.arm
        actuators.grip.open()
        step = actuators.arm.reach(goal, config.hand_speed_mps, snapshot.angles, snapshot.dt_s)
        target = snapshot.target(self._label)
        head = snapshot.look_at(target.position_m) if target is not None else None
        plan = Plan(snapshot.stand(), step, "backing the hand out first", head, distance_m=step.left)
        if step.left < Reaching.CLOSE_IN_M:
            self._back = None
        elif step.blocked:
            plan.state, plan.reason, plan.why = "failed", "blocked", "the hand's way out is blocked"
        return plan

    def _look(self, snapshot: Snapshot) -> Plan | None:
        """Wait for a limited time for a target that the hand has hidden; None once it is in view."""
        target, lag_s = snapshot.target(self._label), snapshot.estimator.sight_lag_s
        if target is None or self._seen or target.age_s < self.IN_VIEW_S + lag_s:
            self._seen = True
            return None
        if self._looking_since_ns is None:
            self._looking_since_ns = snapshot.now_ns
        if snapshot.now_ns - self._looking_since_ns > (self.LOOK_S + lag_s) * NS:
            return None
        return Plan(
            snapshot.stand(), snapshot.still(), f"looking at {self._label}", snapshot.look_at(target.position_m)
        )

    def _judge(self, snapshot: Snapshot, plan: Plan) -> None:
        """Report `done` only when the hand has come to the commanded pose."""
        goal = self._reach.goal
        assert goal is not None
        x, y, z = snapshot.actuators.reacher.point(goal).tolist()
        want, have = to_spherical((x, y, z)), to_spherical(hand_place(snapshot))
        turn_rad, rise_rad = wrap_rad(have.azimuth_rad - want.azimuth_rad), have.elevation_rad - want.elevation_rad
        gap = Spherical(have.rho_m - want.rho_m, turn_rad, rise_rad)
        if all(abs(value) <= limit for value, limit in zip(gap, REACHED, strict=True)):
            plan.why = f"{self._label} is reached"
        else:
            plan.state = "running"
            plan.why = f"the hand is {gap.rho_m:+.3f} m, {turn_rad:+.3f} and {rise_rad:+.3f} rad off"
