"""The thread that talks to a servo line, so that the event loop never waits for a wire.

It runs one cycle (`services.servos.cycle`) after the other, and passes the results to the event loop. The two share
only the orders of the line's groups and wheels and the queue of tasks.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from queue import Empty, SimpleQueue

from services.servos.bus import PortError, ServoBus
from services.servos.cycle import CycleResult, LineCycle
from services.servos.family import ServoFamily
from services.servos.orders import GroupOrders
from services.servos.watch import ServoTask
from services.servos.wheel_orders import WheelOrders

log = logging.getLogger("cocoro.servos")

REOPEN_S = 0.3


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
        wheels: WheelOrders | None = None,
    ) -> None:
        """See `LineCycle`."""
        self._open: Callable[[], ServoBus] = lambda: ServoBus(path, baud, reply_s, family)
        self._cycle = LineCycle(family, settings, orders, wheels)
        self._period_s = 1.0 / rate_hz
        self._on_cycle = on_cycle
        self._loop = asyncio.get_running_loop()
        self._ended = threading.Event()
        self._tasks: SimpleQueue[ServoTask] = SimpleQueue()
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
                    try:
                        self._talk(bus)
                    finally:
                        self._cycle.end(bus)
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
        self._cycle.begin(bus, due_s)
        while not self._ended.wait(max(due_s - time.monotonic(), 0.0)):
            self._publish(self._cycle.run(bus, time.monotonic, self._next_task()))
            due_s = max(due_s + self._period_s, time.monotonic())

    def _next_task(self) -> ServoTask | None:
        try:
            return self._tasks.get_nowait()
        except Empty:
            return None

    def _publish(self, result: CycleResult) -> None:
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._on_cycle, result)
