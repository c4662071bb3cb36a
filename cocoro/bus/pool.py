"""Shared memory for what is large: the receivers on this machine map it, so only a reference travels."""

from __future__ import annotations

import logging

import zenoh
from zenoh import shm

log = logging.getLogger(__name__)

POOL_BYTES = 24 * 1024 * 1024
"""Fifteen colour and depth frames of 640 x 480. Receivers hold one or two each; one that has stopped holds all."""

POLICY = shm.Defragment(shm.GarbageCollect(safe=False))
"""Take back what is free, and what a receiver that has stopped still holds: should it go on, it finds its samples
invalid (see `read`)."""


class SharedPool:
    """Memory for one publisher, made and mapped at once so that the first sample is as fast as the others."""

    def __init__(self) -> None:
        self.missed = 0
        """Samples for which there was no room, and that went by copy instead."""
        self._provider: shm.ShmProvider | None
        try:
            self._provider = shm.ShmProvider.default_backend(POOL_BYTES)
            self.hold(b"warm")
        except zenoh.ZError as error:
            log.warning("no shared memory (%s): large samples are copied through sockets, which costs more", error)
            self._provider = None

    def hold(self, data: bytes) -> zenoh.ZBytes | bytes:
        """The data in shared memory, or itself where that is missing or full."""
        if self._provider is None:
            return data
        try:
            buffer = self._provider.alloc(len(data), POLICY)
        except zenoh.ZError:
            self.missed += 1
            return data
        buffer[:] = data
        return zenoh.ZBytes(buffer)


def read(payload: zenoh.ZBytes) -> bytes | None:
    """The bytes of a sample; None when its shared memory was taken back before it was read."""
    data = payload.to_bytes()
    held = payload.as_shm()
    if held is not None and not held.is_valid():
        return None
    return data
