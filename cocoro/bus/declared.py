"""Declarations of a zenoh bus (publishers, subscriptions, servers, tokens), and the shared memory of one publisher."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from functools import partial
from typing import Any

import zenoh
from zenoh import shm

from cocoro.bus import shared
from cocoro.bus.base import Payload, Qos
from cocoro.bus.queues import Batches, Outbox, Ring
from cocoro.bus.shared import POOL_BYTES, PROCESS_BYTES

_DROP, _BLOCK = zenoh.CongestionControl.DROP, zenoh.CongestionControl.BLOCK
QOS: dict[Qos, dict[str, Any]] = {
    Qos.COMMAND: {"priority": zenoh.Priority.REAL_TIME, "congestion_control": _DROP, "express": True},
    Qos.STATE: {"priority": zenoh.Priority.DATA_HIGH, "congestion_control": _DROP, "express": False},
    Qos.EVENT: {"priority": zenoh.Priority.DATA, "congestion_control": _BLOCK, "express": False},
    Qos.FRAME: {"priority": zenoh.Priority.BACKGROUND, "congestion_control": _DROP, "express": False},
}
"""Express samples are sent at once, each in a packet of its own; others may share a packet with those that follow. A
key that drops does so when a receiver does not read, after at most 1 ms; one that blocks is put by an `Outbox`."""
SHARED_FROM_BYTES = 4096
"""Smaller samples are never in shared memory: to copy them costs less."""
POLICY = shm.Defragment(shm.GarbageCollect(safe=False))
"""Reclaims free memory, and memory that a stopped receiver still holds. When that receiver goes on, it finds its
samples invalid (see `read`)."""


class SharedPool:
    """Shared memory of one publisher, made and mapped at once, so that the first sample is as fast as the rest."""

    def __init__(self) -> None:
        self.missed = 0
        """Samples that were copied through sockets because the pool was full."""
        self.trouble = shared.obstacle(POOL_BYTES + PROCESS_BYTES)
        """Why there is no shared memory; empty when there is. Decided once, when the publisher is made."""
        self._provider: shm.ShmProvider | None = None
        if not self.trouble:
            try:
                self._provider = shm.ShmProvider.default_backend(POOL_BYTES)
                self.hold(bytes(SHARED_FROM_BYTES))
            except zenoh.ZError as error:  # other processes have filled it since
                self._provider = None
                shared.drop_failed()
                self.trouble = shared.obstacle(POOL_BYTES + PROCESS_BYTES) or str(error)

    def hold(self, data: bytes) -> zenoh.ZBytes | bytes:
        """The data in shared memory; `data` itself when it is small, or there is no room."""
        if self._provider is None or len(data) < SHARED_FROM_BYTES:
            return data
        try:
            buffer = self._provider.alloc(len(data), POLICY)
        except zenoh.ZError:
            self.missed += 1
            return data
        buffer[:] = data
        return zenoh.ZBytes(buffer)


def read(payload: zenoh.ZBytes) -> bytes | None:
    """The bytes of a sample; None when its shared memory was reclaimed before it was read."""
    held = payload.as_shm() if len(payload) >= SHARED_FROM_BYTES else None
    if held is None:
        return payload.to_bytes()
    data = bytes(held)  # `to_bytes` clears the memory before it copies
    return data if held.is_valid() else None


class Declared:
    """Something declared on a session, with the queue that its samples pass through when it receives."""

    def __init__(self, declaration: Any, queue: Ring[Any] | Batches[Any] | None = None) -> None:
        self.on_close: Callable[[Declared], None] = lambda _: None
        self._declaration = declaration
        self._queue = queue
        self._closed = False

    def mute(self) -> None:
        """Stops all delivery; the session still knows the declaration."""
        self._closed = True
        if self._queue is not None:
            self._queue.close()

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
    def __init__(self, subscriber: zenoh.Subscriber[None], batches: Batches[Any]) -> None:
        super().__init__(subscriber, batches)
        self._batches = batches

    def close(self) -> None:
        if not self._closed:
            self._batches.deliver()
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
        try:  # noqa: SIM105 # `suppress` takes longer than encoding a message does
            self._declaration.put(data)
        except zenoh.ZError:  # the session has ended
            pass

    def _undeclare(self) -> None:
        if self._outbox is not None:  # after the samples that wait there
            self._outbox.put(super()._undeclare, 0)
        else:
            super()._undeclare()
