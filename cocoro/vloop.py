"""An asyncio event loop with virtual time: when no callback is ready, time jumps to the next timer.

Sleeps and time-outs take no real time. A run is deterministic: callbacks run in the order in which they were scheduled,
also timers with equal deadlines. Threads and real I/O must not be awaited.
"""

from __future__ import annotations

import asyncio
import heapq
import math
import selectors
from collections import deque
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

T = TypeVar("T")


class NothingScheduledError(RuntimeError):
    """All tasks wait, and no timer or callback is left that could wake one."""


class _Selector(selectors.DefaultSelector):
    """Moves the loop's time instead of waiting."""

    LOOK_EVERY = 64
    """Calls between two questions to the system, which take longer than all else here. Only a run that is stuck could
    depend on their answer sooner, and it asks."""

    loop: VirtualTimeLoop
    _calls = 0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        self._calls += 1
        events = super().select(0) if timeout is None or self._calls % self.LOOK_EVERY == 0 else []
        if events:
            return events
        if timeout is None:
            raise NothingScheduledError("every task is waiting and no timer is set: the run is stuck")
        if timeout > 0:
            self.loop.advance()
        return events


class _Timer(asyncio.TimerHandle):
    """A timer; equal deadlines are ordered by the time of scheduling, which a heap alone does not do."""

    order: int

    _when: float

    def __lt__(self, other: _Timer) -> bool:  # type: ignore[override] # the heap has no others; it asks this most
        return self._when < other._when or (self._when == other._when and self.order < other.order)


class VirtualTimeLoop(asyncio.SelectorEventLoop):
    """`time()` starts at 0."""

    _scheduled: list[asyncio.TimerHandle]
    _ready: deque[asyncio.Handle]
    _check_closed: Callable[[], None]

    def __init__(self) -> None:
        selector = _Selector()
        super().__init__(selector)
        selector.loop = self
        self._virtual_s = 0.0
        self._orders = 0
        self._clock_resolution = math.ulp(0.0)

    def time(self) -> float:
        return self._virtual_s

    @property
    def due(self) -> bool:
        """Whether anything is left to run before time moves."""
        return bool(self._ready) or bool(self._scheduled and self._scheduled[0].when() <= self._virtual_s)

    def advance(self) -> None:
        """Moves time to the next timer's deadline."""
        if self._scheduled:
            self._virtual_s = max(self._virtual_s, self._scheduled[0].when())
            # The loop runs timers due before `time + resolution`: with one ulp, those of this deadline alone.
            self._clock_resolution = math.ulp(self._virtual_s)

    def call_at(  # type: ignore[override] # the stubs type the arguments as a tuple variable
        self, when: float, callback: Callable[..., object], *args: Any, context: Any = None
    ) -> asyncio.TimerHandle:
        self._check_closed()
        timer = _Timer(when, callback, args, self, context)
        timer.order = self._orders
        self._orders += 1
        heapq.heappush(self._scheduled, timer)
        timer._scheduled = True  # type: ignore[attr-defined] # what BaseEventLoop.call_at does
        return timer

    def call_soon_threadsafe(  # type: ignore[override] # as above
        self, callback: Callable[..., object], *args: Any, context: Any = None
    ) -> asyncio.Handle:
        return self.call_soon(callback, *args, context=context)


def run_virtual(main: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine as `asyncio.run` does, in virtual time. Raises NothingScheduledError when it is stuck."""
    with asyncio.Runner(loop_factory=VirtualTimeLoop) as runner:
        return runner.run(main)
