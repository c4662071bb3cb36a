"""One cycle of a servo line: the newest orders are written, every servo is read, and at most one task is done.

It knows the bus and nothing of threads: the thread of the line calls it, and so do tests, in virtual time.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Container, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

from services.servos.bus import RefusedWriteError, ServoBus, SilentError
from services.servos.family import ServoFamily, ServoReading
from services.servos.motion import HOLD_RADPS
from services.servos.orders import GroupOrders
from services.servos.watch import MISSES, ServoStatus, ServoTask, ServoWatch
from services.servos.wheel_orders import WheelOrders

PROBE_S = 0.2
"""Period at which one silent servo is tried again. More often would take too much time from the others."""
CHECK_CYCLES = 8
"""Once in this many cycles the settings of one servo are checked."""
STATE = "torque_enable", "torque_limit"
"""The first and the last register of a servo's state. Its length differs from that of a reading."""
WHEEL_MISSES = 2
"""A wheel that does not answer so often in a row stops all wheels, before it counts as silent."""

LAST_STOPS = 5
"""So often wheels are told to stop at the end: one packet may be lost."""


@dataclass
class CycleResult:
    """The results of one cycle, by servo ID."""

    readings: dict[int, ServoReading] = field(default_factory=dict)
    missed: list[int] = field(default_factory=list)
    inspected: dict[int, ServoStatus] = field(default_factory=dict)
    checked: dict[int, bool] = field(default_factory=dict)
    """Whether a servo's torque is on and its settings are the configured ones."""
    done: list[tuple[ServoTask, int]] = field(default_factory=list)
    """Tasks that were done, with the servo's position, counts."""
    failed: list[ServoTask] = field(default_factory=list)
    refused: list[tuple[ServoTask, str]] = field(default_factory=list)
    port_fault: str = ""
    busy_s: float = 0.0
    """Duration of the cycle."""
    strays: int = 0
    spun_mps: tuple[float, ...] = ()
    """By wheel, the speed that was ordered; none without wheels."""

    def of(self, numbers: Container[int]) -> CycleResult:
        """What it says of the line, and of these servos."""
        return replace(
            self,
            readings={number: reading for number, reading in self.readings.items() if number in numbers},
            missed=[number for number in self.missed if number in numbers],
            inspected={number: status for number, status in self.inspected.items() if number in numbers},
            checked={number: as_set for number, as_set in self.checked.items() if number in numbers},
            done=[(task, position) for task, position in self.done if task.number in numbers],
            failed=[task for task in self.failed if task.number in numbers],
            refused=[(task, why) for task, why in self.refused if task.number in numbers],
        )

    def tell(self, core: ServoWatch[Any], now_ns: int, monotonic_ns: int) -> None:
        """Tell a core of its servos, which are all that this result is of. It is `now_ns` by the core's clock and
        `monotonic_ns` by that of the readings."""
        core.port_fault = self.port_fault
        if self.port_fault:
            core.port_lost(self.port_fault)
        for number, reading in self.readings.items():
            core.read(number, reading, now_ns - max(monotonic_ns - reading.at_ns, 0))
        missed = [number for number in self.missed if not core.servos[number].silent]
        core.disturbed(self.strays, len(missed), now_ns)
        for number in self.missed:
            core.missed(number)
        for number, status in self.inspected.items():
            core.inspected(number, status, now_ns)
        for number, as_set in self.checked.items():
            core.checked(number, as_set, now_ns)
        for task, position in self.done:
            core.done(task, position, now_ns)
        for task, why in self.refused:
            core.refused(task, why)
        for task in self.failed:
            core.again(task)
        core.moved(self.spun_mps, now_ns)


class LineCycle:
    """`now_s` is CLOCK_MONOTONIC, s."""

    def __init__(
        self,
        family: ServoFamily,
        settings: Mapping[int, Mapping[str, int]],
        orders: Sequence[GroupOrders],
        wheels: WheelOrders | None = None,
    ) -> None:
        """`settings`: by servo ID, the registers that are written before the servo is enabled. `orders`: those of each
        group whose servos are on the line; `wheels`: those of the wheels, if their servos are."""
        self._family = family
        self._hold_speed = round(HOLD_RADPS / family.units.speed_radps)
        self._settings = settings
        self._orders = orders
        self._wheels = wheels
        self._turning: Collection[int] = () if wheels is None else wheels.numbers
        self._misses = dict.fromkeys(settings, 0)
        self._probed_s = 0.0
        self._next_probe = 0
        self._cycles = 0

    def begin(self, bus: ServoBus, now_s: float) -> None:
        """The line was opened. Whoever had it before may have left wheels turning: they are stopped first of all."""
        self._misses = dict.fromkeys(self._misses, 0)
        if self._wheels is not None:
            bus.spin(self._wheels.begin(now_s))

    def end(self, bus: ServoBus) -> None:
        """The line will be closed: stop the wheels, which turn on by themselves."""
        if self._wheels is not None:
            for _ in range(LAST_STOPS):
                bus.spin(self._wheels.rest)

    def run(self, bus: ServoBus, clock: Callable[[], float], task: ServoTask | None) -> CycleResult:
        """`clock` gives `now_s`. Raises PortError when the line fails."""
        started_s = clock()
        result = CycleResult()
        self._order(bus, started_s)
        for number in self._to_read(started_s):
            self._read(bus, number, result)
            if number in result.missed:  # waiting for it took longer than all the others together
                self._spin(bus, clock())
        self._hold(bus, result.readings)
        if task is not None:
            self._do(task, bus, result)
        self._check(bus, result)
        if self._wheels is not None:
            result.spun_mps = self._wheels.spun_mps
        result.busy_s = clock() - started_s
        result.strays = bus.strays
        return result

    def _order(self, bus: ServoBus, now_s: float) -> None:
        """Write what is due of all groups' orders."""
        goals: dict[int, tuple[int, int]] = {}
        for one in self._orders:
            goals |= one.due(now_s)
        bus.go(goals)
        self._spin(bus, now_s)

    def _spin(self, bus: ServoBus, now_s: float) -> None:
        """Write what the wheels are to do now, and let their guard know that it was written."""
        if self._wheels is not None:
            answering = all(self._misses[number] < WHEEL_MISSES for number in self._turning)
            bus.spin(self._wheels.due(now_s, answering=answering))
            self._wheels.written()

    def _hold(self, bus: ServoBus, readings: Mapping[int, ServoReading]) -> None:
        """Make the servos that were halted hold where they were just read."""
        held: dict[int, tuple[int, int]] = {}
        for one in self._orders:
            held |= one.hold(readings, self._hold_speed)
        if held:
            bus.go(held)

    def _to_read(self, now_s: float) -> Collection[int]:
        """The servos to read in this cycle: all that answer, and at times one of those that do not."""
        alive = [number for number, misses in self._misses.items() if misses < MISSES]
        silent = [number for number, misses in self._misses.items() if misses >= MISSES]
        if silent and (not alive or now_s - self._probed_s > PROBE_S):
            self._probed_s = now_s
            self._next_probe += 1
            return [*alive, silent[self._next_probe % len(silent)]]
        return alive

    def _read(self, bus: ServoBus, number: int, result: CycleResult) -> None:
        try:
            result.readings[number] = bus.reading(number)
            self._misses[number] = 0
        except SilentError:
            result.missed.append(number)
            self._misses[number] += 1

    def _do(self, task: ServoTask, bus: ServoBus, result: CycleResult) -> None:
        try:
            if task.action == "inspect":
                result.inspected[task.number] = self._inspect(bus, task.number)
            else:
                position = self._enable(bus, task.number) if task.action == "enable" else self._relax(bus, task.number)
                result.done.append((task, position))
        except SilentError:
            result.failed.append(task)
        except RefusedWriteError as error:
            result.refused.append((task, str(error)))

    def _inspect(self, bus: ServoBus, number: int) -> ServoStatus:
        state = self._state(bus, number)
        reading = bus.reading(number)
        enabled = bool(state["torque_enable"])
        if number in self._turning:
            self._refuse_unless_wheel(bus, number)
        elif enabled and bus.is_wheel(number):
            self._relax(bus, number)
            enabled = False
        if enabled and not reading.error & self._family.shutdowns:  # it holds already, but perhaps with other settings
            self._set(bus, number)
        return ServoStatus(enabled, state["goal_position"], reading.position, reading.error)

    def _set(self, bus: ServoBus, number: int) -> None:
        for register, value in self._settings[number].items():
            bus.write(number, register, value)

    def _enable(self, bus: ServoBus, number: int) -> int:
        """Make a servo hold where it is; returns its position, counts. Speed and limits are written before anything
        that could make it move, and its goal is set to its position before its torque is switched on. The goal is read
        back, since a late confirmation may belong to another instruction. Raises RefusedWriteError for a wheel."""
        if number in self._turning:
            return self._enable_wheel(bus, number)
        if bus.is_wheel(number):
            raise RefusedWriteError(f"servo {number} is set up as a wheel, which turns endlessly")
        bus.write(number, "moving_speed", self._hold_speed)
        self._set(bus, number)
        self._revive(bus, number)
        position = bus.reading(number).position
        bus.write(number, "goal_position", position)
        if self._state(bus, number)["goal_position"] != position:
            raise SilentError(number)
        bus.write(number, "torque_enable", 1)
        return position

    def _enable_wheel(self, bus: ServoBus, number: int) -> int:
        """Make a wheel's servo brake; returns its position, counts. Its speed is 0 before its torque is switched on."""
        self._refuse_unless_wheel(bus, number)
        bus.write(number, "moving_speed", 0)
        self._set(bus, number)
        self._revive(bus, number)
        bus.write(number, "torque_enable", 1)
        return bus.reading(number).position

    def _refuse_unless_wheel(self, bus: ServoBus, number: int) -> None:
        """A servo that is not set up as a wheel may be one of the arm with a wrong ID."""
        if not bus.is_wheel(number):
            raise RefusedWriteError(f"servo {number} is not set up as a wheel: `cocoro servos set-wheel {number}`")

    def _revive(self, bus: ServoBus, number: int) -> None:
        """Write what ends a shutdown, if it has shut down."""
        if bus.reading(number).error & self._family.shutdowns:
            for register, value in self._family.revival.items():
                bus.write(number, register, value)

    def _relax(self, bus: ServoBus, number: int) -> int:
        bus.write(number, "torque_enable", 0)
        return bus.reading(number).position

    def _check(self, bus: ServoBus, result: CycleResult) -> None:
        self._cycles += 1
        number = list(self._misses)[self._cycles // CHECK_CYCLES % len(self._misses)]
        if self._cycles % CHECK_CYCLES == 0 and self._misses[number] == 0 and number not in result.missed:
            with suppress(SilentError, RefusedWriteError):
                result.checked[number] = self._is_as_set(bus, number)

    def _is_as_set(self, bus: ServoBus, number: int) -> bool:
        state = self._state(bus, number)
        return all(
            state[register] == value for register, value in {"torque_enable": 1, **self._settings[number]}.items()
        )

    def _state(self, bus: ServoBus, number: int) -> dict[str, int]:
        """Read the registers of a servo that are written while it runs. Always this whole block: an answer does not say
        what it answers, and by its length a late one cannot be taken for the answer to another request, such as
        `ServoBus.reading`."""
        address, length = self._family.block(*STATE)
        data, _ = bus.read_block(number, address, length)
        if len(data) < length:
            raise SilentError(number)
        return {
            name: int.from_bytes(data[row.address - address : row.address - address + row.size], "little")
            for name, row in self._family.registers.items()
            if address <= row.address < address + length
        }
