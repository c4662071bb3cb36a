"""Idling, parking, and looking for a target."""

from __future__ import annotations

from math import atan2, hypot

import numpy as np

from cocoro.clock import NS
from cocoro.frames import Pose2
from cocoro.messages import BaseCommand
from cocoro.messages.actions import Explore, Idle, Park, Search
from services.planning.behaviours.base import Plan, Snapshot, planar_m
from services.planning.behaviours.driving import BackOff
from services.planning.course import Course
from services.planning.floor_map import CELL_M
from services.planning.head import Aim, Sweep
from services.planning.navigation import GENTLE
from services.planning.seen_floor import Rest, Viewpoint, describe


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
            plan.head = Aim(*snapshot.looks_rad, self.HEAD_RADPS)
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
        plan = Plan(snapshot.stand(), arm, "folding the arm up", Aim(0.0, 0.0, 1.5), distance_m=arm.left)
        if done:
            plan.state, plan.why = "done", "parked"
        return plan


class Searching:
    """Looks where the target was last, then at the floor that can be seen from here and that this search has not seen:
    in its first look with a sweep over the whole surroundings. A target that shows up is looked at until it is
    confirmed; with a slow perception one clear sighting does, and the approach confirms it."""

    needs_sight = True
    IN_VIEW_S = 0.2
    """Age of the newest sighting, beyond perception's own lag, up to which a target counts as in view."""

    BACK_M = 0.4
    PICTURES = 2
    """Pictures of an aim, and scans of its floor, before the head goes on; of a slow perception one picture."""
    SCANS_NS = 3 * NS // 10
    """Time in which the scans of an aim must have come."""
    UNDER_WAY_NS = NS // 10
    """Greatest age of the picture that a slow perception takes next when it is done with another."""
    STEADY_NS = NS // 30
    """Exposure of a picture, which begins only when the head rests."""
    CHECK_NS = NS // 5
    """Period at which it checks what is left to look at."""

    def __init__(self, action: Search) -> None:
        self._label = action.label
        self._start: Pose2 | None = None
        self._sweep: Sweep | None = None
        self._glances: list[Aim] | None = None
        self._rests_since_ns: int | None = None
        self._pictures = self._scans = 0
        self._newest_ns: int | None = None
        """Stamp of the newest frame that was counted as a picture of the present aim."""
        self._checked_ns: int | None = None
        self._left_m2 = 0.0
        self._looked_at_ns: int | None = None
        self._looked_from = 0
        """Number of sightings when looking at the remembered place began."""

    def step(self, snapshot: Snapshot) -> Plan:
        config = snapshot.actuators.config.head
        target = snapshot.target(self._label)
        if target is not None:
            head = snapshot.look_at(target.position_m, snapshot.floor_before(target))
            sightings = snapshot.estimator.memory.sightings(self._label)
            lag_s = snapshot.estimator.sight_lag_s
            sure = snapshot.confirmed(self._label) or (snapshot.estimator.slow_sight and snapshot.clear(target))
            if sure and target.age_s < self.IN_VIEW_S + lag_s:
                plan = snapshot.looking(f"{self._label} is in view", head, planar_m(target))
                plan.state = "done"
                return plan
            if self._looked_at_ns is None or sightings > self._looked_from:
                self._looked_at_ns, self._looked_from = snapshot.now_ns, sightings
            if snapshot.now_ns - self._looked_at_ns < (config.look_where_it_was_s + 2 * lag_s) * 1e9:
                why = f"{self._label} was seen {target.age_s:.1f} s ago: looking there"
                return snapshot.looking(why, head, planar_m(target))
        too_near = self._back_away(snapshot)
        if too_near is not None:
            return too_near
        return self._look(snapshot)

    def _look(self, snapshot: Snapshot) -> Plan:
        config, seen = snapshot.actuators.config, snapshot.estimator.seen
        gaze, lag_s = snapshot.actuators.gaze, snapshot.estimator.sight_lag_s
        if not seen.running:  # the first look, or the base restarted with a new odometry frame
            seen.begin(snapshot.body)
            self._sweep, self._glances, self._checked_ns = gaze.sweep(snapshot), None, None
        seen.stand_at(snapshot.body)
        if self._checked_ns is None or snapshot.now_ns - self._checked_ns >= self.CHECK_NS:
            first = self._checked_ns is None
            self._checked_ns = snapshot.now_ns
            cells = seen.shown(snapshot.body, *snapshot.stands_around)
            self._left_m2 = float(cells.sum()) * CELL_M**2
            if first and self._sweep is None:
                self._glances = gaze.glances(seen.bearings(cells, snapshot.body), snapshot)
        if self._left_m2 < seen.least_m2 and seen.scans:  # without a scan the floor map may be empty
            self._sweep, self._glances = None, []
        # Even slow perception must see every direction twice while the view passes over it.
        slow = 0.4 / max(lag_s, 1e-3)
        if self._sweep is not None:
            if self._pictured(snapshot, self._sweep.aim):
                self._sweep.go_on()
            if not self._sweep.done:
                why = f"sweeping for {self._label}: {self._sweep.share:.0%} done"
                return snapshot.looking(why, Aim(*self._sweep.aim, config.head.fixate_speed_radps))
            self._sweep, self._glances = None, []
        while self._glances:
            glance = self._glances[0]
            if not gaze.reached(glance[:2], snapshot):
                fast = glance.speed_radps > config.head.sweep_speed_radps
                speed = glance.speed_radps if fast else min(glance.speed_radps, slow)
                self._rests_since_ns = None
                return snapshot.looking(self._why(), glance._replace(speed_radps=speed))
            if not self._rested(snapshot, lag_s):
                return snapshot.looking(self._why(), None)
            self._glances.pop(0)
            self._rests_since_ns = None
        if self._left_m2 >= seen.least_m2 and not self._rested(snapshot, 2 * lag_s):
            return snapshot.looking(self._why(), None)
        seen.looked_from(snapshot.body, *snapshot.stands_around)
        why = f"{self._label} is not to be seen from here"
        return Plan(snapshot.stand(), snapshot.still(), why, None, "failed", "not_found")

    def _pictured(self, snapshot: Snapshot, aim: tuple[float, float]) -> bool:
        """Whether enough pictures were taken since the camera rests at an aim (pan, tilt), rad."""
        estimator = snapshot.estimator
        if not snapshot.actuators.gaze.reached(aim, snapshot):
            self._rests_since_ns = None
            return False
        if self._rests_since_ns is None:
            self._rests_since_ns, self._pictures, self._newest_ns = snapshot.now_ns, 0, estimator.looked_ns
            self._scans = estimator.seen.scans
        since_ns = self._rests_since_ns + self.STEADY_NS
        if estimator.looked_ns is not None and estimator.looked_ns != self._newest_ns:
            self._newest_ns = estimator.looked_ns
            self._pictures += estimator.looked_ns >= since_ns
        if estimator.slow_sight:
            # What perception works on now shows this aim; the result is not waited for.
            heard_ns = estimator.heard_ns
            under_way = heard_ns is not None and heard_ns >= since_ns + self.UNDER_WAY_NS
            done = under_way or self._pictures >= 1
        else:
            # Where the mount hides all floor, there is no scan to wait for.
            scanned = estimator.seen.scans - self._scans >= self.PICTURES
            done = self._pictures >= self.PICTURES and (scanned or snapshot.now_ns - since_ns > self.SCANS_NS)
        if done:
            self._rests_since_ns = None
        return done

    def _rested(self, snapshot: Snapshot, more_s: float) -> bool:
        """Whether the head has been at rest for long enough to see."""
        if self._rests_since_ns is None:
            self._rests_since_ns = snapshot.now_ns
        return (snapshot.now_ns - self._rests_since_ns) / NS >= snapshot.actuators.config.search.steady_s + more_s

    def _why(self) -> str:
        return f"looking for {self._label}: {self._left_m2:.2f} m2 to look at from here"

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
        pan, _ = snapshot.actuators.gaze.on_body(snapshot.angles)
        speed = -0.10 if abs(pan) < 0.5 else 0.0
        base = snapshot.actuators.driver.command(speed, 1.2 * pan, snapshot.dt_s)
        why = f"{self._label} is too near to be seen in depth: backing away"
        return Plan(base, snapshot.still(), why)


class Exploring:
    """Drives to the place from which the most unseen floor can be seen for the time that it takes. The next search
    looks from there. Fails with `not_found`, and with what was not seen, when there is no such place."""

    needs_sight = True
    AGAIN_NS = NS
    """Period at which it checks whether the place is still worth the way."""
    HERE_M = 0.05
    AHEAD_RAD = 0.3
    DOUBT_M = 0.5
    """Doubt of the seen floor's place from which it does not say that it has seen every place."""
    WORTH = 0.3
    """Share of the place's unseen floor that must be left."""

    def __init__(self, action: Explore) -> None:
        self._label = action.label
        self._time_is_up = action.time_is_up
        self._course: Course | None = None
        self._view: Viewpoint | None = None
        self._checked_ns = 0
        self._back_off = BackOff()

    def step(self, snapshot: Snapshot) -> Plan:
        actuators, seen = snapshot.actuators, snapshot.estimator.seen
        if not seen.running:
            return self._without_search(snapshot)
        if self._time_is_up:
            rest = seen.rest(*snapshot.stands_around)
            why = f"time is up; {self._label} was not found{_not_seen(rest, snapshot.body)}"
            return Plan(snapshot.stand(), snapshot.still(), why, None, "failed", "not_found")
        if self._in_view(snapshot):
            return Plan(snapshot.stand(), snapshot.still(), f"{self._label} came into view", state="done")
        seen.stand_at(snapshot.body)
        fields = snapshot.fields("")
        if self._view is None:
            navigation = actuators.config.navigation
            radius = actuators.robot.base.chassis_diameter_m / 2 + navigation.clearance_m
            around = snapshot.estimator.around
            routes = around.routes(fields.body, snapshot.body, radius, navigation.comfort_m)
            # The routes' way out of a narrow place is no place to stay: the course would find no pose there.
            costs = np.where(fields.body.metres >= radius, routes.costs(), np.inf)
            self._view = seen.viewpoint(snapshot.body, costs, *snapshot.stands_around)
            self._checked_ns = snapshot.now_ns
            if self._view is None:
                return Plan(
                    snapshot.stand(), snapshot.still(), self._nothing_left(snapshot), None, "failed", "not_found"
                )
        if self._course is None:
            self._course = Course(actuators.robot, actuators.config, (0.0, 0.0), arm="folded", arrive_m=0.12)
        place = snapshot.body.inverse().apply((*self._view.middle_m, 0.0))
        head = snapshot.look_at(place)
        if hypot(self._view.place_m[0] - snapshot.body.x_m, self._view.place_m[1] - snapshot.body.y_m) < self.HERE_M:
            return self._turn(snapshot, atan2(place[1], place[0]), head)
        backing = self._back_off.step(snapshot, head)
        if backing is not None:
            return backing
        move = self._course.step(
            self._view.place_m, snapshot.body, snapshot.estimator.around, fields, actuators.driver, snapshot.now_ns
        )
        arm = actuators.arm.park(snapshot.angles, snapshot.dt_s)
        if not actuators.arm.parked(snapshot.angles):
            move = move._replace(speed_mps=0.0, turn_radps=0.0)
        if move.look_at is not None:
            head = snapshot.look_at(snapshot.body.inverse().apply((*move.look_at, 0.0)))
        base = self._drive(snapshot, move.speed_mps, move.turn_radps)
        why = f"going where {self._view.gain_m2:.2f} m2 of unseen floor can be seen: {move.why}"
        plan = Plan(base, arm, why, head, distance_m=move.left_m)
        if move.blocked:
            seen.avoid(self._view.place_m)
        if move.blocked or move.arrived or not self._worth_it(snapshot):
            plan.state = "done"
        return plan

    def _without_search(self, snapshot: Snapshot) -> Plan:
        """Let the search begin anew: the planner or the base restarted, so what was seen before is not known."""
        if self._time_is_up:
            why = f"time is up; {self._label} was not found; which floor was seen is not known after a restart"
            return Plan(snapshot.stand(), snapshot.still(), why, None, "failed", "not_found")
        return Plan(snapshot.stand(), snapshot.still(), "the search begins anew", state="done")

    def _turn(self, snapshot: Snapshot, bearing_rad: float, head: Aim) -> Plan:
        arm = snapshot.actuators.arm.park(snapshot.angles, snapshot.dt_s)
        turn = 1.8 * bearing_rad if snapshot.actuators.arm.parked(snapshot.angles) else 0.0
        base = self._drive(snapshot, 0.0, turn)
        hider = snapshot.actuators.gaze.hidden_by
        plan = Plan(base, arm, f"turning to look where {hider} hides the floor: {bearing_rad:+.2f} rad", head)
        if abs(bearing_rad) < self.AHEAD_RAD:
            plan.state = "done"
        return plan

    @staticmethod
    def _drive(snapshot: Snapshot, speed_mps: float, turn_radps: float) -> BaseCommand:
        """A command on the same arc, slow enough that the scans on the way correct the body's pose."""
        search = snapshot.actuators.config.search
        excess = max(abs(speed_mps) / search.max_speed_mps, abs(turn_radps) / search.max_turn_radps, 1.0)
        driver = snapshot.actuators.driver
        return driver.command(speed_mps / excess, turn_radps / excess, snapshot.dt_s, pace=GENTLE)

    def _in_view(self, snapshot: Snapshot) -> bool:
        target = snapshot.target(self._label)
        fresh_s = Searching.IN_VIEW_S + snapshot.estimator.sight_lag_s
        return target is not None and target.age_s < fresh_s and snapshot.confirmed(self._label)

    def _worth_it(self, snapshot: Snapshot) -> bool:
        assert self._view is not None
        if snapshot.now_ns - self._checked_ns < self.AGAIN_NS:
            return True
        self._checked_ns = snapshot.now_ns
        cells = snapshot.estimator.seen.visible(self._view.place_m, *snapshot.stands_around)
        return float(cells.sum()) * CELL_M**2 >= self.WORTH * self._view.gain_m2

    def _nothing_left(self, snapshot: Snapshot) -> str:
        rest = snapshot.estimator.seen.rest(*snapshot.stands_around)
        if rest.patches:
            return f"{self._label} was not found; nowhere else to look from{_not_seen(rest, snapshot.body)}"
        radius_m = snapshot.actuators.config.search.radius_m
        enclosed = f", except {rest.enclosed_m2:.2f} m2 that obstacles enclose" if rest.enclosed_m2 >= 0.01 else ""
        doubt_m = 2 * snapshot.estimator.seen.doubt_m(*snapshot.stands_around)
        if doubt_m > self.DOUBT_M:
            return (
                f"{self._label} was not found within {radius_m:.1f} m{enclosed}, but the robot knew its place only to"
                f" {doubt_m:.1f} m, so some floor may have been missed"
            )
        return (
            f"every place within {radius_m:.1f} m where {self._label} could stand was seen{enclosed}; it is not there"
        )


def _not_seen(rest: Rest, body: Pose2) -> str:
    return f": not seen were {describe(rest, body)}" if rest.patches else ""
