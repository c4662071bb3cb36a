"""Shared memory for what is large: the receivers on this machine map it, so only a reference travels."""

from __future__ import annotations

import zenoh
from zenoh import shm

from cocoro.bus import shared
from cocoro.bus.shared import POOL_BYTES, PROCESS_BYTES

POLICY = shm.Defragment(shm.GarbageCollect(safe=False))
"""Take back what is free, and what a receiver that has stopped still holds: should it go on, it finds its samples
invalid (see `read`)."""


class SharedPool:
    """Memory for one publisher, made and mapped at once so that the first sample is as fast as the others."""

    def __init__(self) -> None:
        self.missed = 0
        """Samples for which there was no room, and that went by copy instead."""
        self.trouble = shared.obstacle(POOL_BYTES + PROCESS_BYTES)
        """Why there is none; empty when there is. It stays so: what could not be had at the start is done without."""
        self._provider: shm.ShmProvider | None = None
        if not self.trouble:
            try:
                self._provider = shm.ShmProvider.default_backend(POOL_BYTES)
                self.hold(b"warm")
            except zenoh.ZError as error:  # others have filled it since
                self._provider = None
                shared.drop_failed()
                self.trouble = shared.obstacle(POOL_BYTES + PROCESS_BYTES) or str(error)

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
