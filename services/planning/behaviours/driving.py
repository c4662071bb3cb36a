"""Driving behaviours: to a target, and with something in the hand to a place."""

from __future__ import annotations

from math import cos, hypot, sin

from cocoro.clock import NS
from cocoro.frames import Pose2
from cocoro.messages import BaseState, TargetEstimate
from cocoro.messages.actions import Approach, Carry
from services.planning.arm import ArmStep
from services.planning.behaviours.base import Actuators, Plan, Snapshot, hand_place
from services.planning.course import Course, Move
from services.planning.head import Aim
from services.planning.navigation import GENTLE, PREVIEW_S, offset_to
from services.planning.reach import HandPose
from services.planning.surroundings import Fields


def grasp_aim(actuators: Actuators) -> tuple[float, float]:
    """Best place of a target for the arm, body frame, m."""
    x, y, _ = actuators.reacher.point(HandPose(actuators.config.arm.grasp_radius_m, 0.0, 0.0, 0.0)).tolist()
    return x, y


class BackOff:
    """Reaction to a bump: enters the obstacle in the map and backs away from it."""

    BACK_M = 0.12
    MAX_BUMPS = 3

    def __init__(self) -> None:
        self._from: Pose2 | None = None
        self._bumps = 0

    def step(self, snapshot: Snapshot, head: Aim) -> Plan | None:
        """The plan that backs off; None when there is no bump."""
        base = snapshot.estimator.base
        if base is not None and (base.bump_left or base.bump_right) and self._from is None:
            self._from = snapshot.body
            self._bumps += 1
            snapshot.estimator.around.floor.bump(self.touched(snapshot, base))
        if self._from is None:
            return None
        if self._bumps > self.MAX_BUMPS:
            why = "the bumper touches something again and again"
            return Plan(snapshot.stand(), snapshot.still(), why, head, "failed", "blocked")
        if self._from.inverse().compose(snapshot.body).x_m <= -self.BACK_M:
            self._from = None
            return None
        command = snapshot.actuators.driver.command(-0.08, 0.0, snapshot.dt_s)
        return Plan(command, snapshot.still(), "the bumper touched something: backing off", head)

    @staticmethod
    def touched(snapshot: Snapshot, base: BaseState) -> list[tuple[float, float]]:
        """Where the pressed bumper touches something, odometry frame, m."""
        radius = snapshot.actuators.robot.base.chassis_diameter_m / 2 + 0.02
        bearings = [b for b, hit in ((0.6, base.bump_left), (-0.6, base.bump_right)) if hit]
        if base.bump_left and base.bump_right:
            bearings.append(0.0)
        places = [snapshot.body.apply((radius * cos(b), radius * sin(b), 0.0)) for b in bearings]
        return [(x, y) for x, y, _ in places]


class Approaching:
    """Drives around obstacles to where the arm reaches the target. On the last stretch the hand gets ready and comes
    down behind the target before the robot is near, so that it never comes down on it."""

    needs_sight = True

    def __init__(self, action: Approach) -> None:
        self._label = action.label
        self._course: Course | None = None
        self._back_off = BackOff()
        self._stalls = 0
        self._glance_since_ns: int | None = None
        self._unsure_since_ns: int | None = None

    def step(self, snapshot: Snapshot) -> Plan:
        actuators, config = snapshot.actuators, snapshot.actuators.config
        target = snapshot.target(self._label)
        if self._course is None:
            self._course = Course(
                actuators.robot, config, grasp_aim(actuators), arm="last", swing_m=actuators.unfolding
            )
        if target is None:
            return Plan(snapshot.stand(), snapshot.still(), f"{self._label} is unknown", None, "failed", "lost")
        fields = snapshot.fields(self._label)
        head = snapshot.look_at(target.position_m, snapshot.floor_before(target))
        backing = self._back_off.step(snapshot, head)
        if backing is not None:
            return backing
        place = target.odometry_position_m[:2]
        folded = actuators.arm.folded(actuators.arm.reference or snapshot.angles)
        move = self._course.step(
            place, snapshot.body, snapshot.estimator.around, fields, actuators.driver, snapshot.now_ns, folded=folded
        )
        patience_s = config.stale_target_s if move.direct else config.stale_on_way_s
        if target.age_s > patience_s + snapshot.estimator.sight_lag_s:
            why = f"{self._label} has not been seen for {target.age_s:.1f} s"
            return Plan(snapshot.stand(), snapshot.still(), why, None, "failed", "lost")
        if actuators.arm.stalled:
            self._touched(snapshot)
        if self._stalls > self.MAX_STALLS:
            why = "the arm is held up again and again"
            return Plan(snapshot.stand(), snapshot.still(), why, head, "failed", "blocked")
        arm, move = self._ready_hand(snapshot, target, move, fields)
        if move.look_at is not None:
            place_m = snapshot.body.inverse().apply((*move.look_at, 0.0))
            head = snapshot.look_at(place_m, target.position_m, snapshot.floor_before(target))
        if move.blocked:
            return Plan(snapshot.stand(), arm, move.why, head, "failed", "blocked")
        if arm.blocked:
            return Plan(
                snapshot.stand(), arm, "the hand cannot get ready: its way is blocked", head, "failed", "blocked"
            )
        base = actuators.driver.command(move.speed_mps, move.turn_radps, snapshot.dt_s)
        there = move.arrived or (move.direct and actuators.ready_on_the_way and self._coasts_there(snapshot, target))
        if there and self._unsure(snapshot, target):
            return Plan(base, arm, "there; waiting to see where exactly it is", head, distance_m=move.left_m)
        if there and arm.arrived and (actuators.ready_on_the_way or snapshot.standing):
            return Plan(base, arm, f"{self._label} is in reach", head, "done", distance_m=move.left_m)
        why = "there; waiting for base and hand to come to rest" if move.arrived else move.why
        return Plan(base, arm, why, head, distance_m=move.left_m)

    UNSURE_S = 1.0

    def _unsure(self, snapshot: Snapshot, target: TargetEstimate) -> bool:
        """Whether the target must be seen again before the hand reaches for it; for a limited time, because the hand
        may hide it."""
        if target.sigma_m <= snapshot.actuators.config.arm.grasp_sigma_m:
            return False
        if snapshot.estimator.own_arm.hides(self._label, target.position_m, snapshot.angles):
            return False  # it will not be seen better before the hand is out of the way
        if self._unsure_since_ns is None:
            self._unsure_since_ns = snapshot.now_ns
        return snapshot.now_ns - self._unsure_since_ns < (self.UNSURE_S + 2 * snapshot.estimator.sight_lag_s) * NS

    def _coasts_there(self, snapshot: Snapshot, target: TargetEstimate) -> bool:
        """Whether the robot comes to rest at the target when it brakes now."""
        driver, (x, y, _) = snapshot.actuators.driver, snapshot.at_rest(target)
        base = snapshot.estimator.base
        slow = base is not None and abs(base.speed_mps) < snapshot.actuators.config.navigation.coasting_mps
        return slow and driver.arrived(offset_to((x, y), grasp_aim(snapshot.actuators)))

    MAX_STALLS = 2

    def _touched(self, snapshot: Snapshot) -> None:
        """Enter an unseen obstacle, which holds up the arm, in the map at the hand's place."""
        self._stalls += 1
        x, y, z = snapshot.body.apply(hand_place(snapshot))
        snapshot.estimator.around.floor.bump([(x, y)], z)
        snapshot.actuators.arm.resync()

    def _room_here(self, snapshot: Snapshot, fields: Fields) -> bool:
        assert self._course is not None
        return self._course.roomy(snapshot.body, fields)

    UNFOLD_S = 2.0
    """Time in which the arm unfolds, s."""

    def _room_ahead(self, snapshot: Snapshot, target: TargetEstimate, fields: Fields) -> bool:
        """Whether there is room for the arm to unfold while the robot turns and drives on."""
        assert self._course is not None
        x, y, _ = target.position_m
        on_the_way = snapshot.actuators.driver.preview((x, y), grasp_aim(snapshot.actuators), self.UNFOLD_S)
        ahead = [Pose2(0.25), Pose2(0.5), *on_the_way[: round(self.UNFOLD_S / PREVIEW_S) : 4]]
        return all(self._course.roomy(snapshot.body.compose(pose), fields) for pose in ahead)

    def _unseen_swing(self, snapshot: Snapshot) -> tuple[float, float] | None:
        """A place to look at before the arm unfolds, odometry frame, m; for the time of one glance."""
        if self._glance_since_ns is None:
            self._glance_since_ns = snapshot.now_ns
        glance_s = snapshot.actuators.config.navigation.glance_s + snapshot.estimator.sight_lag_s
        if snapshot.now_ns - self._glance_since_ns > glance_s * NS:
            return None
        return snapshot.unseen_under_swing()

    def _ready_hand(
        self, snapshot: Snapshot, target: TargetEstimate, move: Move, fields: Fields
    ) -> tuple[ArmStep, Move]:
        actuators, config = snapshot.actuators, snapshot.actuators.config.arm
        arm, angles, dt_s = actuators.arm, snapshot.angles, snapshot.dt_s
        reference = arm.reference or angles
        if not actuators.ready_on_the_way:
            return arm.park(angles, dt_s), move
        if not arm.folded(reference):
            have = actuators.reacher.pose({**angles, **reference})
            if (
                have.height_m < config.travel_height_m - 0.05
                and have.radius_m > actuators.reachability.retreat_m + 0.02
            ):
                # The hand is low and stretched out, perhaps around something: back it out first.
                actuators.grip.open()
                back = have._replace(radius_m=actuators.reachability.retreat_m, pitch_rad=config.pitch_rad)
                step = arm.reach(back, config.insert_speed_mps, angles, dt_s)
                return step._replace(arrived=False), _waiting(move, "backing the hand out first")
            if not move.direct:
                return arm.park(angles, dt_s), _waiting(move, "folding the arm to go around")
        elif not move.direct:
            return arm.park(angles, dt_s), move
        elif not self._room_here(snapshot, fields):
            step = arm.park(angles, dt_s)._replace(arrived=False)
            return step, move._replace(why=f"no room yet to unfold the arm; {move.why}")
        elif arm.parked(reference) and (place := self._unseen_swing(snapshot)) is not None:
            why = "looking where to unfold the arm"
            # The robot drives on meanwhile, but not up to the target.
            held = _waiting(move, why) if move.left_m < 0.35 else move._replace(why=f"{why}; {move.why}")
            return arm.park(angles, dt_s)._replace(arrived=False), held._replace(look_at=place)
        if arm.folded(reference) and not self._room_ahead(snapshot, target, fields):
            move = _waiting(move, "unfolding the arm here, where there is room")
        actuators.grip.open()
        base = snapshot.estimator.base
        fast = base is not None and abs(base.speed_mps) > actuators.config.navigation.coasting_mps
        swing_radps = config.swing_radps if fast else None
        if move.left_m < config.descend_at_m and abs(move.turn_radps) < 0.4:
            goal = actuators.reachability.grasp(target.position_m, snapshot.aside_m(self._label)).behind
            low, high = config.grasp_azimuth_range_rad
            goal = goal._replace(azimuth_rad=min(max(goal.azimuth_rad, low), high))
            have = actuators.reacher.pose({**angles, **reference})
            if abs(have.azimuth_rad - goal.azimuth_rad) > 0.12 and have.height_m > config.travel_height_m - 0.03:
                # The hand moves high over obstacles beside the target, then comes down at its place.
                goal = goal._replace(radius_m=config.travel_radius_m, height_m=config.travel_height_m)
            step = arm.reach(goal, config.hand_speed_mps, angles, dt_s, swing_radps=swing_radps)
            late = move.left_m < 0.10 and not step.arrived and step.left > 0.03
            # The hand must be behind the target before the target is between the fingers.
            return step, _waiting(move, "waiting for the hand") if late and not move.arrived else move
        goal = HandPose(config.travel_radius_m, 0.0, config.travel_height_m, config.pitch_rad)
        step = arm.reach(goal, config.hand_speed_mps, angles, dt_s, swing_radps=swing_radps)
        return step._replace(arrived=False), move


class Carrying:
    """Drives, with something in the hand, to where it is to be put down (odometry frame)."""

    needs_sight = True

    def __init__(self, action: Carry) -> None:
        self._label = action.label
        self._place_m = action.place_m
        self._course: Course | None = None
        self._back_off = BackOff()
        self._loose_since_ns: int | None = None

    def step(self, snapshot: Snapshot) -> Plan:
        actuators = snapshot.actuators
        if self._course is None:
            self._course = Course(actuators.robot, actuators.config, grasp_aim(actuators), arm="out")
            self._label = self._label or held(snapshot)
        x, y, _ = snapshot.body.inverse().apply((*self._place_m, 0.0))
        head = snapshot.look_at((x, y, 0.0))
        if snapshot.holding:
            self._loose_since_ns = None
        elif self._loose_since_ns is None:
            self._loose_since_ns = snapshot.now_ns
        elif snapshot.now_ns - self._loose_since_ns > 0.3 * NS:
            return Plan(
                snapshot.stand(), snapshot.still(), "the claws hold nothing any more", head, "failed", "slipped"
            )
        backing = self._back_off.step(snapshot, head)
        if backing is not None:
            return backing
        fields = snapshot.fields(self._label)
        move = self._course.step(
            self._place_m, snapshot.body, snapshot.estimator.around, fields, actuators.driver, snapshot.now_ns
        )
        if move.blocked:
            return Plan(snapshot.stand(), snapshot.still(), move.why, head, "failed", "blocked")
        if move.look_at is not None:
            head = snapshot.look_at(snapshot.body.inverse().apply((*move.look_at, 0.0)))
        base = actuators.driver.command(move.speed_mps, move.turn_radps, snapshot.dt_s, pace=GENTLE)
        plan = Plan(base, snapshot.still(), f"carrying: {move.why}", head, distance_m=move.left_m)
        if move.arrived and snapshot.standing:
            plan.state, plan.why = "done", "at the place to put it down"
        return plan


HELD_M = 0.15


def held(snapshot: Snapshot) -> str:
    """The known object that the hand seems to hold: the nearest one, seen from above, within `HELD_M`; '' for none. It
    would else count as an obstacle, in the way of the very hand that carries it."""
    x, y, _ = hand_place(snapshot)
    known = snapshot.estimator.memory.all(snapshot.body, snapshot.now_ns)
    away = {item.label: hypot(item.position_m[0] - x, item.position_m[1] - y) for item in known}
    nearest = min(away, key=away.__getitem__, default="")
    return nearest if nearest and away[nearest] < HELD_M else ""


def _waiting(move: Move, why: str) -> Move:
    return move._replace(speed_mps=0.0, turn_radps=0.0, arrived=False, why=why)
