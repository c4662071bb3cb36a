"""What the cockpit hears of the mesh: everything while somebody looks, and nothing while nobody does."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial
from typing import Any

from cocoro import topics
from cocoro.messages import Frame, Message
from cocoro.node import Node
from cocoro.topics import ANY, Topic
from services.cockpit.scene import TOPICS

NEWEST_S = 0.5
"""Longest wait for messages that were published before somebody looked."""
LINGER_S = 3.0
"""How long it goes on after the last one has left, who may only load the page anew."""


class Feed:
    """Subscribes while it is in use. `take(topic, message)` gets every message but frames."""

    def __init__(
        self, node: Node, take: Callable[[Topic[Any], Message], None], take_frame: Callable[[Frame], None]
    ) -> None:
        self._node = node
        self._take = take
        self._take_frame = take_frame
        self._on = self._frames_on = False
        self._off: asyncio.TimerHandle | None = None
        self._heard: set[str] = set()

    def use(self, looked_at: bool, pictures: bool) -> None:
        """Say whether somebody looks, and at pictures, too."""
        if looked_at:
            if self._off is not None:
                self._off.cancel()
                self._off = None
            self._start()
        elif self._on and self._off is None:
            self._off = asyncio.get_running_loop().call_later(LINGER_S, self._stop)
        self._use_frames(looked_at and pictures)

    def _start(self) -> None:
        if self._on:
            return
        self._on = True
        self._heard.clear()
        for topic in TOPICS:
            row = topic.of(ANY) if topic.per_service else topic
            self._node.inbox(row).add(partial(self._arrived, topic))
            if row.askable:
                self._node.spawn(self._ask(topic, row))

    def _stop(self) -> None:
        self._off = None
        self._on = False
        for topic in TOPICS:
            self._node.drop(topic.of(ANY) if topic.per_service else topic)

    def _use_frames(self, on: bool) -> None:
        if on and not self._frames_on:
            self._node.inbox(topics.FRAME).add(lambda _key, frame: self._take_frame(frame))
        elif self._frames_on and not on:
            self._node.drop(topics.FRAME)
        self._frames_on = on

    def _arrived(self, topic: Topic[Any], key: str, message: Message) -> None:
        self._heard.add(key)
        self._take(topic, message)

    async def _ask(self, topic: Topic[Any], row: Topic[Any]) -> None:
        """Ask for what would come only in up to a second; what came meanwhile is newer."""
        for message in await self._node.newest(row, NEWEST_S):
            name = getattr(message, "service", "")
            key = row.key(self._node.robot_name).replace(ANY, name)
            if self._on and key not in self._heard:
                self._take(topic, message)
