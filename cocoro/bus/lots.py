"""From a thread into the loop without waking it: what arrives is fetched from time to time, many at once."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class Lots(Generic[T]):
    """`push` from any thread; `deliver(items)` happens in the loop's thread, in order, every `every_s` where there are
    any. Nothing is dropped."""

    def __init__(self, loop: asyncio.AbstractEventLoop, deliver: Callable[[list[T]], None], every_s: float) -> None:
        self._loop = loop
        self._deliver = deliver
        self._every_s = every_s
        self._waiting: deque[T] = deque()
        self.push = self._waiting.append
        """Safe without a lock, in every thread."""
        self._timer = loop.call_later(every_s, self._tick)

    def deliver(self) -> None:
        """What has come until now."""
        items = [self._waiting.popleft() for _ in range(len(self._waiting))]
        if not items:
            return
        try:
            self._deliver(items)
        except Exception as error:
            self._loop.call_exception_handler({"message": "who listens to everything failed", "exception": error})

    def _tick(self) -> None:
        self._timer = self._loop.call_later(self._every_s, self._tick)
        self.deliver()

    def close(self) -> None:
        """Nothing is delivered afterwards."""
        self._timer.cancel()
        self._waiting.clear()
