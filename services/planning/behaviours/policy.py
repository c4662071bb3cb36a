"""Following a learned policy: the robot does what the policy proposes, as far as that is safe."""

from __future__ import annotations

from collections.abc import Mapping
from math import hypot
from typing import NamedTuple

from cocoro.clock import NS
from cocoro.messages import BaseCommand, Motion, PolicyActions
from cocoro.messages.actions import FollowPolicy
from cocoro.robot import Robot
from cocoro.units import Vec3
from services.planning.arm import ArmStep
from services.planning.arm_guard import ArmGuard
from services.planning.behaviours.base import Plan, Snapshot
from services.planning.behaviours.cautious_base import CautiousBase
from services.planning.config import PolicyConfig
from services.planning.head import Aim
from services.planning.surroundings import Fields

_STANDING_MPS, _STANDING_RADPS = 0.01, 0.03
"""Slower rates are rest: a network does not say zero."""
_LEAVES_RAD = 0.1
"""A goal so far from the reference moves a folded arm."""


class Row(NamedTuple):
    """What a policy wants at one time."""

    goals: Mapping[str, float]
    """Rad, by joint."""
    ahead_mps: float
    turn_radps: float
    aside_mps: float = 0.0


def row_at(actions: PolicyActions, now_ns: int, config: PolicyConfig) -> Row | None:
    """What a chunk wants now: joints between the goals of two rows, the base by the earlier one. None when its rows are
    used up or too old, and before its first."""
    at = (now_ns - actions.observed_ns) / NS
    if not 0.0 <= at <= min(actions.rows * actions.period_s + config.hold_s, config.oldest_s):
        return None
    last = actions.rows - 1
    number = min(int(at / actions.period_s), last)
    share = min(at / actions.period_s - number, 1.0)
    before, after = actions.goal_rad[number], actions.goal_rad[min(number + 1, last)]
    goals = {
        joint: (1.0 - share) * one + share * other
        for joint, one, other in zip(actions.joints, before, after, strict=True)
    }
    aside_mps = actions.aside_mps[number] if actions.aside_mps else 0.0
    return Row(goals, actions.ahead_mps[number], actions.turn_radps[number], aside_mps)


class FollowingPolicy:
    """Follows the newest chunk row by row. Without one that counts all is at rest, and after a while it fails.

    While perception is late the wheels stand, as in all driving.
    """

    needs_sight = False

    def __init__(self, action: FollowPolicy) -> None:
        self._name = action.label
        self._base = CautiousBase()
        self._grip = _ProposedGrip()
        self._guard: ArmGuard | None = None
        self._heard = False
        self._counted_ns: int | None = None
        """When actions counted last, or when it began."""
        self._glance_ns: int | None = None

    def step(self, snapshot: Snapshot) -> Plan:
        config, now_ns = snapshot.actuators.config.policy, snapshot.now_ns
        if self._counted_ns is None or now_ns < self._counted_ns:
            self._counted_ns = now_ns
        fields = self._base.look(snapshot)
        actions = self._proposed(snapshot)
        if actions is not None and actions.state != "running":
            return self._end(snapshot, actions)
        if actions is not None and (wrong := misfit(actions, snapshot.actuators.robot)):
            return self._rest(snapshot, wrong, "refused")
        row = row_at(actions, now_ns, config) if actions is not None else None
        if row is None:
            return self._wait(snapshot, (now_ns - self._counted_ns) / NS)
        self._heard, self._counted_ns = True, now_ns
        return self._follow(snapshot, row, fields)

    def _proposed(self, snapshot: Snapshot) -> PolicyActions | None:
        """The newest chunk that answers the present intent."""
        actions, intent = snapshot.estimator.proposed, snapshot.estimator.intent
        if actions is None or intent is None or (actions.task_id, actions.step) != (intent.task_id, intent.step):
            return None
        return actions

    def _end(self, snapshot: Snapshot, actions: PolicyActions) -> Plan:
        if actions.state == "refused":
            return self._rest(snapshot, actions.text, "refused")
        plan = self._rest(snapshot, f"{self._name} has finished")
        plan.state = "done"
        return plan

    def _wait(self, snapshot: Snapshot, unheard_s: float) -> Plan:
        config = snapshot.actuators.config.policy
        if not self._heard:
            late = unheard_s > config.start_s
            return self._rest(snapshot, f"waiting for the first actions of {self._name}", "silent" if late else "")
        why = f"no actions of {self._name} that count for {unheard_s:.1f} s"
        return self._rest(snapshot, why, "silent" if unheard_s > config.silent_s else "")

    @staticmethod
    def _rest(snapshot: Snapshot, why: str, failed: str = "") -> Plan:
        plan = Plan(snapshot.stand(), snapshot.still(), why)
        if failed:
            plan.state, plan.reason = "failed", failed
        return plan

    def _follow(self, snapshot: Snapshot, row: Row, fields: Fields) -> Plan:
        robot = snapshot.actuators.robot
        goals, beyond = _within_limits(robot, row.goals)
        self._grip.step(snapshot, {name: goals[name] for name in robot.jaws if name in goals})
        base, limited = self._drive(snapshot, row, fields)
        arm, hindered, look_at = self._arm(snapshot, goals, base, fields)
        head = self._head(snapshot, goals) if look_at is None else snapshot.look_at(look_at)
        why = "; ".join(filter(None, (limited, hindered, beyond))) or f"doing what {self._name} proposes"
        return Plan(base, arm, why, head)

    def _drive(self, snapshot: Snapshot, row: Row, fields: Fields) -> tuple[BaseCommand, str]:
        if hypot(row.ahead_mps, row.aside_mps) < _STANDING_MPS and abs(row.turn_radps) < _STANDING_RADPS:
            return snapshot.stand(), ""
        motion = Motion(speed_mps=row.ahead_mps, turn_radps=row.turn_radps, aside_mps=row.aside_mps)
        base, allowed = self._base.drive(snapshot, motion, fields, looks=False)
        return base, allowed.why

    def _arm(
        self, snapshot: Snapshot, goals: Mapping[str, float], base: BaseCommand, fields: Fields
    ) -> tuple[ArmStep, str, Vec3 | None]:
        """One step of arm and wrist to their goals, why it is none, and where the head is to look first."""
        actuators, angles, dt_s = snapshot.actuators, snapshot.angles, snapshot.dt_s
        arm, robot = actuators.arm, actuators.robot
        wanted = {name: goals[name] for name in (*robot.arm.joints, robot.arm.roll) if name in goals}
        if not wanted:
            return arm.hold(angles, dt_s), "", None
        if arm.stalled:
            arm.resync()
            return arm.hold(angles, dt_s), "something holds the arm up", None
        here = {**angles, **(arm.reference or {})}
        if (place := self._to_look_at(snapshot, here, wanted)) is not None:
            return arm.hold(angles, dt_s), "looking where to unfold the arm", place
        speed_radps = min(
            actuators.config.arm.joint_speed_radps, *(robot.joints[name].max_speed_radps for name in wanted)
        )
        if why := self._hindrance(snapshot, here, wanted, speed_radps, base, fields):
            return arm.hold(angles, dt_s), why, None
        step = arm.towards(wanted, speed_radps, angles, dt_s)
        return step, "the arm cannot go there: the robot or the floor is in its way" if step.blocked else "", None

    def _hindrance(
        self,
        snapshot: Snapshot,
        here: Mapping[str, float],
        wanted: Mapping[str, float],
        speed_radps: float,
        base: BaseCommand,
        fields: Fields,
    ) -> str:
        """What keeps the arm from its goals; '' when nothing does."""
        actuators = snapshot.actuators
        if self._guard is None:
            self._guard = ArmGuard(actuators.robot, actuators.config, actuators.arm.clearance)
        widest = max(abs(goal - here[name]) for name, goal in wanted.items())
        if widest < 1e-6:
            return ""
        share = min(speed_radps * actuators.config.policy.ahead_s / widest, 1.0)
        there = {**here, **{name: here[name] + share * (goal - here[name]) for name, goal in wanted.items()}}
        stops = actuators.driver.stopping_poses(base.ahead_mps, base.turn_radps, turning=True)
        moving = [snapshot.body, *(snapshot.body.compose(pose) for pose in stops if actuators.driver.moving)]
        held_m = (self._hand_m(snapshot, here), self._hand_m(snapshot, there)) if snapshot.holding else None
        return self._guard.why_not(here, there, held_m, moving, fields)

    @staticmethod
    def _hand_m(snapshot: Snapshot, angles: Mapping[str, float]) -> Vec3:
        x, y, z = snapshot.actuators.reacher.position(angles).tolist()
        return x, y, z

    def _to_look_at(self, snapshot: Snapshot, here: Mapping[str, float], wanted: Mapping[str, float]) -> Vec3 | None:
        """Unseen floor under an arm that is to unfold, body frame, m; for the time of one glance."""
        actuators = snapshot.actuators
        leaves = any(abs(goal - here[name]) > _LEAVES_RAD for name, goal in wanted.items())
        if not leaves or not actuators.arm.parked(here):
            return None
        if self._glance_ns is None:
            self._glance_ns = snapshot.now_ns
        glance_s = actuators.config.navigation.glance_s + snapshot.estimator.sight_lag_s
        if not 0 <= snapshot.now_ns - self._glance_ns <= glance_s * NS:
            return None
        place = snapshot.unseen_under_swing()
        return None if place is None else snapshot.body.inverse().apply((*place, 0.0))

    @staticmethod
    def _head(snapshot: Snapshot, goals: Mapping[str, float]) -> Aim | None:
        actuators = snapshot.actuators
        joints, config = actuators.robot.head_joints, actuators.config.head
        if not joints or not goals.keys() & set(joints):
            return None
        pan, tilt = (goals.get(joint, snapshot.angles[joint]) for joint in joints)
        low, high = config.tilt_range_rad
        return Aim(pan, min(max(tilt, low), high), config.fixate_speed_radps)


class _ProposedGrip:
    """Opens and closes the claws as far as the policy wants. Closed claws that hold something clamp it, until the
    policy opens them."""

    def __init__(self) -> None:
        self._clamps = False

    def step(self, snapshot: Snapshot, goals: Mapping[str, float]) -> None:
        grip, hand, robot = snapshot.actuators.grip, snapshot.estimator.hand, snapshot.actuators.robot
        if hand is None or not goals:
            return
        opening = grip.opening(hand)
        have_rad = sum(opening) / len(opening)
        wanted_rad = sum(robot.claw.open_sign[name] * goal for name, goal in goals.items()) / len(goals)
        if snapshot.holding and wanted_rad <= have_rad + snapshot.actuators.config.policy.grip_rad:
            if not self._clamps:
                grip.clamp(hand)
            self._clamps = True
            return
        self._clamps = False
        grip.aim(wanted_rad)


def misfit(actions: PolicyActions, robot: Robot) -> str:
    """Why a robot cannot follow a chunk, one sentence; '' when it can."""
    if unknown := [joint for joint in actions.joints if joint not in robot.joints]:
        return f"it proposes goals of joints that the robot does not have: {', '.join(unknown)}"
    if len(set(actions.joints)) != len(actions.joints):
        return "it proposes two goals of one joint"
    return ""


def _within_limits(robot: Robot, goals: Mapping[str, float]) -> tuple[dict[str, float], str]:
    """Goals within the joints' limits, and which ones were beyond, in words."""
    within, beyond = {}, []
    for name, goal in goals.items():
        low, high = robot.joints[name].limits_rad
        within[name] = min(max(goal, low), high)
        if within[name] != goal:
            beyond.append(name)
    return within, f"not beyond the limits of {', '.join(beyond)}" if beyond else ""
