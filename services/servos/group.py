"""The core of a servo group's service: commands and readings in, orders and state out. Pure."""

from __future__ import annotations

from collections.abc import Iterable

from cocoro.clock import NS, is_fresh
from cocoro.joints import Joint
from cocoro.messages import LatchState, ServoCommand, ServoState
from cocoro.messages.hardware import STOPPED_BY
from services.servos.family import ServoFamily
from services.servos.motion import AT_GOAL_RAD, JointMotion
from services.servos.watch import ServoStatus, ServoWatch, WatchedServo

STALE_NS = NS // 10
"""A reading is published until it is older than this, in case that the next answer is missing."""


class ServoJoint(WatchedServo):
    """The state of one joint's servo."""

    def __init__(self, joint: Joint, *, keeps_goal: bool) -> None:
        super().__init__(joint.name, joint.id)
        self.joint = joint
        self.motion = JointMotion(joint, keeps_goal=keeps_goal)
        self._keeps_goal = keeps_goal

    @property
    def position_rad(self) -> float | None:
        return None if self.reading is None else self.joint.to_angle(self.reading.position)

    def let_go(self) -> None:
        self.motion.goal_rad = None

    def hold_at(self, position: int) -> None:
        self.motion.hold(self.joint.to_angle(position))

    def go_on(self, status: ServoStatus) -> None:
        """The hand, or an arm joint at rest, holds at its goal, a moving arm joint where it is."""
        resting = abs(status.goal - status.position) * self.joint.units.count_rad <= AT_GOAL_RAD * 4
        self.hold_at(status.goal if self._keeps_goal or resting else status.position)


class ServoGroup(ServoWatch[ServoJoint]):
    """The servos of one group, all on one line. Every `now_ns` is the robot's clock."""

    def __init__(
        self, joints: Iterable[Joint], family: ServoFamily, *, keeps_goal: bool, timeout_s: float, max_age_s: float
    ) -> None:
        """A command counts for `timeout_s` from its stamp, and is refused once it is older than `max_age_s`."""
        super().__init__((ServoJoint(joint, keeps_goal=keeps_goal) for joint in joints), family)
        self.joints = self.servos
        self._latch: LatchState = "unknown"
        self._keeps_goal = keeps_goal
        self._timeout_ns = round(timeout_s * NS)
        self._max_age_s = max_age_s

    # --- commands -----------------------------------------------------------------------------------

    @property
    def latch(self) -> LatchState:
        return self._latch

    def stopped_by(self, now_ns: int) -> str:
        return STOPPED_BY[self.latch]

    def command(self, command: ServoCommand, now_ns: int) -> str:
        """Accept all goals or none. Returns '' when accepted, otherwise the reason for refusing."""
        if why := self.stopped_by(now_ns):
            return why
        if not is_fresh(command.stamp_ns, now_ns, self._max_age_s):
            return "too old"
        if unknown := self.unknown(command.joints):
            return f"no joint {unknown[0]!r} in this group, which has {', '.join(self._by_name)}"
        until_ns = min(command.stamp_ns, now_ns) + self._timeout_ns
        for name, goal_rad, speed_radps in zip(command.joints, command.goal_rad, command.speed_radps, strict=True):
            one = self._by_name[name]
            if one.obeys and (position_rad := one.position_rad) is not None:
                one.motion.command(goal_rad, speed_radps, position_rad, until_ns)
        return ""

    def set_latch(self, state: LatchState) -> None:
        """Latched and unknown hold arm and neck where they are. A release enables servos that are not, and after an
        emergency stop it also clears the faults."""
        before, self._latch = self._latch, state
        if state == "released":
            self._released(before)
        elif before == "released" and not self._keeps_goal:
            for one in self.joints.values():
                if (position_rad := one.position_rad) is not None and one.motion.goal_rad is not None:
                    one.motion.hold(position_rad)

    def new_epoch(self) -> None:
        for one in self.joints.values():
            one.motion.forget_time()
            one.read_ns = 0

    def orders(self, now_ns: int) -> dict[int, tuple[int, int]]:
        """Goal and speed to write, counts, by servo ID, for the servos that obey."""
        orders = {}
        for number, one in self.joints.items():
            if one.obeys and (position_rad := one.position_rad) is not None:
                order = one.motion.order(position_rad, now_ns)
                if order is not None:
                    orders[number] = order
        return orders

    # --- state --------------------------------------------------------------------------------------

    def state(self, now_ns: int) -> ServoState | None:
        """The state of the joints with a recent reading; None when there are none."""
        recent = [
            (one, one.reading, one.read_ns)
            for one in self.joints.values()
            if one.reading is not None and not one.silent and 0 <= now_ns - one.read_ns <= STALE_NS
        ]
        if not recent:
            return None
        units = self._family.units
        return ServoState(
            stamp_ns=sum(read_ns for _, _, read_ns in recent) // len(recent),
            joints=tuple(one.joint.name for one, _, _ in recent),
            position_rad=tuple(one.joint.to_angle(reading.position) for one, reading, _ in recent),
            speed_radps=tuple(one.joint.direction * reading.speed * units.speed_radps for one, reading, _ in recent),
            load=tuple(one.joint.direction * reading.load / units.full_torque for one, reading, _ in recent),
            temperature_c=tuple(float(reading.temperature_c) for _, reading, _ in recent),
            voltage_v=tuple(reading.voltage_v for _, reading, _ in recent),
            torque_enabled=tuple(one.enabled for one, _, _ in recent),
            faults=self.latched_faults(),
            latch=self.latch,
            stopped_by=self.stopped_by(now_ns),
        )
