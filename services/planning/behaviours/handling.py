"""Handling behaviours: the base stands or comes to rest, arm and hand move."""

from __future__ import annotations

from cocoro.messages.actions import Close, Lift, PutDown, Reach
from services.planning.behaviours.base import Plan, Snapshot, hand_place
from services.planning.reach import HandPose
from services.planning.reachability import Grasp


class Reaching:
    """Brings the open claws around the target, from behind, along the hand's own axis."""

    needs_sight = False
    FREEZE_M = 0.08
    """Distance from which the hand hides the target, so that its last place is kept."""
    CLOSE_IN_M = 0.015
    CLOSE_M = 0.02
    """Rest of the way at which the claws begin to close: the target is between them."""

    def __init__(self, action: Reach, *, touching: bool = False) -> None:
        """`touching`: the target is only touched, so it may be nearer or further than one that is grasped."""
        self._label = action.label
        self._touching = touching
        self._frozen: Grasp | None = None
        self._inserting = False

    @property
    def goal(self) -> HandPose | None:
        """Final pose of the hand, once it is settled."""
        return self._frozen.around if self._frozen is not None else None

    def step(self, snapshot: Snapshot) -> Plan:
        actuators, config = snapshot.actuators, snapshot.actuators.config
        target = snapshot.target(self._label)
        if self._frozen is None and (
            target is None or target.age_s > config.stale_target_s + snapshot.estimator.sight_lag_s
        ):
            return Plan(snapshot.stand(), snapshot.still(), f"{self._label} is out of sight", None, "failed", "lost")
        if target is not None and not self._inserting:
            aside_m = snapshot.aside_m(self._label)
            why_not = "" if self._touching else snapshot.too_wide(self._label)
            why_not = why_not or actuators.reachability.why_not(
                snapshot.at_rest(target), aside_m, touching=self._touching
            )
            if why_not:
                return Plan(snapshot.stand(), snapshot.still(), why_not, None, "failed", "unreachable")
        actuators.grip.open()
        grasp = self._frozen
        if grasp is None:
            assert target is not None
            grasp = actuators.reachability.grasp(snapshot.at_rest(target), snapshot.aside_m(self._label))
        head = snapshot.look_at(target.position_m) if target is not None else None
        closing_in = self._inserting
        if not closing_in:
            arm = actuators.arm.reach(grasp.behind, config.arm.hand_speed_mps, snapshot.angles, snapshot.dt_s)
            ready = arm.left < self.CLOSE_IN_M and snapshot.estimator.hand is not None
            if ready and snapshot.estimator.hand is not None and actuators.grip.opened(snapshot.estimator.hand):
                self._inserting = True
            why = "bringing the open hand behind the target"
        else:
            arm = actuators.arm.reach(grasp.around, config.arm.insert_speed_mps, snapshot.angles, snapshot.dt_s)
            if arm.left < self.FREEZE_M:
                self._frozen = grasp
            if arm.left < self.CLOSE_M and not self._touching:
                actuators.grip.close()  # the claws need longer than the hand
            why = "closing in on the target"
        plan = Plan(snapshot.stand(), arm, why, head, distance_m=arm.left)
        if arm.blocked:
            plan.state, plan.reason, plan.why = "failed", "blocked", "the hand's way is blocked"
        elif closing_in and arm.arrived:
            actuators.grasp_height_m = grasp.around.height_m
            plan.state, plan.why = "done", "the target is between the claws"
        return plan


class Closing:
    """Closes the jaws together until something stops them (the paper's one degree of freedom)."""

    needs_sight = False

    def __init__(self, action: Close) -> None:
        self._since_ns: int | None = None

    def step(self, snapshot: Snapshot) -> Plan:
        hand = snapshot.estimator.hand
        if self._since_ns is None:
            self._since_ns = snapshot.now_ns
            snapshot.actuators.grip.close()
        plan = Plan(snapshot.stand(), snapshot.still(), "closing the claws")
        if snapshot.holding and hand is not None:
            snapshot.actuators.grip.clamp(hand)
            plan.state, plan.why = "done", "the claws hold something"
        elif (snapshot.now_ns - self._since_ns) / 1e9 > snapshot.actuators.config.hand.give_up_s:
            plan.state, plan.reason, plan.why = "failed", "no_grip", "the claws closed on nothing"
        return plan


class Lifting:
    """Lifts straight up first, then in and up to where the arm carries with little torque."""

    needs_sight = False
    STRAIGHT_M = 0.05
    SLIP_S = 0.3

    def __init__(self, action: Lift) -> None:
        self._start: HandPose | None = None
        self._up = False
        self._loose_since_ns: int | None = None

    def step(self, snapshot: Snapshot) -> Plan:
        actuators, config = snapshot.actuators, snapshot.actuators.config.arm
        if self._start is None:
            self._start = actuators.reacher.pose(snapshot.angles)
        top_m = actuators.grasp_height_m + config.carry_rise_m
        if not self._up:
            goal = self._start._replace(height_m=self._start.height_m + self.STRAIGHT_M)
        else:
            goal = HandPose(config.carry_radius_m, self._start.azimuth_rad, top_m, self._start.pitch_rad)
        arm = actuators.arm.reach(goal, config.lift_speed_mps, snapshot.angles, snapshot.dt_s)
        plan = Plan(snapshot.stand(), arm, "lifting", snapshot.look_at(hand_place(snapshot)), distance_m=arm.left)
        if snapshot.holding:
            self._loose_since_ns = None
        elif self._loose_since_ns is None:
            self._loose_since_ns = snapshot.now_ns
        elif (snapshot.now_ns - self._loose_since_ns) / 1e9 > self.SLIP_S and not actuators.grip.pressing:
            # A thing that settles between the claws as it leaves the floor is pressed again, and soon held.
            plan.state, plan.reason, plan.why = "failed", "slipped", "the claws hold nothing any more"
            return plan
        if arm.blocked:
            plan.state, plan.reason, plan.why = "failed", "blocked", "the arm's way up is blocked"
        elif not self._up:
            self._up = arm.arrived
        elif arm.arrived:
            plan.state, plan.why = "done", "lifted; holding it there"
        return plan


class PuttingDown:
    """Lowers what is in the hand, opens the hand, backs out and raises it."""

    needs_sight = False

    def __init__(self, action: PutDown) -> None:
        self._phase = 0
        self._start: HandPose | None = None

    def step(self, snapshot: Snapshot) -> Plan:
        actuators, config = snapshot.actuators, snapshot.actuators.config.arm
        if self._start is None:
            self._start = actuators.reacher.pose(snapshot.angles)
        azimuth, pitch = self._start.azimuth_rad, config.pitch_rad
        low = HandPose(config.grasp_radius_m, azimuth, actuators.grasp_height_m + 0.003, pitch)
        phases: tuple[tuple[str, HandPose, float], ...] = (
            ("stretching out", low._replace(height_m=low.height_m + 0.05), config.lift_speed_mps),
            ("setting it down", low, config.lift_speed_mps / 2),
            ("letting go", low, config.lift_speed_mps),
            ("backing out", low._replace(radius_m=actuators.reachability.retreat_m), config.insert_speed_mps),
            (
                "raising the hand",
                HandPose(config.travel_radius_m, azimuth, config.travel_height_m, pitch),
                config.hand_speed_mps,
            ),
        )
        why, goal, speed = phases[self._phase]
        arm = actuators.arm.reach(goal, speed, snapshot.angles, snapshot.dt_s)
        done = arm.arrived
        if self._phase >= 2:
            actuators.grip.open()
        if self._phase == 2:
            hand = snapshot.estimator.hand
            done = hand is not None and actuators.grip.opened(hand)
        plan = Plan(snapshot.stand(), arm, why, snapshot.look_at(hand_place(snapshot)), distance_m=arm.left)
        if arm.blocked:
            plan.state, plan.reason, plan.why = "failed", "blocked", f"{why}: the arm's way is blocked"
        elif done and self._phase == len(phases) - 1:
            plan.state, plan.why = "done", "put down"
        elif done:
            self._phase += 1
        return plan
