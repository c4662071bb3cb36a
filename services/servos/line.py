"""The thread that talks to a servo line, so that the event loop never waits for a wire.

In each cycle it writes the newest orders by one sync write, reads every servo, and does at most one task. It passes the
results to the event loop as a `CycleResult`. The two share only the orders of the line's groups and the queue of tasks.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Collection, Container, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from queue import Empty, SimpleQueue

from services.servos.bus import PortError, RefusedWriteError, ServoBus, SilentError
from services.servos.family import ServoFamily, ServoReading
from services.servos.group import MISSES, ServoStatus, ServoTask
from services.servos.motion import HOLD_RADPS
from services.servos.orders import GroupOrders

log = logging.getLogger("cocoro.servos")

REOPEN_S = 0.3
PROBE_S = 0.2
"""Period at which one silent servo is tried again. More often would take too much time from the others."""
CHECK_CYCLES = 8
"""Once in this many cycles the settings of one servo are checked."""
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
        orders: Sequence[GroupOrders],
    ) -> None:
        """`settings`: by servo ID, the registers that are written before the servo is enabled. `orders`: those of each
        group whose servos are on the line."""
        self._open: Callable[[], ServoBus] = lambda: ServoBus(path, baud, reply_s, family)
        self._family = family
        self._hold_speed = round(HOLD_RADPS / family.units.speed_radps)
        self._settings = settings
        self._period_s = 1.0 / rate_hz
        self._on_cycle = on_cycle
        self._orders = orders
        self._loop = asyncio.get_running_loop()
        self._ended = threading.Event()
        self._tasks: SimpleQueue[ServoTask] = SimpleQueue()
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
            self._hold(bus, result.readings)
            self._do_task(bus, result)
            self._check(bus, result)
            result.busy_s = time.monotonic() - started_s
            result.strays = bus.strays
            self._publish(result)
            due_s = max(due_s + self._period_s, time.monotonic())

    def _order(self, bus: ServoBus, now_s: float) -> None:
        """Write what is due of all groups' orders."""
        goals: dict[int, tuple[int, int]] = {}
        for one in self._orders:
            goals |= one.due(now_s)
        bus.go(goals)

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
