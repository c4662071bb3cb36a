"""One servo network as the service sees it: readings in, orders and state out, faults and what to do about them. Pure.

Who talks to the line is told what to do in two ways: `orders`, which are written again and again, and `tasks`, things
to do once with one servo.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from cocoro.clock import NS, is_fresh
from cocoro.health import WINDOW_S, Recent
from cocoro.messages import LatchState, ServoCommand, ServoState
from cocoro.robot import Joint
from services.servos import table
from services.servos.motion import AT_GOAL_COUNTS, JointMotion
from services.servos.table import ServoReading

MISSES = 3
"""A servo that does not answer so often in a row is silent."""
STALE_NS = NS // 10
"""A reading may be told again for so long while its servo is being asked once more."""
HOT_C = 60
LOW_V, HIGH_V = 9.0, 16.0
GRACE_NS = NS // 2
"""After it was enabled a servo may speak of its last shutdown for so long."""
INTERRUPTED_NS = 30 * NS
"""A loss of power is told for so long, though the servo holds again at once."""

ServoAction = Literal["meet", "enable", "relax"]


@dataclass(frozen=True)
class ServoTask:
    """Something to do once: see what state a servo is in, make it hold where it is, let it go limp."""

    what: ServoAction
    number: int


@dataclass(frozen=True)
class ServoStatus:
    """What a servo said when it was met."""

    torque_enabled: bool
    goal: int
    position: int
    error: int


class ServoJoint:
    """What is known of one joint's servo."""

    def __init__(self, joint: Joint, *, keeps_goal: bool) -> None:
        self.joint = joint
        self.motion = JointMotion(joint, keeps_goal=keeps_goal)
        self.reading: ServoReading | None = None
        self.read_ns = 0
        """By the robot's clock."""
        self.misses = 0
        self.met = False
        self.enabled = False
        self.enabled_ns = 0
        self.held = False
        """When it fell silent."""
        self.interrupted_ns: int | None = None
        self.relaxed = False
        """On somebody's word."""
        self.fault = ""
        """Latched."""

    @property
    def silent(self) -> bool:
        return self.misses >= MISSES

    @property
    def position_rad(self) -> float | None:
        return None if self.reading is None else self.joint.to_angle(self.reading.position)

    @property
    def obeys(self) -> bool:
        return self.met and self.enabled and not self.relaxed and not self.fault and not self.silent


class ServoNetwork:
    """Told the robot's time with every call."""

    def __init__(self, joints: Iterable[Joint], *, keeps_goal: bool, timeout_s: float, max_age_s: float) -> None:
        """A command counts for `timeout_s` from its stamp, and is refused once it is older than `max_age_s`."""
        self.joints = {joint.id: ServoJoint(joint, keeps_goal=keeps_goal) for joint in joints}
        self.latch: LatchState = "unknown"
        self.port_fault = "the port was not opened yet"
        self._by_name = {one.joint.name: one for one in self.joints.values()}
        self._keeps_goal = keeps_goal
        self._timeout_ns = round(timeout_s * NS)
        self._max_age_s = max_age_s
        self._tasks: dict[int, ServoTask] = {}
        self._strays = 0
        self._disturbed = Recent()

    # --- commands -----------------------------------------------------------------------------------

    @property
    def stopped_by(self) -> str:
        return {"released": "", "latched": "estop", "unknown": "latch unknown"}[self.latch]

    def command(self, command: ServoCommand, now_ns: int) -> str:
        """Take the goals, all or none. Returns '' when taken, otherwise why not."""
        if self.stopped_by:
            return self.stopped_by
        if not is_fresh(command.stamp_ns, now_ns, self._max_age_s):
            return "too old"
        if unknown := [name for name in command.joints if name not in self._by_name]:
            return f"no joint {unknown[0]!r} on this network, which has {', '.join(self._by_name)}"
        until_ns = min(command.stamp_ns, now_ns) + self._timeout_ns
        for name, goal_rad, speed_radps in zip(command.joints, command.goal_rad, command.speed_radps, strict=True):
            one = self._by_name[name]
            if one.obeys and (position_rad := one.position_rad) is not None:
                one.motion.command(goal_rad, speed_radps, position_rad, until_ns)
        return ""

    def set_latch(self, state: LatchState) -> None:
        """Latched and unknown hold the arm and neck where they are; a release lets what is limp hold again, and after
        an emergency stop it clears the faults."""
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
        """Forget latched faults (of all joints when none is named) and have those joints hold again; their names."""
        cleared = []
        for one in self._named(names):
            if one.fault:
                one.fault = ""
                cleared.append(one.joint.name)
                self._enable_if_due(one)
        return cleared

    def relax(self, names: Iterable[str]) -> list[str]:
        """Let joints go limp until `hold`; their names."""
        for one in (chosen := self._named(names)):
            one.relaxed = True
            one.motion.goal_rad = None
            self._tasks[one.joint.id] = ServoTask("relax", one.joint.id)
        return [one.joint.name for one in chosen]

    def hold(self, names: Iterable[str]) -> list[str]:
        """Have joints hold where they are, also such as were relaxed; their names."""
        for one in (chosen := self._named(names)):
            one.relaxed = False
            one.motion.goal_rad = None
            if one.met and not one.fault:
                self._tasks[one.joint.id] = ServoTask("enable", one.joint.id)
        return [one.joint.name for one in chosen]

    def unknown(self, names: Iterable[str]) -> list[str]:
        return [name for name in names if name not in self._by_name]

    def new_epoch(self) -> None:
        """The clock began anew: what was commanded before is of no time that there is."""
        for one in self.joints.values():
            one.motion.forget_time()
            one.read_ns = 0

    def _named(self, names: Iterable[str]) -> list[ServoJoint]:
        return [self._by_name[name] for name in names] or list(self.joints.values())

    def _enable_if_due(self, one: ServoJoint) -> None:
        if one.met and not one.enabled and not one.relaxed and not one.fault and self.latch == "released":
            self._tasks[one.joint.id] = ServoTask("enable", one.joint.id)

    # --- what was heard -----------------------------------------------------------------------------

    def heard(self, number: int, reading: ServoReading, now_ns: int) -> None:
        one = self.joints[number]
        one.reading, one.read_ns, one.misses = reading, now_ns, 0
        if not one.met:
            self._tasks.setdefault(number, ServoTask("meet", number))
        if one.enabled and now_ns - one.enabled_ns > GRACE_NS:
            self._shut_down(one, reading.error)

    def missed(self, number: int) -> None:
        """It did not answer."""
        one = self.joints[number]
        one.misses += 1
        if one.silent:
            one.held = one.held or one.enabled
            one.met = one.enabled = False  # who knows what it is like when it comes back
            one.motion.goal_rad = None
            self._tasks.pop(number, None)

    def disturbed(self, strays: int, missed: int, now_ns: int) -> None:
        """So many bytes so far that were no part of an answer, and so many servos now that did not answer, though they
        are not silent."""
        self._disturbed.add(max(strays - self._strays, 0) + missed, now_ns)
        self._strays = strays

    def met(self, number: int, met: ServoStatus, now_ns: int) -> None:
        """What a servo was found to be like. One that holds already goes on holding: the hand what it holds, the arm
        where it is unless it was there for long."""
        one = self.joints[number]
        one.met = True
        one.enabled = met.torque_enabled
        self._shut_down(one, met.error)
        if one.held and not one.enabled and not one.fault:  # it lost its power meanwhile, and with it all that was set
            one.interrupted_ns = now_ns
        one.held = False
        if one.enabled:
            resting = abs(met.goal - met.position) <= AT_GOAL_COUNTS * 4
            one.motion.hold(one.joint.to_angle(met.goal if self._keeps_goal or resting else met.position))
        self._enable_if_due(one)

    def checked(self, number: int, as_set: bool, now_ns: int) -> None:
        """Whether a servo still has what was written into it, looked at now and then: one whose power failed for a
        moment has not, and would go on limp or with the settings of the factory."""
        one = self.joints[number]
        if not one.obeys or as_set or number in self._tasks:
            return
        if one.reading is not None and one.reading.error & table.SHUTDOWNS:  # it let go by itself, just after it held
            self._shut_down(one, one.reading.error)
            return
        one.interrupted_ns = now_ns
        self._tasks[number] = ServoTask("enable", number)

    def done(self, task: ServoTask, position: int, now_ns: int) -> None:
        """A task was done, with the servo there."""
        one = self.joints[task.number]
        one.enabled, one.enabled_ns = task.what == "enable", now_ns
        if one.enabled:
            one.motion.hold(one.joint.to_angle(position))

    def port_lost(self, why: str) -> None:
        self.port_fault = why
        for number, one in self.joints.items():
            one.misses = max(one.misses, MISSES - 1)
            self.missed(number)

    def refused(self, task: ServoTask, why: str) -> None:
        """A servo would not do what a task asks."""
        self._fault(self.joints[task.number], why)

    def _shut_down(self, one: ServoJoint, error: int) -> None:
        if error & table.SHUTDOWNS:
            self._fault(one, " and ".join(table.errors_in(error & table.SHUTDOWNS)))

    def _fault(self, one: ServoJoint, what: str) -> None:
        if not one.fault:
            one.fault = what
            one.enabled = False
            one.motion.goal_rad = None

    # --- what to do ---------------------------------------------------------------------------------

    def next_task(self) -> ServoTask | None:
        """The next thing to do once; it is forgotten here, and comes again when it did not succeed."""
        return self._tasks.pop(next(iter(self._tasks))) if self._tasks else None

    def again(self, task: ServoTask) -> None:
        """A task did not succeed."""
        if not self.joints[task.number].silent:
            self._tasks.setdefault(task.number, task)

    def orders(self, now_ns: int) -> dict[int, tuple[int, int]]:
        """Goal and speed in counts, by servo, of those that obey."""
        orders = {}
        for number, one in self.joints.items():
            if one.obeys and (position_rad := one.position_rad) is not None:
                order = one.motion.order(position_rad, now_ns)
                if order is not None:
                    orders[number] = order
        return orders

    # --- what it is like ----------------------------------------------------------------------------

    def state(self, now_ns: int) -> ServoState | None:
        """Of the joints that were heard of late; None when there is none."""
        heard = [
            (one, one.reading, one.read_ns)
            for one in self.joints.values()
            if one.reading is not None and not one.silent and 0 <= now_ns - one.read_ns <= STALE_NS
        ]
        if not heard:
            return None
        return ServoState(
            stamp_ns=sum(read_ns for _, _, read_ns in heard) // len(heard),
            joints=tuple(one.joint.name for one, _, _ in heard),
            position_rad=tuple(one.joint.to_angle(reading.position) for one, reading, _ in heard),
            speed_radps=tuple(one.joint.direction * reading.speed * table.SPEED_RADPS for one, reading, _ in heard),
            load=tuple(one.joint.direction * reading.load / table.FULL_TORQUE for one, reading, _ in heard),
            temperature_c=tuple(float(reading.temperature_c) for _, reading, _ in heard),
            voltage_v=tuple(reading.voltage_v for _, reading, _ in heard),
            torque_enabled=tuple(one.enabled for one, _, _ in heard),
            faults=self.latched_faults(),
            latch=self.latch,
            stopped_by=self.stopped_by,
        )

    def latched_faults(self) -> tuple[str, ...]:
        return tuple(f"{one.joint.name}: {one.fault}" for one in self.joints.values() if one.fault)

    def silent_joints(self) -> list[str]:
        return [f"{one.joint.name} (ID {number})" for number, one in self.joints.items() if one.silent]

    def faults(self, now_ns: int) -> tuple[str, ...]:
        """All that is wrong now, for people."""
        if self.port_fault:
            return (self.port_fault,)
        found = [f"{fault}; `cocoro servos clear`" for fault in self.latched_faults()]
        found += [f"{name} does not answer" for name in self.silent_joints()]
        if damage := self._disturbed.total(now_ns):
            found.append(f"the line is disturbed, look after its cables: {damage} damaged bytes in {WINDOW_S:g} s")
        for one in self.joints.values():
            name = one.joint.name
            if one.relaxed:
                found.append(f"{name} is limp; `cocoro servos hold`")
            if one.interrupted_ns is not None and 0 <= now_ns - one.interrupted_ns < INTERRUPTED_NS:
                found.append(f"{name} lost its settings a moment ago, and got them back: look after its power")
            if one.reading is None or one.silent:
                continue
            if one.reading.temperature_c >= HOT_C:
                found.append(f"{name} is hot: {one.reading.temperature_c} C")
            if not LOW_V <= one.reading.voltage_v <= HIGH_V:
                found.append(f"{name} has a bad voltage: {one.reading.voltage_v:.1f} V")
        return tuple(found)
