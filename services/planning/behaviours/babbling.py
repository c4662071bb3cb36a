"""Babbling: movements to learn from. The arm moves from draw to draw, the wheels in pairs of trials."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from math import hypot, sin

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.clock import NS
from cocoro.core import Output
from cocoro.frames import Pose2
from cocoro.messages import BaseCommand, HandSample, WheelTrial
from cocoro.messages.actions import BabbleArm, BabbleWheels
from cocoro.topics import HAND_SAMPLES, WHEEL_TRIALS
from cocoro.units import Vec2, Vec3
from services.planning.behaviours.base import Plan, Snapshot
from services.planning.head import Aim
from services.planning.postures import Postures, sobol
from services.planning.reach import HandPose


class ArmBabbling:
    """Moves the arm from draw to draw and reports a sample wherever the hand's marker is seen.

    The next draw is one that is safe and visible by the nominal model, and that a straight, safe way leads to. When
    none of many draws is, the arm goes back the way it came. At the end it goes home, from where it can be folded.
    """

    needs_sight = True
    SPEED_RADPS = 0.7
    EVERY_NS = NS // 10
    """Shortest time between two samples; earlier sightings are nearly the same."""
    LOOKS_A_STEP = 2
    """Draws that are examined in one step; each takes up to a few milliseconds."""
    GIVE_UP = 60
    """Number of draws without a clear way after which the arm goes back."""
    NOWHERE = 3000
    """Number of draws without one, at home, after which the camera counts as one that never sees the marker."""

    def __init__(self, action: BabbleArm) -> None:
        self._first = first = action.first
        self._count = action.count
        self._samples = 0
        self._draws: Iterator[tuple[int, FloatArray]] | None = None
        self._draw = first
        self._looked = 0
        self._postures: Postures | None = None
        self._goal: FloatArray | None = None
        self._trail: list[FloatArray] = []
        """Postures from home to the current one, each with a clear way to the next."""
        self._returning = False
        self._last_ns: int | None = None
        self._hitches = 0

    def step(self, snapshot: Snapshot) -> Plan:
        actuators = snapshot.actuators
        if actuators.robot.marker is None:
            why = "the hand has no marker to look at"
            return Plan(snapshot.stand(), snapshot.still(), why, None, "failed", "not_able")
        if self._postures is None:
            self._postures = Postures(actuators.robot, actuators.gaze)
            self._draws = sobol(self._first, self._postures.ranges)
        if not self._trail:
            return self._unfold(snapshot)
        reports = self._report(snapshot)
        arm = snapshot.actuators.arm
        if self._goal is None:
            self._choose(snapshot)
        if self._goal is None and self._looked > self.NOWHERE:
            why = "the camera would see the marker in no posture that the arm can come to"
            return Plan(snapshot.stand(), snapshot.still(), why, None, "failed", "not_able", reports=reports)
        if self._goal is None:
            step = snapshot.still()
        else:
            goal = dict(zip(snapshot.actuators.robot.arm.joints, self._goal.tolist(), strict=True))
            step = arm.towards(goal, self.SPEED_RADPS, snapshot.angles, snapshot.dt_s)
        head = snapshot.look_at(self._postures.marker_m(snapshot.angles))
        why = f"{self._samples} of {self._count} samples, draw {self._draw}"
        plan = Plan(snapshot.stand(), step, why, head, reports=reports)
        if step.blocked or arm.stalled:
            self._hitch(plan, snapshot)
        elif self._goal is not None and step.arrived:
            self._arrive(plan)
        if self._samples >= self._count:
            self._returning = True
        return plan

    def _unfold(self, snapshot: Snapshot) -> Plan:
        """Move to the home posture, also from a posture of an earlier babbling."""
        actuators, travel = snapshot.actuators, snapshot.actuators.config.arm
        home = HandPose(travel.travel_radius_m, 0.0, travel.travel_height_m, travel.pitch_rad)
        step = actuators.arm.reach(home, travel.hand_speed_mps, snapshot.angles, snapshot.dt_s)
        plan = Plan(snapshot.stand(), step, "unfolding the arm")
        if step.blocked or actuators.arm.stalled:
            plan.state, plan.reason, plan.why = "failed", "blocked", "something is in the arm's way"
        elif step.arrived:
            self._trail = [step.goal_rad]
        return plan

    def _choose(self, snapshot: Snapshot) -> None:
        """Choose the next goal; leave it open when no draw of this step is suitable."""
        assert self._draws is not None
        assert self._postures is not None
        here = self._trail[-1]
        if self._returning:
            self._go_home(here)
            return
        for _ in range(self.LOOKS_A_STEP):
            self._draw, posture = next(self._draws)
            self._looked += 1
            postures = self._postures
            if postures.safe(posture) and postures.seeable(posture) and postures.clear_way(here, posture):
                self._goal, self._looked = posture, 0
                return
        if self._looked > self.GIVE_UP and len(self._trail) > 1:
            self._trail.pop()
            self._goal, self._looked = self._trail.pop(), 0

    def _go_home(self, here: FloatArray) -> None:
        """Go straight home where there is a clear way, otherwise back along the trail."""
        assert self._postures is not None
        home = self._trail[0]
        if len(self._trail) <= 2 or self._postures.clear_way(here, home):
            self._trail, self._goal = [home], home
        else:
            self._trail.pop()
            self._goal = self._trail.pop()

    def _arrive(self, plan: Plan) -> None:
        assert self._goal is not None
        if self._returning and len(self._trail) == 1 and np.array_equal(self._goal, self._trail[0]):
            plan.state, plan.why = "done", f"{self._samples} samples"
            return
        self._trail.append(self._goal)
        self._goal = None

    def _hitch(self, plan: Plan, snapshot: Snapshot) -> None:
        """Go back to the last posture: the way is less clear than the nominal model has it."""
        self._hitches += 1
        snapshot.actuators.arm.resync()
        self._goal = self._trail[-1]
        if self._hitches > 20:
            plan.state, plan.reason, plan.why = "failed", "blocked", "the arm is held up again and again"

    def _report(self, snapshot: Snapshot) -> list[Output]:
        """Samples from the hand's sightings since the last step, without those that are nearly the same."""
        found: list[Output] = []
        for sight in snapshot.estimator.sightings_of(snapshot.actuators.config.marker):
            new = self._last_ns is None or sight.stamp_ns - self._last_ns >= self.EVERY_NS
            robot = snapshot.actuators.robot
            level = abs(sight.angles_rad[robot.arm.roll] - robot.claw.level_roll_rad) < 0.03
            if new and level and self._samples < self._count:
                self._last_ns = sight.stamp_ns
                self._samples += 1
                sample = HandSample(
                    stamp_ns=sight.stamp_ns,
                    draw=self._draw,
                    angles_rad=sight.angles_rad,
                    seen_m=sight.position_m,
                    area_px=sight.area_px,
                )
                found.append(Output(HAND_SAMPLES, sample))
        return found


class WheelBabbling:
    """Carries out pairs of trials (the paper's): both wheels turn for a time at drawn speeds, then for the same time at
    the opposite speeds. Before and after each trial the standing robot looks at a standing target.

    The head comes to every look from the same side, so that its backlash cancels out.
    """

    needs_sight = True
    SPEED_MPS = 0.15
    TURN_S = 1.0
    LOOKS = 8
    """Number of frames of one look."""
    AWAY_RAD = (0.12, 0.08)
    """Offset in pan and tilt from which the head comes to each look."""
    AWAY_S, SETTLE_S = 0.35, 0.45
    LOST_S = 4.0
    LEAST_TURN_RAD = 0.2
    """A draw that turns the robot less is skipped."""
    MOVED_M = 0.5
    """Largest distance from where it began."""

    def __init__(self, action: BabbleWheels) -> None:
        self._label, first = action.label, action.first
        self._count = action.count
        self._done = 0
        speeds = np.array([[-self.SPEED_MPS, self.SPEED_MPS]] * 2)
        self._draws = sobol(first // 2, speeds)
        self._trial = first - first % 2
        self._speeds = (0.0, 0.0)
        self._phase_ns: int | None = None
        self._driving = False
        self._gaze: tuple[float, float] | None = None
        self._seen: deque[Vec3] = deque(maxlen=self.LOOKS)
        self._before: tuple[Vec2, Pose2] | None = None
        self._begun: Pose2 | None = None

    def step(self, snapshot: Snapshot) -> Plan:
        if not snapshot.actuators.gaze.joints:
            why = "the camera is fixed on the body, so it does not keep its target in sight while the wheels turn"
            return Plan(snapshot.stand(), snapshot.still(), why, None, "failed", "not_able")
        self._begun = self._begun or snapshot.body
        kind = snapshot.actuators.robot.base.kind
        if kind != "differential":
            why = f"a base of the kind {kind!r} has no two wheels whose distance is to be learned"
            return Plan(snapshot.stand(), snapshot.still(), why, None, "failed", "unreachable")
        snapshot.estimator.watch(self._label)
        sightings = snapshot.estimator.sightings_of(self._label)
        if self._phase_ns is None:
            self._phase_ns = snapshot.now_ns
        spent_s = (snapshot.now_ns - self._phase_ns) / NS
        why = f"{self._done} of {self._count} trials"
        if self._driving:
            plan = Plan(self._drive(snapshot, spent_s), snapshot.still(), why, self._look_there(snapshot))
        else:
            plan = self._look(snapshot, spent_s, why, [s.position_m for s in sightings])
        base = snapshot.estimator.base
        if base is not None and (base.bump_left or base.bump_right):
            plan.base = snapshot.stand()
            plan.state, plan.reason, plan.why = "failed", "blocked", "the bumper touches something"
        elif self._begun.inverse().compose(snapshot.body).x_m ** 2 > self.MOVED_M**2:
            plan.base = snapshot.stand()
            plan.state, plan.reason, plan.why = "failed", "blocked", "it has gone too far from where it began"
        return plan

    def _drive(self, snapshot: Snapshot, spent_s: float) -> BaseCommand:
        if spent_s < self.TURN_S:
            return snapshot.actuators.robot.drive.command_of(self._speeds)
        snapshot.actuators.driver.reset()
        if snapshot.standing:
            self._driving, self._phase_ns = False, None
        return BaseCommand(ahead_mps=0.0, turn_radps=0.0)

    def _look_there(self, snapshot: Snapshot) -> Aim | None:
        target = snapshot.target(self._label)
        return None if target is None else snapshot.look_at(target.position_m)

    def _look(self, snapshot: Snapshot, spent_s: float, why: str, places: list[tuple[float, float, float]]) -> Plan:
        """Turn the head away and back to the target, wait, and collect the frames."""
        plan = Plan(snapshot.stand(), snapshot.still(), why)
        if spent_s < self.AWAY_S or self._gaze is None:
            gaze = self._look_there(snapshot)
            if gaze is None:
                plan.state, plan.reason, plan.why = "failed", "lost", f"{self._label} is out of sight"
                return plan
            self._gaze = gaze[:2]
            self._seen.clear()
            plan.head = Aim(gaze[0] + self.AWAY_RAD[0], gaze[1] + self.AWAY_RAD[1], 2.0)
            return plan
        plan.head = Aim(*self._gaze, 2.0)
        if spent_s < self.AWAY_S + self.SETTLE_S:
            return plan
        self._seen.extend(places)
        if len(self._seen) == self.LOOKS:
            self._looked(snapshot, plan)
        elif spent_s > self.LOST_S + self.LOOKS * snapshot.estimator.sight_lag_s:
            plan.state, plan.reason, plan.why = "failed", "lost", f"{self._label} is out of sight"
        return plan

    def _looked(self, snapshot: Snapshot, plan: Plan) -> None:
        """Complete a look: it ends one trial and begins the next."""
        x, y, height_m = np.median(np.array(self._seen), axis=0).tolist()
        after = (x, y)
        if self._before is not None:
            before, start = self._before
            moved = start.inverse().compose(snapshot.body)
            half = moved.yaw_rad / 2
            # Way along the arc, from its chord; negative when the chord points backwards.
            arc_per_chord = half / sin(half) if abs(half) > 1e-6 else 1.0
            way_m = hypot(moved.x_m, moved.y_m) * arc_per_chord * (1.0 if moved.x_m >= 0 else -1.0)
            trial = WheelTrial(
                trial=self._trial,
                left_mps=self._speeds[0],
                right_mps=self._speeds[1],
                way_m=way_m,
                turned_rad=moved.yaw_rad,
                before_m=before,
                after_m=after,
                height_m=height_m,
            )
            plan.reports.append(Output(WHEEL_TRIALS, trial))
            self._done += 1
            self._trial += 1
            if self._done >= self._count:
                plan.state, plan.why = "done", f"{self._done} trials"
                return
        left, right = -self._speeds[0], -self._speeds[1]
        if self._trial % 2 == 0:
            left, right = self._draw(snapshot)
        self._speeds = (left, right)
        self._before = (after, snapshot.body)
        self._gaze, self._phase_ns, self._driving = None, snapshot.now_ns, True

    def _draw(self, snapshot: Snapshot) -> tuple[float, float]:
        """Wheel speeds of the next pair, m/s: those of the next draw that turns the robot far enough."""
        for number, speeds in self._draws:
            left, right = speeds.tolist()
            if abs(right - left) * self.TURN_S > self.LEAST_TURN_RAD * snapshot.actuators.robot.base.axle_m:
                self._trial = 2 * number
                return left, right
        raise AssertionError("draws have no end")
