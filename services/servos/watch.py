"""What is known of servos that one service is in charge of: who answers, who holds, what ails them. Pure.

What they are for is another matter: `group` moves joints, `wheels` turns wheels. The line gets two kinds of work:
orders, which it writes in every cycle, and tasks, each done once with one servo.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Generic, Literal, TypeVar

from cocoro.clock import NS
from cocoro.health import WINDOW_S, Recent
from cocoro.messages import LatchState
from services.servos.family import ServoFamily, ServoReading

MISSES = 3
"""A servo is silent after this many missing answers in a row."""
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


class WatchedServo:
    """The state of one servo."""

    def __init__(self, name: str, number: int) -> None:
        self.name = name
        """Of what it turns."""
        self.number = number
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
    def obeys(self) -> bool:
        return self.inspected and self.enabled and not self.relaxed and not self.fault and not self.silent

    def let_go(self) -> None:
        """Forget what it was to do."""

    def hold_at(self, position: int) -> None:
        """It was enabled at this position, counts."""

    def go_on(self, status: ServoStatus) -> None:
        """It was found enabled."""


W = TypeVar("W", bound=WatchedServo)


class ServoWatch(ABC, Generic[W]):
    """Every `now_ns` is the robot's clock."""

    remedy = "cocoro servos clear"
    """The command that clears latched faults."""

    def __init__(self, servos: Iterable[W], family: ServoFamily) -> None:
        self.servos = {one.number: one for one in servos}
        self.port_fault = "the port was not opened yet"
        self._by_name = {one.name: one for one in self.servos.values()}
        self._family = family
        self._tasks: dict[int, ServoTask] = {}
        self._strays = 0
        self._disturbed = Recent()

    @property
    @abstractmethod
    def latch(self) -> LatchState:
        """The emergency stop's; servos are enabled while it is released."""

    @abstractmethod
    def stopped_by(self, now_ns: int) -> str:
        """Why commands are not obeyed; '' when they are."""

    @abstractmethod
    def new_epoch(self) -> None:
        """The clock restarted: earlier commands and readings belong to no time of the new epoch."""

    def moved(self, spun_mps: Sequence[float], now_ns: int) -> None:
        """A cycle has ended; all else of it is told already. `spun_mps`: what was ordered of the wheels, if any are on
        the line."""

    # --- requests -----------------------------------------------------------------------------------

    def clear(self, names: Iterable[str]) -> list[str]:
        """Clear latched faults (of all servos when none is named) and enable these servos again; returns their
        names."""
        cleared = []
        for one in self._named(names):
            if one.fault:
                one.fault = ""
                cleared.append(one.name)
                self._enable_if_due(one)
        return cleared

    def relax(self, names: Iterable[str]) -> list[str]:
        """Let servos go limp until `hold`; returns their names."""
        for one in (chosen := self._named(names)):
            one.relaxed = True
            one.let_go()
            self._tasks[one.number] = ServoTask("relax", one.number)
        return [one.name for one in chosen]

    def hold(self, names: Iterable[str]) -> list[str]:
        """Make servos hold where they are, also relaxed ones; returns their names."""
        for one in (chosen := self._named(names)):
            one.relaxed = False
            one.let_go()
            if one.inspected and not one.fault:
                self._tasks[one.number] = ServoTask("enable", one.number)
        return [one.name for one in chosen]

    def unknown(self, names: Iterable[str]) -> list[str]:
        return [name for name in names if name not in self._by_name]

    def _named(self, names: Iterable[str]) -> list[W]:
        return [self._by_name[name] for name in names] or list(self.servos.values())

    def _released(self, before: LatchState) -> None:
        """The emergency stop is released: enable servos that are not. After a stop this also clears the faults."""
        if before == "latched":
            self.clear(())
        for one in self.servos.values():
            self._enable_if_due(one)

    def _enable_if_due(self, one: W) -> None:
        if one.inspected and not one.enabled and not one.relaxed and not one.fault and self.latch == "released":
            self._tasks[one.number] = ServoTask("enable", one.number)

    # --- results of the line ------------------------------------------------------------------------

    def read(self, number: int, reading: ServoReading, now_ns: int) -> None:
        """A servo answered."""
        one = self.servos[number]
        one.reading, one.read_ns, one.misses = reading, now_ns, 0
        if not one.inspected:
            self._tasks.setdefault(number, ServoTask("inspect", number))
        if one.enabled and now_ns - one.enabled_ns > GRACE_NS:
            self._shut_down(one, reading.error)

    def missed(self, number: int) -> None:
        """A servo did not answer."""
        one = self.servos[number]
        one.misses += 1
        if one.silent:
            one.held = one.held or one.enabled
            one.inspected = one.enabled = False  # its state may be another one when it is back
            one.let_go()
            self._tasks.pop(number, None)

    def disturbed(self, strays: int, missed: int, now_ns: int) -> None:
        """Count disturbances: `strays` is the count of bytes so far that were not part of an answer, `missed` the
        number of servos that did not answer now although they are not silent."""
        self._disturbed.add(max(strays - self._strays, 0) + missed, now_ns)
        self._strays = strays

    def inspected(self, number: int, status: ServoStatus, now_ns: int) -> None:
        """A servo was inspected. If it holds already it goes on holding."""
        one = self.servos[number]
        one.inspected = True
        one.enabled = status.torque_enabled
        self._shut_down(one, status.error)
        if one.held and not one.enabled and not one.fault:  # it lost its power meanwhile, and with it its settings
            one.interrupted_ns = now_ns
        one.held = False
        if one.enabled:
            one.go_on(status)
        self._enable_if_due(one)

    def checked(self, number: int, as_set: bool, now_ns: int) -> None:
        """A servo's settings were checked, as they are periodically: a servo whose power failed for a moment has lost
        them, and is limp or has the factory's settings."""
        one = self.servos[number]
        if not one.obeys or as_set or number in self._tasks:
            return
        if one.reading is not None and one.reading.error & self._family.shutdowns:  # it has shut down since
            self._shut_down(one, one.reading.error)
            return
        one.interrupted_ns = now_ns
        self._tasks[number] = ServoTask("enable", number)

    def done(self, task: ServoTask, position: int, now_ns: int) -> None:
        """A task was done, with the servo at `position` (counts)."""
        one = self.servos[task.number]
        one.enabled, one.enabled_ns = task.action == "enable", now_ns
        if one.enabled:
            one.hold_at(position)

    def port_lost(self, why: str) -> None:
        """The line failed: all servos are silent."""
        self.port_fault = why
        for number, one in self.servos.items():
            one.misses = max(one.misses, MISSES - 1)
            self.missed(number)

    def refused(self, task: ServoTask, why: str) -> None:
        """A servo refused a task."""
        self._fault(self.servos[task.number], why)

    def _shut_down(self, one: W, error: int) -> None:
        if error & self._family.shutdowns:
            self._fault(one, " and ".join(self._family.errors_in(error & self._family.shutdowns)))

    def _fault(self, one: W, what: str) -> None:
        if not one.fault:
            one.fault = what
            one.enabled = False
            one.let_go()

    # --- work for the line --------------------------------------------------------------------------

    def next_task(self) -> ServoTask | None:
        """Take the next task; `again` puts it back when it fails."""
        return self._tasks.pop(next(iter(self._tasks))) if self._tasks else None

    def again(self, task: ServoTask) -> None:
        """A task failed: try it again, unless the servo is silent."""
        if not self.servos[task.number].silent:
            self._tasks.setdefault(task.number, task)

    # --- faults -------------------------------------------------------------------------------------

    def latched_faults(self) -> tuple[str, ...]:
        return tuple(f"{one.name}: {one.fault}" for one in self.servos.values() if one.fault)

    def silent_servos(self) -> list[str]:
        return [f"{one.name} (ID {number})" for number, one in self.servos.items() if one.silent]

    def faults(self, now_ns: int) -> tuple[str, ...]:
        """All current faults, for people."""
        if self.port_fault:
            return (self.port_fault,)
        found = [f"{fault}; `{self.remedy}`" for fault in self.latched_faults()]
        found += [f"{name} does not answer" for name in self.silent_servos()]
        if damage := self._disturbed.total(now_ns):
            found.append(f"the line is disturbed, check its cables: {damage} damaged bytes in {WINDOW_S:g} s")
        for one in self.servos.values():
            found += self._ailments(one, now_ns)
        return tuple(found)

    def _ailments(self, one: W, now_ns: int) -> Sequence[str]:
        """What a servo that may work all the same should not have."""
        found = []
        low_v, high_v = self._family.volts
        if one.relaxed:
            found.append(f"{one.name} is limp; `cocoro servos hold`")
        if one.interrupted_ns is not None and 0 <= now_ns - one.interrupted_ns < INTERRUPTED_NS:
            found.append(f"{one.name} lost its settings a moment ago, and got them back: check its power")
        if one.reading is None or one.silent:
            return found
        if one.reading.temperature_c >= HOT_C:
            found.append(f"{one.name} is hot: {one.reading.temperature_c} C")
        if not low_v <= one.reading.voltage_v <= high_v:
            found.append(f"{one.name} has a bad voltage: {one.reading.voltage_v:.1f} V")
        return found
