"""An asyncio event loop whose time is virtual: when nothing is ready, time jumps to the next timer.

Sleeps and time-outs cost no real time, and a run is deterministic: callbacks run in the order in which they were
scheduled, timers of equal deadline included. No threads and no real I/O may be awaited here.
"""

from __future__ import annotations

import asyncio
import heapq
import math
import selectors
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

T = TypeVar("T")


class NothingScheduledError(RuntimeError):
    """Every task waits for something that can never happen: no timer and no callback is left."""


class _Selector(selectors.DefaultSelector):
    """Never waits: a wait with a time-out moves the loop's time instead."""

    loop: VirtualTimeLoop

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        events = super().select(0)
        if events:
            return events
        if timeout is None:
            raise NothingScheduledError("every task is waiting and no timer is set: the run is stuck")
        if timeout > 0:
            self.loop.advance()
        return events


class _Timer(asyncio.TimerHandle):
    """Breaks ties between equal deadlines by the order of scheduling (a heap alone does not)."""

    order: int

    def __lt__(self, other: object) -> bool:
        if isinstance(other, _Timer):
            return (self.when(), self.order) < (other.when(), other.order)
        return NotImplemented


class VirtualTimeLoop(asyncio.SelectorEventLoop):
    """See the module. `time()` starts at 0."""

    _scheduled: list[asyncio.TimerHandle]
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

    def advance(self) -> None:
        """Jump to the next timer's deadline."""
        if self._scheduled:
            self._virtual_s = max(self._virtual_s, self._scheduled[0].when())
            # The loop runs what is due before `time + resolution`: with one ulp, this deadline and none after it.
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
    """Like `asyncio.run`, in virtual time. Raises NothingScheduledError when the run is stuck for ever."""
    with asyncio.Runner(loop_factory=VirtualTimeLoop) as runner:
        return runner.run(main)
