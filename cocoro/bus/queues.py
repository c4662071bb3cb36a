"""Queues between the threads of zenoh and the event loop.

- `Ring`: from any thread into the loop, which is woken once for all that waits, or lends its turn (`cocoro.lending`).
  For subscriptions.
- `Batches`: from any thread into the loop, which collects at intervals and is not woken. For a recorder.
- `Outbox`: from the loop into a thread that sends, since sending without loss can block.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

from cocoro.lending import LendingLoop

log = logging.getLogger(__name__)
T = TypeVar("T")

OUTBOX_BYTES = 64 * 1024 * 1024
"""Capacity of an `Outbox`. A receiver that has stopped fills it only after seconds."""


class Ring(Generic[T]):
    """`push` from any other thread; `deliver(key, item)` is called in the loop's turn, in order for each key.

    With a `depth`, a key that has `depth` items waiting loses the oldest to the newest, counted in `skipped`.
    Without a depth nothing is lost, and the order holds over all keys.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        deliver: Callable[[str, T], None],
        depth: int | None,
        *,
        borrows: bool = False,
    ) -> None:
        """`borrows`: deliver in the pushing thread while the loop waits, if the loop lends its turn."""
        self.skipped = 0
        self._loop = loop
        self._lender = loop if borrows and isinstance(loop, LendingLoop) else None
        self._deliver: Callable[[str, T], None] | None = deliver
        self._depth = depth
        self._lock = threading.Lock()
        self._waiting: dict[str, deque[tuple[str, T]]] = {}
        self._woken = False

    def push(self, key: str, item: T) -> None:
        deliver, lender = self._deliver, self._lender
        if deliver is None:
            return
        if lender is not None and not self._waiting and lender.borrow():
            try:
                deliver(key, item)
            except Exception as error:
                self._failed(key, error)
            finally:
                lender.give_back()
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
        except RuntimeError:  # the loop has been closed
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
                    self._failed(key, error)

    def _failed(self, key: str, error: Exception) -> None:
        self._loop.call_exception_handler({"message": f"the reader of {key} failed", "exception": error})

    def close(self) -> None:
        """Drops what waits; nothing is delivered afterwards."""
        self._deliver = None
        with self._lock:
            self._waiting.clear()


class Batches(Generic[T]):
    """`push` from any thread; `deliver(items)` is called in the loop's thread every `every_s`, in order, when there are
    items. Nothing is dropped."""

    def __init__(self, loop: asyncio.AbstractEventLoop, deliver: Callable[[list[T]], None], every_s: float) -> None:
        self._loop = loop
        self._deliver = deliver
        self._every_s = every_s
        self._waiting: deque[T] = deque()
        self.push = self._waiting.append
        """Needs no lock: deque.append is atomic."""
        self._timer = loop.call_later(every_s, self._tick)

    def deliver(self) -> None:
        """Delivers all that has been pushed until now."""
        items = [self._waiting.popleft() for _ in range(len(self._waiting))]
        if not items:
            return
        try:
            self._deliver(items)
        except Exception as error:
            self._loop.call_exception_handler({"message": "a listener to the whole mesh failed", "exception": error})

    def _tick(self) -> None:
        self._timer = self._loop.call_later(self._every_s, self._tick)
        self.deliver()

    def close(self) -> None:
        """Drops what waits; nothing is delivered afterwards."""
        self._timer.cancel()
        self._waiting.clear()


class Outbox:
    """Runs send operations one after another in a thread. `put` never blocks; beyond `OUTBOX_BYTES` it drops the
    operation, counts it in `lost` and logs it."""

    def __init__(self, name: str) -> None:
        self.lost = 0
        self._waiting: deque[tuple[Callable[[], None], int]] = deque()
        self._waiting_bytes = 0
        self._changed = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name=f"{name} outbox", daemon=True)
        self._thread.start()

    def put(self, send: Callable[[], None], size_bytes: int) -> None:
        with self._changed:
            if self._waiting_bytes + size_bytes > OUTBOX_BYTES:
                self.lost += 1
                if self.lost & (self.lost - 1) == 0:  # at 1, 2, 4, 8 and so on
                    log.error("%d events are lost: a receiver does not take them", self.lost)
                return
            self._waiting.append((send, size_bytes))
            self._waiting_bytes += size_bytes
            self._changed.notify()

    def close(self, timeout_s: float) -> None:
        """Sends what waits, for at most `timeout_s`, and ends the thread."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(timeout_s)
        if self._waiting:
            log.warning("%d events were not sent when the mesh was left", len(self._waiting))

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._waiting and not self._closing:
                    self._changed.wait()
                if not self._waiting:
                    return
                send, size_bytes = self._waiting[0]
            send()
            with self._changed:
                self._waiting.popleft()
                self._waiting_bytes -= size_bytes
