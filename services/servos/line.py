"""The thread that talks to a servo line, so that the event loop never waits for a wire.

In each cycle it writes the newest orders by one sync write, reads every servo, and does at most one task. It passes the
results to the event loop as a `CycleResult`. The two share only the newest orders and the queue of tasks.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue

from services.servos.bus import PortError, RefusedWriteError, ServoBus, SilentError
from services.servos.family import ServoFamily, ServoReading
from services.servos.motion import HOLD_RADPS
from services.servos.network import MISSES, ServoStatus, ServoTask

log = logging.getLogger("cocoro.servos")

REOPEN_S = 0.3
PROBE_S = 0.2
"""Period at which one silent servo is tried again. More often would take too much time from the others."""
CHECK_CYCLES = 8
"""Once in this many cycles the settings of one servo are checked."""
ORDERS_S = 0.2
"""Orders expire when they are not renewed for this long, as when the event loop hangs."""
STATE = "torque_enable", "torque_limit"
"""The first and the last register of a servo's state. Its length differs from that of a reading."""


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


class ServoLine:
    """Calls `on_cycle(result)` in the event loop in which it was made. Call `start`, and `stop` at the end."""

    def __init__(
        self,
        path: str,
        baud: int,
        family: ServoFamily,
        settings: Mapping[int, Mapping[str, int]],
        rate_hz: float,
        reply_s: float,
        on_cycle: Callable[[CycleResult], None],
        keeps_goal: bool = False,
    ) -> None:
        """`settings`: by servo ID, the registers that are written before the servo is enabled. `keeps_goal`: when
        halted, servos still go to their last goal, so that the hand keeps its grip."""
        self._open: Callable[[], ServoBus] = lambda: ServoBus(path, baud, reply_s, family)
        self._family = family
        self._hold_speed = round(HOLD_RADPS / family.units.speed_radps)
        self._settings = settings
        self._period_s = 1.0 / rate_hz
        self._on_cycle = on_cycle
        self._keeps_goal = keeps_goal
        self._loop = asyncio.get_running_loop()
        self._ended = threading.Event()
        self._tasks: SimpleQueue[ServoTask] = SimpleQueue()
        self._orders: tuple[float, Mapping[int, tuple[int, int]]] = (0.0, {})
        self._halted = False
        self._held: dict[int, tuple[int, int]] = {}
        """Position at which each servo is held since the line was halted, and the speed to hold it with; counts."""
        self._misses = dict.fromkeys(settings, 0)
        self._probed_s = 0.0
        self._next_probe = 0
        self._cycles = 0
        self._thread = threading.Thread(target=self._run, name=f"servos {path}", daemon=True)

    def start(self) -> None:
        self._thread.start()

    async def stop(self) -> None:
        self._ended.set()
        await self._loop.run_in_executor(None, self._thread.join, 5.0)

    def order(self, goals: Mapping[int, tuple[int, int]]) -> None:
        """Set goal and speed, counts, by servo ID. Must be renewed within `ORDERS_S`."""
        self._orders = (time.monotonic() + ORDERS_S, goals)  # one assignment: the thread sees the old or the new

    def halt(self) -> None:
        """Stop writing orders, and make moving servos hold where they are. Thread-safe, and independent of the event
        loop."""
        self._halted = True

    def go_on(self) -> None:
        """Write orders again. Call it after `order` with orders that respect the emergency stop."""
        self._halted = False

    def do(self, task: ServoTask) -> None:
        """Queue a task."""
        self._tasks.put(task)

    # --- in the thread ------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._ended.is_set():
            try:
                with self._open() as bus:
                    self._misses = dict.fromkeys(self._misses, 0)
                    self._talk(bus)
            except PortError as error:
                self._start_over(str(error))
            except Exception:
                log.exception("the line's thread failed, and starts over")
                self._start_over("the line failed: see the log")

    def _start_over(self, why: str) -> None:
        while not self._tasks.empty():
            self._tasks.get()
        self._publish(CycleResult(port_fault=why))
        self._ended.wait(REOPEN_S)

    def _talk(self, bus: ServoBus) -> None:
        due_s = time.monotonic()
        while not self._ended.wait(max(due_s - time.monotonic(), 0.0)):
            started_s = time.monotonic()
            result = CycleResult()
            self._order(bus, started_s)
            for number in self._to_read(started_s):
                self._read(bus, number, result)
            if self._halted:
                self._hold(bus, result.readings)
            self._do_task(bus, result)
            self._check(bus, result)
            result.busy_s = time.monotonic() - started_s
            result.strays = bus.strays
            self._publish(result)
            due_s = max(due_s + self._period_s, time.monotonic())

    def _order(self, bus: ServoBus, now_s: float) -> None:
        """Write the newest orders; when halted, the positions at which the servos are held."""
        if not self._halted:
            self._held = {}
            until_s, goals = self._orders
            if now_s < until_s:
                bus.go(goals)
        else:
            bus.go(self._held)

    def _hold(self, bus: ServoBus, readings: Mapping[int, ServoReading]) -> None:
        """Make the servos under orders hold where they were just read. A servo that does not answer follows in a later
        cycle. A line that keeps its goals holds nothing: it just takes no new goals."""
        ordered = () if self._keeps_goal else self._orders[1]
        new = [number for number in ordered if number in readings and number not in self._held]
        if new:
            self._held |= {number: (readings[number].position, self._hold_speed) for number in new}
            bus.go(self._held)

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

    def _do_task(self, bus: ServoBus, result: CycleResult) -> None:
        try:
            task = self._tasks.get_nowait()
        except Empty:
            return
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
        if enabled and bus.is_wheel(number):
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
        if bus.is_wheel(number):
            raise RefusedWriteError(f"servo {number} is set up as a wheel, which turns endlessly")
        bus.write(number, "moving_speed", self._hold_speed)
        self._set(bus, number)
        if bus.reading(number).error & self._family.shutdowns:
            for register, value in self._family.revival.items():
                bus.write(number, register, value)
        position = bus.reading(number).position
        bus.write(number, "goal_position", position)
        if self._state(bus, number)["goal_position"] != position:
            raise SilentError(number)
        bus.write(number, "torque_enable", 1)
        return position

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

    def _publish(self, result: CycleResult) -> None:
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._on_cycle, result)
