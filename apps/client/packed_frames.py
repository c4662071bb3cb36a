"""A site's bus for commands: it fetches packed frames for who subscribes to frames, since those stay on their host."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, cast

from cocoro.bus.base import Bus, OnSample, Qos, Subscription
from cocoro.keys import matches
from cocoro.messages import Frame
from cocoro.publisher import encode
from cocoro.topics import FRAME
from services.frames.reader import Asking, PackedReader


class UnpackingBus:
    """As the bus that it wraps, but a subscription that matches the frames' key also gets frames."""

    def __init__(self, bus: Bus, robot: str, asking: Asking, *, best: bool) -> None:
        self._bus = bus
        self._key = FRAME.key(robot)
        self._asking = asking
        self._best = best

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bus, name)

    def subscribe(self, keyexpr: str, qos: Qos, handler: OnSample, *, depth: int) -> Subscription:
        subscription = self._bus.subscribe(keyexpr, qos, handler, depth=depth)
        if not matches(keyexpr, self._key):
            return subscription

        def deliver(frame: Frame) -> None:
            handler(self._key, encode(frame))

        reader = PackedReader(self._asking, deliver, best=self._best)
        task = asyncio.create_task(reader.run(), name="packed frames")
        return _WithFrames(subscription, task.cancel)


class _WithFrames:
    def __init__(self, subscription: Subscription, end: Callable[[], object]) -> None:
        self._subscription = subscription
        self._end = end

    @property
    def skipped(self) -> int:
        return self._subscription.skipped

    def close(self) -> None:
        self._end()
        self._subscription.close()


def unpacking(bus: Bus, robot: str, asking: Asking, *, best: bool) -> Bus:
    """`best`: pictures as good as they can be, however late they come."""
    return cast(Bus, UnpackingBus(bus, robot, asking, best=best))
