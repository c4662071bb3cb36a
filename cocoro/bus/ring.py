"""From a thread into the loop: what arrives waits in a bounded ring per key, and the loop is woken once."""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class Ring(Generic[T]):
    """`push` from any thread; `deliver(key, item)` happens in the loop's thread, in order for each key.

    With a `depth`, a key that has as many items waiting loses the oldest to the newest, counted in `skipped`.
    Without one nothing is lost, and the order holds over all keys.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, deliver: Callable[[str, T], None], depth: int | None) -> None:
        self.skipped = 0
        self._loop = loop
        self._deliver: Callable[[str, T], None] | None = deliver
        self._depth = depth
        self._lock = threading.Lock()
        self._waiting: dict[str, deque[tuple[str, T]]] = {}
        self._woken = False

    def push(self, key: str, item: T) -> None:
        if self._deliver is None:
            return
        with self._lock:
            place = key if self._depth is not None else ""
            ring = self._waiting.get(place)
            if ring is None:
                ring = self._waiting[place] = deque(maxlen=self._depth)
            if len(ring) == self._depth:
                self.skipped += 1
            ring.append((key, item))
            if self._woken:
                return
            self._woken = True
        try:
            self._loop.call_soon_threadsafe(self._drain)
        except RuntimeError:  # the loop has been closed: nobody reads any more
            self.close()

    def _drain(self) -> None:
        with self._lock:
            waiting, self._waiting = self._waiting, {}
            self._woken = False
        for ring in waiting.values():
            for key, item in ring:
                if self._deliver is None:
                    return
                try:
                    self._deliver(key, item)
                except Exception as error:
                    self._loop.call_exception_handler({"message": f"the reader of {key} failed", "exception": error})

    def close(self) -> None:
        """Nothing is delivered afterwards."""
        self._deliver = None
        with self._lock:
            self._waiting.clear()
