"""The thread that talks to one servo line, so that the event loop never waits for a wire.

Each cycle it writes the newest orders by one sync write, reads every servo, and does at most one task. What it finds
goes to the event loop as an `CycleResult`; nothing else is shared but the newest orders and the tasks' queue.
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
from typing import NamedTuple

from services.servos import table
from services.servos.bus import PortError, RefusedWriteError, ServoBus, SilentError
from services.servos.motion import HOLD_RADPS
from services.servos.network import MISSES, ServoStatus, ServoTask
from services.servos.table import Register, ServoReading

log = logging.getLogger("cocoro.servos")

REOPEN_S = 0.3
PROBE_S = 0.2
"""A silent servo is asked so often whether it is back: waiting for its answer costs the others their time."""
CHECK_CYCLES = 8
"""In each of so many cycles one servo is looked at closer."""
ORDERS_S = 0.2
"""Orders that were not renewed for so long are not written any more: the event loop hangs."""
_TORQUE, _SLOPE, _GOAL, _LIMIT = (
    table.REGISTERS[name] for name in ("torque_enable", "cw_slope", "goal_position", "torque_limit")
)
STATE = _TORQUE.address, _LIMIT.address + _LIMIT.size - _TORQUE.address
"""First register and length of what is read of a servo's state: longer than a reading."""


class _State(NamedTuple):
    """What was written into a servo."""

    torque: bool
    slope: int
    goal: int
    limit: int


@dataclass
class CycleResult:
    """What one cycle found."""

    readings: dict[int, ServoReading] = field(default_factory=dict)
    missed: list[int] = field(default_factory=list)
    met: dict[int, ServoStatus] = field(default_factory=dict)
    checked: dict[int, bool] = field(default_factory=dict)
    """Whether a servo's torque is on and its settings are those that were written into it."""
    done: list[tuple[ServoTask, int]] = field(default_factory=list)
    """With the position."""
    failed: list[ServoTask] = field(default_factory=list)
    refused: list[tuple[ServoTask, str]] = field(default_factory=list)
    port_fault: str = ""
    busy_s: float = 0.0
    """How long the cycle took."""
    strays: int = 0


@dataclass(frozen=True)
class ServoSettings:
    """What is written into a servo before it holds."""

    slope: int
    torque_limit: int


class ServoLine:
    """`heard(event)` is called in the event loop in which this was made. Start it, and stop it at the end."""

    def __init__(
        self,
        path: str,
        baud: int,
        settings: Mapping[int, ServoSettings],
        rate_hz: float,
        reply_s: float,
        heard: Callable[[CycleResult], None],
        keeps_goal: bool = False,
    ) -> None:
        """`keeps_goal`: halted, its servos go on to where they were told to (a hand that holds something)."""
        self._open: Callable[[], ServoBus] = lambda: ServoBus(path, baud, reply_s)
        self._settings = settings
        self._period_s = 1.0 / rate_hz
        self._heard = heard
        self._keeps_goal = keeps_goal
        self._loop = asyncio.get_running_loop()
        self._ended = threading.Event()
        self._tasks: SimpleQueue[ServoTask] = SimpleQueue()
        self._orders: tuple[float, Mapping[int, tuple[int, int]]] = (0.0, {})
        self._halted = False
        self._held: dict[int, tuple[int, int]] = {}
        """Where the servos were when the line was halted, in counts, and with which speed they hold that."""
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
        """Goal and speed in counts by servo, from now on; to be renewed in every cycle."""
        self._orders = (time.monotonic() + ORDERS_S, goals)  # one assignment: the thread sees the old or the new

    def halt(self) -> None:
        """Orders are not written from now on, and what moves holds where it is. From any thread, and whatever the event
        loop does."""
        self._halted = True

    def go_on(self) -> None:
        """Orders are written again: the newest were made by who knows of the emergency stop."""
        self._halted = False

    def do(self, task: ServoTask) -> None:
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
        self._tell(CycleResult(port_fault=why))
        self._ended.wait(REOPEN_S)

    def _talk(self, bus: ServoBus) -> None:
        due_s = time.monotonic()
        while not self._ended.wait(max(due_s - time.monotonic(), 0.0)):
            started_s = time.monotonic()
            event = CycleResult()
            self._order(bus, started_s)
            for number in self._to_read(started_s):
                self._read(bus, number, event)
            if self._halted:
                self._hold(bus, event.readings)
            self._do_task(bus, event)
            self._check(bus, event)
            event.busy_s = time.monotonic() - started_s
            event.strays = bus.strays
            self._tell(event)
            due_s = max(due_s + self._period_s, time.monotonic())

    def _order(self, bus: ServoBus, now_s: float) -> None:
        """Write the newest orders; of a halted line, where its servos were when it was halted."""
        if not self._halted:
            self._held = {}
            until_s, goals = self._orders
            if now_s < until_s:
                bus.go(goals)
        else:
            bus.go(self._held)

    def _hold(self, bus: ServoBus, readings: Mapping[int, ServoReading]) -> None:
        """Have what is under orders hold where it has just been read, which may take some cycles where one does not
        answer; a line that keeps its goals only takes no new ones."""
        speed = round(HOLD_RADPS / table.SPEED_RADPS)
        ordered = () if self._keeps_goal else self._orders[1]
        fresh = [number for number in ordered if number in readings and number not in self._held]
        if fresh:
            self._held |= {number: (readings[number].position, speed) for number in fresh}
            bus.go(self._held)

    def _to_read(self, now_s: float) -> Collection[int]:
        """All that answer; of those that do not, one at a time and not often."""
        alive = [number for number, misses in self._misses.items() if misses < MISSES]
        silent = [number for number, misses in self._misses.items() if misses >= MISSES]
        if silent and (not alive or now_s - self._probed_s > PROBE_S):
            self._probed_s = now_s
            self._next_probe += 1
            return [*alive, silent[self._next_probe % len(silent)]]
        return alive

    def _read(self, bus: ServoBus, number: int, event: CycleResult) -> None:
        try:
            event.readings[number] = bus.reading(number)
            self._misses[number] = 0
        except SilentError:
            event.missed.append(number)
            self._misses[number] += 1

    def _do_task(self, bus: ServoBus, event: CycleResult) -> None:
        try:
            task = self._tasks.get_nowait()
        except Empty:
            return
        try:
            if task.what == "meet":
                event.met[task.number] = self._meet(bus, task.number)
            else:
                position = self._enable(bus, task.number) if task.what == "enable" else self._relax(bus, task.number)
                event.done.append((task, position))
        except SilentError:
            event.failed.append(task)
        except RefusedWriteError as error:
            event.refused.append((task, str(error)))

    def _meet(self, bus: ServoBus, number: int) -> ServoStatus:
        state = self._state(bus, number)
        reading = bus.reading(number)
        if state.torque and not reading.error & table.SHUTDOWNS:  # it holds already, but perhaps by another's settings
            self._set(bus, number)
        return ServoStatus(state.torque, state.goal, reading.position, reading.error)

    def _set(self, bus: ServoBus, number: int) -> None:
        setting = self._settings[number]
        bus.write(number, "cw_slope", setting.slope)
        bus.write(number, "ccw_slope", setting.slope)
        bus.write(number, "torque_limit", setting.torque_limit)  # after a shutdown it is 0

    def _enable(self, bus: ServoBus, number: int) -> int:
        """Have a servo hold where it is. The order matters: what decides how it would move comes before what might
        make it move, and its goal is where it is before its torque is on. That this was written is read, too: a
        confirmation that came late may be another's."""
        bus.write(number, "moving_speed", round(HOLD_RADPS / table.SPEED_RADPS))
        self._set(bus, number)
        position = bus.reading(number).position
        bus.write(number, "goal_position", position)
        if self._state(bus, number).goal != position:
            raise SilentError(number)
        bus.write(number, "torque_enable", 1)
        return position

    def _relax(self, bus: ServoBus, number: int) -> int:
        bus.write(number, "torque_enable", 0)
        return bus.reading(number).position

    def _check(self, bus: ServoBus, event: CycleResult) -> None:
        self._cycles += 1
        number = list(self._misses)[self._cycles // CHECK_CYCLES % len(self._misses)]
        if self._cycles % CHECK_CYCLES == 0 and self._misses[number] == 0 and number not in event.missed:
            with suppress(SilentError, RefusedWriteError):
                event.checked[number] = self._is_as_set(bus, number)

    def _is_as_set(self, bus: ServoBus, number: int) -> bool:
        state, setting = self._state(bus, number), self._settings[number]
        return (state.torque, state.slope, state.limit) == (True, setting.slope, setting.torque_limit)

    def _state(self, bus: ServoBus, number: int) -> _State:
        """What was written into a servo. Always this whole block: an answer says nothing of what it answers, and one
        that comes late must not be taken for that to another question, such as `ServoBus.reading`."""
        data, _ = bus.read_block(number, *STATE)
        if len(data) < STATE[1]:
            raise SilentError(number)

        def value(register: Register) -> int:
            at = register.address - STATE[0]
            return int.from_bytes(data[at : at + register.size], "little")

        return _State(bool(value(_TORQUE)), value(_SLOPE), value(_GOAL), value(_LIMIT))

    def _tell(self, event: CycleResult) -> None:
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._heard, event)
