"""Reads topics for as long as they are needed, so that a client pays for no message that nobody looks at."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncGenerator, Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from cocoro.bus.base import Qos
from cocoro.messages import Message
from cocoro.participant import Participant
from cocoro.topics import Topic

M = TypeVar("M", bound=Message)


@contextmanager
def reading(participant: Participant, topic: Topic[M], reader: Callable[[M], None]) -> Iterator[None]:
    """Calls `reader` for each message while the context lasts; then the subscription ends, if nobody else uses it."""

    def take(_key: str, message: M) -> None:
        reader(message)

    inbox = participant.inbox(topic)
    inbox.add(take)
    try:
        yield
    finally:
        inbox.remove(take)
        if not inbox.is_read:
            participant.drop(topic)


async def watched(participant: Participant, topic: Topic[M]) -> AsyncGenerator[M, None]:
    """The messages of a topic as they come, without end. As everywhere on the mesh the newest replaces those that were
    not taken yet, and events are all kept."""
    waiting: deque[M] = deque(maxlen=None if topic.qos is Qos.EVENT else 1)
    arrived = asyncio.Event()

    def take(message: M) -> None:
        waiting.append(message)
        arrived.set()

    with reading(participant, topic, take):
        while True:
            while not waiting:
                arrived.clear()
                await arrived.wait()
            yield waiting.popleft()
