"""Idling, parking, and looking for a target."""

from __future__ import annotations

from math import atan2

from cocoro.clock import NS
from cocoro.frames import Pose2
from cocoro.messages.actions import Explore, Idle, Park, Search
from services.planning.behaviours.base import Plan, Snapshot, planar_m
from services.planning.course import Course
from services.planning.floor_map import CELL_M, SIZE
from services.planning.head import PAN, TILT, Sweep


class Idling:
    """Stands still and holds everything as it is: also a head and claws that the task before had sent somewhere."""

    needs_sight = False
    HEAD_RADPS = 1.0

    def __init__(self, action: Idle, why: str = "nothing is asked") -> None:
        self._why = why
        self._halted = False

    def step(self, snapshot: Snapshot) -> Plan:
        plan = Plan(snapshot.actuators.driver.halt(), snapshot.still(), self._why, state="done")
        hand = snapshot.estimator.hand
        if not self._halted and hand is not None:
            self._halted = True
            snapshot.actuators.grip.halt(hand)
            plan.head = (snapshot.angles[PAN], snapshot.angles[TILT], self.HEAD_RADPS)
        return plan


class Parking:
    """Folds the arm and looks ahead."""

    needs_sight = False

    def __init__(self, action: Park) -> None:
        pass

    def step(self, snapshot: Snapshot) -> Plan:
        arm = snapshot.actuators.arm.park(snapshot.angles, snapshot.dt_s)
        if arm.blocked:
            return Plan(snapshot.stand(), arm, "the way to the park pose is blocked", None, "failed", "blocked")
        done = arm.arrived and snapshot.actuators.arm.parked(snapshot.angles)
        plan = Plan(snapshot.stand(), arm, "folding the arm up", (0.0, 0.0, 1.5), distance_m=arm.left)
        if done:
            plan.state, plan.why = "done", "parked"
        return plan


class Searching:
    """Looks where the target was last, then sweeps the head over the whole surroundings. A target that shows up in the
    sweep is looked at until it is confirmed."""

    needs_sight = True
    CONFIRMED = 2
    IN_VIEW_S = 0.2
    """Age of the newest sighting, beyond perception's own lag, up to which a target counts as in view."""

    BACK_M = 0.4

    def __init__(self, action: Search) -> None:
        self._label = action.label
        self._start: Pose2 | None = None
        self._sweep: Sweep | None = None
        self._looked_at_ns: int | None = None
        self._looked_from = 0
        """Number of sightings when looking at the remembered place began."""

    def step(self, snapshot: Snapshot) -> Plan:
        config = snapshot.actuators.config.head
        target = snapshot.target(self._label)
        base, arm = snapshot.stand(), snapshot.still()
        if target is not None:
            head = snapshot.look_at(target.position_m)
            sightings = snapshot.estimator.memory.sightings(self._label)
            lag_s = snapshot.estimator.sight_lag_s
            if sightings >= self.CONFIRMED and target.age_s < self.IN_VIEW_S + lag_s:
                return Plan(base, arm, f"{self._label} is in view", head, "done", distance_m=planar_m(target))
            if self._looked_at_ns is None or sightings > self._looked_from:
                self._looked_at_ns, self._looked_from = snapshot.now_ns, sightings
            if snapshot.now_ns - self._looked_at_ns < (config.look_where_it_was_s + 2 * lag_s) * 1e9:
                why = f"{self._label} was seen {target.age_s:.1f} s ago: looking there"
                return Plan(base, arm, why, head, distance_m=planar_m(target))
        too_near = self._back_away(snapshot)
        if too_near is not None:
            return too_near
        pan, tilt = snapshot.angles[PAN], snapshot.angles[TILT]
        if self._sweep is None:
            self._sweep = Sweep(config, pan)
        goal = self._sweep.next(pan, tilt)
        # Even slow perception must see every direction twice while the view passes over it.
        speed = min(config.sweep_speed_radps, 0.4 / max(snapshot.estimator.sight_lag_s, 1e-3))
        head = (*goal, speed)
        if self._sweep.done:
            why = f"the whole surroundings were searched, {self._label} is not there"
            return Plan(base, arm, why, head, "failed", "not_found")
        return Plan(base, arm, f"sweeping for {self._label}: {self._sweep.share:.0%} done", head)

    def _back_away(self, snapshot: Snapshot) -> Plan | None:
        """Back away from a target that is too near for the depth camera; None when there is none."""
        stamp_ns, note = snapshot.estimator.unlocalised.get(self._label, (0, ""))
        fresh = snapshot.now_ns - stamp_ns < (0.5 + snapshot.estimator.sight_lag_s) * NS
        if not fresh or note != "no depth" or snapshot.target(self._label) is not None:
            return None
        if self._start is None:
            self._start = snapshot.body
        gone = self._start.inverse().compose(snapshot.body)
        if gone.x_m < -self.BACK_M:
            return None
        pan = snapshot.angles[PAN]
        speed = -0.10 if abs(pan) < 0.5 else 0.0
        base = snapshot.actuators.driver.command(speed, 1.2 * pan, snapshot.dt_s)
        why = f"{self._label} is too near to be seen in depth: backing away"
        return Plan(base, snapshot.still(), why)


class Exploring:
    """Drives to the place from which most of the hidden floor can be seen; the next search begins there."""

    needs_sight = True
    NEAR_M, FAR_M = 0.5, 1.6
    SIGHT_M = 1.5

    def __init__(self, action: Explore) -> None:
        self._label = action.label
        self._course: Course | None = None
        self._goal: tuple[float, float] | None = None

    def step(self, snapshot: Snapshot) -> Plan:
        actuators = snapshot.actuators
        fields = snapshot.fields("")
        if self._goal is None:
            self._goal = self._viewpoint(snapshot)
            if self._goal is None:
                return Plan(snapshot.stand(), snapshot.still(), "there is nowhere else to look from", state="done")
        if self._course is None:
            self._course = Course(actuators.robot, actuators.config, (0.0, 0.0), arm="folded", arrive_m=0.12)
        target = snapshot.target(self._label)
        if (
            target is not None
            and target.age_s < 0.3
            and snapshot.estimator.memory.sightings(self._label) >= Searching.CONFIRMED
        ):
            return Plan(snapshot.stand(), snapshot.still(), f"{self._label} came into view", state="done")
        arm = actuators.arm.park(snapshot.angles, snapshot.dt_s)
        move = self._course.step(
            self._goal, snapshot.body, snapshot.estimator.around, fields, actuators.driver, snapshot.now_ns
        )
        if not actuators.arm.parked(snapshot.angles):
            move = move._replace(speed_mps=0.0, turn_radps=0.0)
        base = actuators.driver.command(move.speed_mps, move.turn_radps, snapshot.dt_s)
        place = move.look_at or self._goal
        head = snapshot.look_at(snapshot.body.inverse().apply((*place, 0.0)))
        plan = Plan(base, arm, f"going to look from elsewhere: {move.why}", head, distance_m=move.left_m)
        if move.blocked or (move.arrived and snapshot.standing):
            # Also a place on the way serves as a viewpoint.
            plan.state = "done"
        return plan

    def _viewpoint(self, snapshot: Snapshot) -> tuple[float, float] | None:
        """The reachable place with the most unseen floor nearby, odometry frame, m; None when there is none."""
        around, actuators = snapshot.estimator.around, snapshot.actuators
        navigation = actuators.config.navigation
        fields = snapshot.fields("")
        radius = actuators.robot.base.chassis_diameter_m / 2 + navigation.clearance_m
        routes = around.routes(fields.body, snapshot.body, radius, navigation.comfort_m)
        unseen = ~around.floor.looked_at()
        best: tuple[float, tuple[float, float]] | None = None
        for row in range(0, SIZE, 4):
            for column in range(0, SIZE, 4):
                x, y = around.floor.centre(row, column)
                cost = routes.cost(x, y)
                if not self.NEAR_M <= cost <= self.FAR_M:
                    continue
                reach = round(self.SIGHT_M / CELL_M)
                hidden = unseen[max(row - reach, 0) : row + reach, max(column - reach, 0) : column + reach].sum()
                turn = abs(atan2(y - snapshot.body.y_m, x - snapshot.body.x_m))
                gain = float(hidden) * CELL_M**2 - cost - 0.05 * turn
                if best is None or gain > best[0]:
                    best = gain, (x, y)
        return best[1] if best is not None else None
