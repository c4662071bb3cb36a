"""What the planner can be asked to do. Each behaviour is a small state machine that is stepped at the planner's rate,
says what it wants of base, head, arm and hand, and why, and ends as done or failed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import hypot
from typing import Literal, Protocol

from cocoro.frames import Pose2
from cocoro.messages import BaseCommand, TargetEstimate
from cocoro.robot import Robot
from services.planning.arm import ArmController, Step
from services.planning.config import Config
from services.planning.hand import Grip
from services.planning.head import PAN, TILT, Gaze, Sweep
from services.planning.navigation import Driver, Offset, offset_to
from services.planning.reach import HandPose, Reacher
from services.planning.reachability import Grasp, Reachability
from services.planning.senses import Senses

State = Literal["running", "done", "failed"]


@dataclass
class Limbs:
    """What a behaviour commands with; one set for the planner's life, so that motion goes on smoothly from one
    behaviour to the next."""

    robot: Robot
    config: Config
    driver: Driver = field(init=False)
    reacher: Reacher = field(init=False)
    arm: ArmController = field(init=False)
    grip: Grip = field(init=False)
    gaze: Gaze = field(init=False)
    reachability: Reachability = field(init=False)
    grasp_height_m: float = 0.065
    """At which height what is in the hand was grasped: there it is put down."""

    def __post_init__(self) -> None:
        config, robot = self.config, self.robot
        self.driver = Driver(config.navigation, robot.base)
        self.reacher = Reacher(robot, config.arm.damping)
        self.arm = ArmController(robot, config.arm, self.reacher)
        self.grip = Grip(robot, config.hand)
        self.gaze = Gaze(robot)
        self.reachability = Reachability(config.arm, self.reacher)


@dataclass(frozen=True)
class Scene:
    """One step's view: everything fresh, everything now."""

    now_ns: int
    dt_s: float
    senses: Senses
    body: Pose2
    angles: Mapping[str, float]
    limbs: Limbs

    def target(self, label: str) -> TargetEstimate | None:
        return self.senses.memory.estimate(label, self.body, self.now_ns)

    @property
    def holding(self) -> bool:
        return self.limbs.grip.holding(self.now_ns)

    @property
    def standing(self) -> bool:
        base = self.senses.base
        return base is not None and abs(base.speed_mps) < 0.01 and abs(base.turn_rate_radps) < 0.03

    def stand(self) -> BaseCommand:
        return self.limbs.driver.brake(self.dt_s)

    def still(self) -> Step:
        return self.limbs.arm.hold(self.angles, self.dt_s)

    def look_at(self, point_m: tuple[float, float, float]) -> tuple[float, float, float]:
        pan, tilt = self.limbs.gaze.at(point_m, self.angles)
        return pan, tilt, self.limbs.config.head.fixate_speed_radps


@dataclass
class Plan:
    """What a behaviour wants now."""

    base: BaseCommand
    arm: Step
    why: str
    head: tuple[float, float, float] | None = None
    """Pan, tilt, speed; None holds the head where it is."""
    state: State = "running"
    reason: str = ""
    distance_m: float | None = None


class Behaviour(Protocol):
    def step(self, scene: Scene) -> Plan: ...


class Idle:
    """Stand still and hold everything as it is."""

    def __init__(self, why: str = "nothing is asked") -> None:
        self._why = why

    def step(self, scene: Scene) -> Plan:
        return Plan(scene.stand(), scene.still(), self._why, state="done")


class Park:
    """Fold the arm up and look ahead."""

    def step(self, scene: Scene) -> Plan:
        arm = scene.limbs.arm.park(scene.angles, scene.dt_s)
        if arm.blocked:
            return Plan(scene.stand(), arm, "the way to the park pose is blocked", None, "failed", "blocked")
        done = arm.arrived and scene.limbs.arm.parked(scene.angles)
        plan = Plan(scene.stand(), arm, "folding the arm up", (0.0, 0.0, 1.5), distance_m=arm.left)
        if done:
            plan.state, plan.why = "done", "parked"
        return plan


class Search:
    """Look where the target was last, then sweep the head over the whole surroundings. What shows up in the sweep is
    looked at until it is confirmed."""

    CONFIRMED = 2
    IN_VIEW_S = 0.2
    """A target is in view when its newest sighting is not older than this and perception's own lag."""

    def __init__(self, label: str) -> None:
        self._label = label
        self._sweep: Sweep | None = None
        self._looked_at_ns: int | None = None
        self._looked_from = 0
        """Sightings there were when looking at the remembered place began."""

    def step(self, scene: Scene) -> Plan:
        config = scene.limbs.config.head
        target = scene.target(self._label)
        base, arm = scene.stand(), scene.still()
        if target is not None:
            head = scene.look_at(target.position_m)
            sightings = scene.senses.memory.sightings(self._label)
            lag_s = scene.senses.sight_lag_s
            if sightings >= self.CONFIRMED and target.age_s < self.IN_VIEW_S + lag_s:
                return Plan(base, arm, f"{self._label} is in view", head, "done", distance_m=_planar(target))
            if self._looked_at_ns is None or sightings > self._looked_from:
                self._looked_at_ns, self._looked_from = scene.now_ns, sightings
            if scene.now_ns - self._looked_at_ns < (config.look_where_it_was_s + 2 * lag_s) * 1e9:
                why = f"{self._label} was seen {target.age_s:.1f} s ago: looking there"
                return Plan(base, arm, why, head, distance_m=_planar(target))
        pan, tilt = scene.angles[PAN], scene.angles[TILT]
        if self._sweep is None:
            self._sweep = Sweep(config, pan)
        goal = self._sweep.next(pan, tilt)
        # Slow perception must still see every direction twice as the view passes over it.
        speed = min(config.sweep_speed_radps, 0.4 / max(scene.senses.sight_lag_s, 1e-3))
        head = (*goal, speed)
        if self._sweep.done:
            why = f"the whole surroundings were searched, {self._label} is not there"
            return Plan(base, arm, why, head, "failed", "not_found")
        return Plan(base, arm, f"sweeping for {self._label}: {self._sweep.share:.0%} done", head)


class Approach:
    """Drive to where the arm reaches the target; the hand gets ready on the way and comes down behind the target
    before it is near, so that it never comes down on it."""

    def __init__(self, label: str) -> None:
        self._label = label

    def step(self, scene: Scene) -> Plan:
        limbs, config = scene.limbs, scene.limbs.config
        target = scene.target(self._label)
        if target is None or target.age_s > config.stale_target_s + scene.senses.sight_lag_s:
            why = f"{self._label} has not been seen for {target.age_s:.1f} s" if target else f"{self._label} is unknown"
            return Plan(scene.stand(), scene.still(), why, None, "failed", "lost")
        head = scene.look_at(target.position_m)
        offset = self.offset(scene, target)
        arm = self._ready_hand(scene, target, offset)
        base_state = scene.senses.base
        if base_state is not None and (base_state.bump_left or base_state.bump_right):
            return Plan(scene.stand(), scene.still(), "the bumper touches something", head, "failed", "blocked")
        if limbs.driver.arrived(offset):
            base = scene.stand()
            why = "there; waiting for base and hand to come to rest"
            if scene.standing and arm.arrived:
                return Plan(base, arm, f"{self._label} is in reach", head, "done", distance_m=abs(offset.ahead_m))
        elif arm.blocked:
            return Plan(scene.stand(), arm, "the hand cannot get ready: its way is blocked", head, "failed", "blocked")
        else:
            base = limbs.driver.towards(offset, scene.dt_s)
            why = f"{offset.ahead_m:.2f} m to drive, {offset.heading_rad:+.2f} rad to turn"
        return Plan(base, arm, why, head, distance_m=abs(offset.ahead_m))

    @staticmethod
    def offset(scene: Scene, target: TargetEstimate) -> Offset:
        """What is left to drive until the target stands where the arm grasps best."""
        config, reacher = scene.limbs.config.arm, scene.limbs.reacher
        aim = reacher.point(HandPose(config.grasp_radius_m, 0.0, 0.0, 0.0))
        return offset_to(target.position_m[:2], (float(aim[0]), float(aim[1])))

    def _ready_hand(self, scene: Scene, target: TargetEstimate, offset: Offset) -> Step:
        limbs, config = scene.limbs, scene.limbs.config.arm
        if scene.limbs.config.coordination == "lockstep":
            return limbs.arm.park(scene.angles, scene.dt_s)
        limbs.grip.open()
        reference = limbs.arm.reference or scene.angles
        if not limbs.arm.folded(reference):
            have = limbs.reacher.pose({**scene.angles, **reference})
            if have.height_m < config.travel_height_m - 0.05 and have.radius_m > config.retreat_radius_m + 0.02:
                # Low and stretched out, perhaps around something: back out before anything else.
                back = have._replace(radius_m=config.retreat_radius_m, pitch_rad=config.pitch_rad)
                return limbs.arm.reach(back, config.insert_speed_mps, scene.angles, scene.dt_s)._replace(arrived=False)
        near = 0.0 < offset.ahead_m < config.descend_at_m or abs(offset.ahead_m) <= 0.05
        if near and abs(offset.heading_rad) < 0.25:
            goal = limbs.reachability.grasp(target.position_m).behind
            low, high = config.grasp_azimuth_range_rad
            goal = goal._replace(azimuth_rad=min(max(goal.azimuth_rad, low), high))
        else:
            goal = HandPose(config.travel_radius_m, 0.0, config.travel_height_m, config.pitch_rad)
        return limbs.arm.reach(goal, config.hand_speed_mps, scene.angles, scene.dt_s)


class Reach:
    """Bring the open claws around the target, from behind, along the hand's own axis."""

    FREEZE_M = 0.08
    """From here on the hand covers the target: its place is held."""
    CLOSE_IN_M = 0.015

    def __init__(self, label: str) -> None:
        self._label = label
        self._frozen: Grasp | None = None
        self._inserting = False

    def step(self, scene: Scene) -> Plan:
        limbs, config = scene.limbs, scene.limbs.config
        target = scene.target(self._label)
        if self._frozen is None and (target is None or target.age_s > config.stale_target_s + scene.senses.sight_lag_s):
            return Plan(scene.stand(), scene.still(), f"{self._label} is out of sight", None, "failed", "lost")
        if target is not None and not self._inserting:
            why_not = limbs.reachability.why_not(target.position_m)
            if why_not:
                return Plan(scene.stand(), scene.still(), why_not, None, "failed", "unreachable")
        limbs.grip.open()
        grasp = self._frozen
        if grasp is None:
            assert target is not None
            grasp = limbs.reachability.grasp(target.position_m)
        head = scene.look_at(target.position_m) if target is not None else None
        closing_in = self._inserting
        if not closing_in:
            arm = limbs.arm.reach(grasp.behind, config.arm.hand_speed_mps, scene.angles, scene.dt_s)
            ready = arm.left < self.CLOSE_IN_M and scene.senses.hand is not None
            if ready and scene.senses.hand is not None and limbs.grip.opened(scene.senses.hand):
                self._inserting = True
            why = "bringing the open hand behind the target"
        else:
            arm = limbs.arm.reach(grasp.around, config.arm.insert_speed_mps, scene.angles, scene.dt_s)
            if arm.left < self.FREEZE_M:
                self._frozen = grasp
            why = "closing in on the target"
        plan = Plan(scene.stand(), arm, why, head, distance_m=arm.left)
        if arm.blocked:
            plan.state, plan.reason, plan.why = "failed", "blocked", "the hand's way is blocked"
        elif closing_in and arm.arrived:
            limbs.grasp_height_m = grasp.around.height_m
            plan.state, plan.why = "done", "the target is between the claws"
        return plan


class Close:
    """Close both claws as one until something stops them (the paper's one degree of freedom)."""

    def __init__(self) -> None:
        self._since_ns: int | None = None

    def step(self, scene: Scene) -> Plan:
        hand = scene.senses.hand
        if self._since_ns is None:
            self._since_ns = scene.now_ns
            scene.limbs.grip.close()
        plan = Plan(scene.stand(), scene.still(), "closing the claws")
        if scene.holding and hand is not None:
            scene.limbs.grip.clamp(hand)
            plan.state, plan.why = "done", "the claws hold something"
        elif (scene.now_ns - self._since_ns) / 1e9 > scene.limbs.config.hand.give_up_s:
            plan.state, plan.reason, plan.why = "failed", "no_grip", "the claws closed on nothing"
        return plan


class Lift:
    """Straight up first, then in and up to where the arm carries with little torque."""

    STRAIGHT_M = 0.05
    SLIP_S = 0.3

    def __init__(self) -> None:
        self._start: HandPose | None = None
        self._up = False
        self._loose_since_ns: int | None = None

    def step(self, scene: Scene) -> Plan:
        limbs, config = scene.limbs, scene.limbs.config.arm
        if self._start is None:
            self._start = limbs.reacher.pose(scene.angles)
        top_m = limbs.grasp_height_m + config.carry_rise_m
        if not self._up:
            goal = self._start._replace(height_m=self._start.height_m + self.STRAIGHT_M)
        else:
            goal = HandPose(config.carry_radius_m, self._start.azimuth_rad, top_m, self._start.pitch_rad)
        arm = limbs.arm.reach(goal, config.lift_speed_mps, scene.angles, scene.dt_s)
        plan = Plan(scene.stand(), arm, "lifting", scene.look_at(_tuple3(limbs, scene.angles)), distance_m=arm.left)
        if scene.holding:
            self._loose_since_ns = None
        elif self._loose_since_ns is None:
            self._loose_since_ns = scene.now_ns
        elif (scene.now_ns - self._loose_since_ns) / 1e9 > self.SLIP_S:
            plan.state, plan.reason, plan.why = "failed", "slipped", "the claws hold nothing any more"
            return plan
        if arm.blocked:
            plan.state, plan.reason, plan.why = "failed", "blocked", "the arm's way up is blocked"
        elif not self._up:
            self._up = arm.arrived
        elif arm.arrived:
            plan.state, plan.why = "done", "lifted; holding it there"
        return plan


class Place:
    """Put down what is in the hand: lower it, open, back out, raise the empty hand."""

    def __init__(self) -> None:
        self._phase = 0
        self._start: HandPose | None = None

    def step(self, scene: Scene) -> Plan:
        limbs, config = scene.limbs, scene.limbs.config.arm
        if self._start is None:
            self._start = limbs.reacher.pose(scene.angles)
        azimuth, pitch = self._start.azimuth_rad, config.pitch_rad
        low = HandPose(config.grasp_radius_m, azimuth, limbs.grasp_height_m + 0.003, pitch)
        phases: tuple[tuple[str, HandPose, float], ...] = (
            ("stretching out", low._replace(height_m=low.height_m + 0.05), config.lift_speed_mps),
            ("setting it down", low, config.lift_speed_mps / 2),
            ("letting go", low, config.lift_speed_mps),
            ("backing out", low._replace(radius_m=config.retreat_radius_m), config.insert_speed_mps),
            (
                "raising the hand",
                HandPose(config.travel_radius_m, azimuth, config.travel_height_m, pitch),
                config.hand_speed_mps,
            ),
        )
        why, goal, speed = phases[self._phase]
        arm = limbs.arm.reach(goal, speed, scene.angles, scene.dt_s)
        done = arm.arrived
        if self._phase >= 2:
            limbs.grip.open()
        if self._phase == 2:
            hand = scene.senses.hand
            done = hand is not None and limbs.grip.opened(hand)
        plan = Plan(scene.stand(), arm, why, scene.look_at(_tuple3(limbs, scene.angles)), distance_m=arm.left)
        if arm.blocked:
            plan.state, plan.reason, plan.why = "failed", "blocked", f"{why}: the arm's way is blocked"
        elif done and self._phase == len(phases) - 1:
            plan.state, plan.why = "done", "put down"
        elif done:
            self._phase += 1
        return plan


BEHAVIOURS: Mapping[str, Callable[[str], Behaviour]] = {
    "idle": lambda _label: Idle(),
    "park": lambda _label: Park(),
    "search": Search,
    "approach": Approach,
    "reach": Reach,
    "grasp": lambda _label: Close(),
    "lift": lambda _label: Lift(),
    "place": lambda _label: Place(),
}


def _planar(target: TargetEstimate) -> float:
    return hypot(target.position_m[0], target.position_m[1])


def _tuple3(limbs: Limbs, angles: Mapping[str, float]) -> tuple[float, float, float]:
    x, y, z = limbs.reacher.position(angles)
    return float(x), float(y), float(z)
