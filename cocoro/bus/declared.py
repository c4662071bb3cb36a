"""What a zenoh bus has declared: publishers, subscriptions, servers, tokens. Each can be taken back by itself."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from functools import partial
from typing import Any

import zenoh

from cocoro.bus.base import Payload, Qos
from cocoro.bus.lots import Lots
from cocoro.bus.outbox import Outbox
from cocoro.bus.pool import SharedPool
from cocoro.bus.ring import Ring

_DROP, _BLOCK = zenoh.CongestionControl.DROP, zenoh.CongestionControl.BLOCK
QOS: dict[Qos, dict[str, Any]] = {
    Qos.COMMAND: {"priority": zenoh.Priority.REAL_TIME, "congestion_control": _DROP, "express": True},
    Qos.STATE: {"priority": zenoh.Priority.DATA_HIGH, "congestion_control": _DROP, "express": False},
    Qos.EVENT: {"priority": zenoh.Priority.DATA, "congestion_control": _BLOCK, "express": False},
    Qos.FRAME: {"priority": zenoh.Priority.BACKGROUND, "congestion_control": _DROP, "express": False},
}
"""Express samples are sent at once and alone; others may share a packet with those that follow. A key that drops
does so when a receiver does not read, and then waits for 1 ms at most; one that blocks is put by an `Outbox`."""


class Declared:
    """Something declared on a session, with the ring that its samples come through, if it receives."""

    def __init__(self, declaration: Any, ring: Ring[Any] | Lots[Any] | None = None) -> None:
        self.on_close: Callable[[Declared], None] = lambda _: None
        self._declaration = declaration
        self._ring = ring
        self._closed = False

    def mute(self) -> None:
        """Nothing goes through any more, though zenoh still knows of it."""
        self._closed = True
        if self._ring is not None:
            self._ring.close()

    def close(self) -> None:
        if self._closed:
            return
        self.mute()
        self.on_close(self)
        self._undeclare()

    def _undeclare(self) -> None:
        with contextlib.suppress(zenoh.ZError):  # the session has ended
            self._declaration.undeclare()


class ZenohListening(Declared):
    def __init__(self, subscriber: zenoh.Subscriber[None], lots: Lots[Any]) -> None:
        super().__init__(subscriber, lots)
        self._lots = lots

    def close(self) -> None:
        if not self._closed:
            self._lots.deliver()
        super().close()


class ZenohSubscription(Declared):
    def __init__(self, subscriber: zenoh.Subscriber[None], ring: Ring[zenoh.ZBytes]) -> None:
        super().__init__(subscriber, ring)
        self._samples = ring

    @property
    def skipped(self) -> int:
        return self._samples.skipped


class ZenohPublisher(Declared):
    def __init__(
        self, publisher: zenoh.Publisher, outbox: Outbox | None, pool: SharedPool | None, trouble: str = ""
    ) -> None:
        super().__init__(publisher)
        self._outbox = outbox
        self._pool = pool
        self._trouble = trouble

    @property
    def trouble(self) -> str:
        return self._trouble

    def put(self, payload: Payload) -> None:
        if self._closed:
            return
        data = payload if isinstance(payload, bytes) else bytes(payload)
        if self._outbox is not None:
            self._outbox.put(partial(self._put, data), len(data))
        elif self._pool is not None:
            self._put(self._pool.hold(data))
        else:
            self._put(data)

    def _put(self, data: bytes | zenoh.ZBytes) -> None:
        with contextlib.suppress(zenoh.ZError):  # the session has ended
            self._declaration.put(data)

    def _undeclare(self) -> None:
        if self._outbox is not None:  # after what waits there
            self._outbox.put(super()._undeclare, 0)
        else:
            super()._undeclare()
