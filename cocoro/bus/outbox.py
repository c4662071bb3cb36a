"""Sending what must not be lost: from a thread, since the mesh makes a sender wait for a receiver that is slow."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable

log = logging.getLogger(__name__)

CAPACITY_BYTES = 64 * 1024 * 1024
"""What may wait. It takes a receiver that has stopped altogether, for seconds, to fill it."""


class Outbox:
    """Does one thing after another in its own thread. `put` never waits; beyond the capacity it drops, counts and
    says so."""

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
            if self._waiting_bytes + size_bytes > CAPACITY_BYTES:
                self.lost += 1
                if self.lost & (self.lost - 1) == 0:  # at 1, 2, 4, 8 and so on
                    log.error("%d events are lost: a receiver does not take them", self.lost)
                return
            self._waiting.append((send, size_bytes))
            self._waiting_bytes += size_bytes
            self._changed.notify()

    def close(self, timeout_s: float) -> None:
        """Send what waits, then end; gives up after the time-out."""
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
