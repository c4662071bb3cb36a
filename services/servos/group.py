"""The core of a servo group's service: commands and readings in, orders, state and faults out. Pure.

The line gets two kinds of work: `orders`, which it writes in every cycle, and tasks, each done once with one servo.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from cocoro.clock import NS, is_fresh
from cocoro.health import WINDOW_S, Recent
from cocoro.joints import Joint
from cocoro.messages import LatchState, ServoCommand, ServoState
from cocoro.messages.hardware import STOPPED_BY
from services.servos.family import ServoFamily, ServoReading
from services.servos.motion import AT_GOAL_RAD, JointMotion

MISSES = 3
"""A servo is silent after this many missing answers in a row."""
STALE_NS = NS // 10
"""A reading is published until it is older than this, in case that the next answer is missing."""
HOT_C = 60
GRACE_NS = NS // 2
"""Time after it was enabled in which a servo may still report its last shutdown."""
INTERRUPTED_NS = 30 * NS
"""A loss of power is reported for this long, although the servo holds again immediately."""

ServoAction = Literal["inspect", "enable", "relax"]


@dataclass(frozen=True)
class ServoTask:
    """Work to do once: inspect a servo's state, make it hold where it is, or let it go limp."""

    action: ServoAction
    number: int


@dataclass(frozen=True)
class ServoStatus:
    """A servo's state as it was inspected."""

    torque_enabled: bool
    goal: int
    position: int
    error: int


class ServoJoint:
    """The state of one joint's servo."""

    def __init__(self, joint: Joint, *, keeps_goal: bool) -> None:
        self.joint = joint
        self.motion = JointMotion(joint, keeps_goal=keeps_goal)
        self.reading: ServoReading | None = None
        self.read_ns = 0
        """Robot's clock."""
        self.misses = 0
        self.inspected = False
        """Whether its state has been read since it last was silent."""
        self.enabled = False
        self.enabled_ns = 0
        self.held = False
        """Whether it was enabled when it became silent."""
        self.interrupted_ns: int | None = None
        """When it was found to have lost its power for a moment."""
        self.relaxed = False
        """Whether it is limp on request."""
        self.fault = ""
        """Latched until `clear`."""

    @property
    def silent(self) -> bool:
        return self.misses >= MISSES

    @property
    def position_rad(self) -> float | None:
        return None if self.reading is None else self.joint.to_angle(self.reading.position)

    @property
    def obeys(self) -> bool:
        return self.inspected and self.enabled and not self.relaxed and not self.fault and not self.silent


class ServoGroup:
    """The servos of one group, all on one line. Every `now_ns` is the robot's clock."""

    def __init__(
        self, joints: Iterable[Joint], family: ServoFamily, *, keeps_goal: bool, timeout_s: float, max_age_s: float
    ) -> None:
        """A command counts for `timeout_s` from its stamp, and is refused once it is older than `max_age_s`."""
        self.joints = {joint.id: ServoJoint(joint, keeps_goal=keeps_goal) for joint in joints}
        self.latch: LatchState = "unknown"
        self.port_fault = "the port was not opened yet"
        self._by_name = {one.joint.name: one for one in self.joints.values()}
        self._family = family
        self._keeps_goal = keeps_goal
        self._timeout_ns = round(timeout_s * NS)
        self._max_age_s = max_age_s
        self._tasks: dict[int, ServoTask] = {}
        self._strays = 0
        self._disturbed = Recent()

    # --- commands -----------------------------------------------------------------------------------

    @property
    def stopped_by(self) -> str:
        return STOPPED_BY[self.latch]

    def command(self, command: ServoCommand, now_ns: int) -> str:
        """Accept all goals or none. Returns '' when accepted, otherwise the reason for refusing."""
        if self.stopped_by:
            return self.stopped_by
        if not is_fresh(command.stamp_ns, now_ns, self._max_age_s):
            return "too old"
        if unknown := [name for name in command.joints if name not in self._by_name]:
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
        before, self.latch = self.latch, state
        if state != "released":
            if before == "released" and not self._keeps_goal:
                for one in self.joints.values():
                    if (position_rad := one.position_rad) is not None and one.motion.goal_rad is not None:
                        one.motion.hold(position_rad)
            return
        if before == "latched":
            self.clear(())
        for one in self.joints.values():
            self._enable_if_due(one)

    def clear(self, names: Iterable[str]) -> list[str]:
        """Clear latched faults (of all joints when none is named) and make these joints hold again; returns their
        names."""
        cleared = []
        for one in self._named(names):
            if one.fault:
                one.fault = ""
                cleared.append(one.joint.name)
                self._enable_if_due(one)
        return cleared

    def relax(self, names: Iterable[str]) -> list[str]:
        """Let joints go limp until `hold`; returns their names."""
        for one in (chosen := self._named(names)):
            one.relaxed = True
            one.motion.goal_rad = None
            self._tasks[one.joint.id] = ServoTask("relax", one.joint.id)
        return [one.joint.name for one in chosen]

    def hold(self, names: Iterable[str]) -> list[str]:
        """Make joints hold where they are, also relaxed ones; returns their names."""
        for one in (chosen := self._named(names)):
            one.relaxed = False
            one.motion.goal_rad = None
            if one.inspected and not one.fault:
                self._tasks[one.joint.id] = ServoTask("enable", one.joint.id)
        return [one.joint.name for one in chosen]

    def unknown(self, names: Iterable[str]) -> list[str]:
        return [name for name in names if name not in self._by_name]

    def new_epoch(self) -> None:
        """The clock restarted: earlier commands and readings belong to no time of the new epoch."""
        for one in self.joints.values():
            one.motion.forget_time()
            one.read_ns = 0

    def _named(self, names: Iterable[str]) -> list[ServoJoint]:
        return [self._by_name[name] for name in names] or list(self.joints.values())

    def _enable_if_due(self, one: ServoJoint) -> None:
        if one.inspected and not one.enabled and not one.relaxed and not one.fault and self.latch == "released":
            self._tasks[one.joint.id] = ServoTask("enable", one.joint.id)

    # --- results of the line ------------------------------------------------------------------------

    def read(self, number: int, reading: ServoReading, now_ns: int) -> None:
        """A servo answered."""
        one = self.joints[number]
        one.reading, one.read_ns, one.misses = reading, now_ns, 0
        if not one.inspected:
            self._tasks.setdefault(number, ServoTask("inspect", number))
        if one.enabled and now_ns - one.enabled_ns > GRACE_NS:
            self._shut_down(one, reading.error)

    def missed(self, number: int) -> None:
        """A servo did not answer."""
        one = self.joints[number]
        one.misses += 1
        if one.silent:
            one.held = one.held or one.enabled
            one.inspected = one.enabled = False  # its state may be another one when it is back
            one.motion.goal_rad = None
            self._tasks.pop(number, None)

    def disturbed(self, strays: int, missed: int, now_ns: int) -> None:
        """Count disturbances: `strays` is the count of bytes so far that were not part of an answer, `missed` the
        number of servos that did not answer now although they are not silent."""
        self._disturbed.add(max(strays - self._strays, 0) + missed, now_ns)
        self._strays = strays

    def inspected(self, number: int, status: ServoStatus, now_ns: int) -> None:
        """A servo was inspected. If it holds already it goes on holding: the hand, or an arm joint at rest, at its
        goal, a moving arm joint where it is."""
        one = self.joints[number]
        one.inspected = True
        one.enabled = status.torque_enabled
        self._shut_down(one, status.error)
        if one.held and not one.enabled and not one.fault:  # it lost its power meanwhile, and with it its settings
            one.interrupted_ns = now_ns
        one.held = False
        if one.enabled:
            resting = abs(status.goal - status.position) * one.joint.units.count_rad <= AT_GOAL_RAD * 4
            one.motion.hold(one.joint.to_angle(status.goal if self._keeps_goal or resting else status.position))
        self._enable_if_due(one)

    def checked(self, number: int, as_set: bool, now_ns: int) -> None:
        """A servo's settings were checked, as they are periodically: a servo whose power failed for a moment has lost
        them, and is limp or has the factory's settings."""
        one = self.joints[number]
        if not one.obeys or as_set or number in self._tasks:
            return
        if one.reading is not None and one.reading.error & self._family.shutdowns:  # it has shut down since
            self._shut_down(one, one.reading.error)
            return
        one.interrupted_ns = now_ns
        self._tasks[number] = ServoTask("enable", number)

    def done(self, task: ServoTask, position: int, now_ns: int) -> None:
        """A task was done, with the servo at `position` (counts)."""
        one = self.joints[task.number]
        one.enabled, one.enabled_ns = task.action == "enable", now_ns
        if one.enabled:
            one.motion.hold(one.joint.to_angle(position))

    def port_lost(self, why: str) -> None:
        """The line failed: all servos are silent."""
        self.port_fault = why
        for number, one in self.joints.items():
            one.misses = max(one.misses, MISSES - 1)
            self.missed(number)

    def refused(self, task: ServoTask, why: str) -> None:
        """A servo refused a task."""
        self._fault(self.joints[task.number], why)

    def _shut_down(self, one: ServoJoint, error: int) -> None:
        if error & self._family.shutdowns:
            self._fault(one, " and ".join(self._family.errors_in(error & self._family.shutdowns)))

    def _fault(self, one: ServoJoint, what: str) -> None:
        if not one.fault:
            one.fault = what
            one.enabled = False
            one.motion.goal_rad = None

    # --- work for the line --------------------------------------------------------------------------

    def next_task(self) -> ServoTask | None:
        """Take the next task; `again` puts it back when it fails."""
        return self._tasks.pop(next(iter(self._tasks))) if self._tasks else None

    def again(self, task: ServoTask) -> None:
        """A task failed: try it again, unless the servo is silent."""
        if not self.joints[task.number].silent:
            self._tasks.setdefault(task.number, task)

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
            stopped_by=self.stopped_by,
        )

    def latched_faults(self) -> tuple[str, ...]:
        return tuple(f"{one.joint.name}: {one.fault}" for one in self.joints.values() if one.fault)

    def silent_joints(self) -> list[str]:
        return [f"{one.joint.name} (ID {number})" for number, one in self.joints.items() if one.silent]

    def faults(self, now_ns: int) -> tuple[str, ...]:
        """All current faults, for people."""
        if self.port_fault:
            return (self.port_fault,)
        found = [f"{fault}; `cocoro servos clear`" for fault in self.latched_faults()]
        found += [f"{name} does not answer" for name in self.silent_joints()]
        if damage := self._disturbed.total(now_ns):
            found.append(f"the line is disturbed, check its cables: {damage} damaged bytes in {WINDOW_S:g} s")
        low_v, high_v = self._family.volts
        for one in self.joints.values():
            name = one.joint.name
            if one.relaxed:
                found.append(f"{name} is limp; `cocoro servos hold`")
            if one.interrupted_ns is not None and 0 <= now_ns - one.interrupted_ns < INTERRUPTED_NS:
                found.append(f"{name} lost its settings a moment ago, and got them back: check its power")
            if one.reading is None or one.silent:
                continue
            if one.reading.temperature_c >= HOT_C:
                found.append(f"{name} is hot: {one.reading.temperature_c} C")
            if not low_v <= one.reading.voltage_v <= high_v:
                found.append(f"{name} has a bad voltage: {one.reading.voltage_v:.1f} V")
        return tuple(found)
