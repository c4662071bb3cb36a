"""Messages of a running robot on their way to a viewer: the mesh never waits for it."""

from __future__ import annotations

from collections import deque
from contextlib import suppress
from functools import partial
from threading import Condition
from typing import Any, Protocol

import msgspec

from cocoro.bus.base import Bus, Payload
from cocoro.messages import Message
from cocoro.topics import FRAME, TOPICS, Topic

PER_SERVICE = "{service}"
DEPTH = 4
"""Messages of one key that may wait; a viewer that is late shows the newest."""
WAITING, WAITING_FRAMES = 500, 2
"""Messages, and frames among them, that may wait for the viewer."""


class Scene(Protocol):
    """A viewer's scene of a robot."""

    def log(self, topic: str, message: Message) -> object:
        """Show a message of the topic of a name."""


class Waiting:
    """Messages on their way to the viewer, which a thread of its own logs: the mesh never waits for a viewer."""

    def __init__(self) -> None:
        self.dropped = 0
        self._messages: deque[tuple[str, Message]] = deque()
        self._changed = Condition()
        self._open = True

    def put(self, topic: str, message: Message) -> None:
        """Queue a message to be logged. When too many wait it is dropped, a frame earlier than others."""
        with self._changed:
            frames = sum(name == FRAME.name for name, _ in self._messages) if topic == FRAME.name else 0
            if len(self._messages) >= WAITING or frames >= WAITING_FRAMES:
                self.dropped += 1
                return
            self._messages.append((topic, message))
            self._changed.notify()

    def close(self) -> None:
        """Take no more messages. Those that wait are still logged."""
        with self._changed:
            self._open = False
            self._changed.notify()

    def log_to(self, scene: Scene) -> None:
        """Log the queued messages until `close`. Raises ConfigError when Rerun is given the truth of another scene than
        the one stated."""
        while True:
            with self._changed:
                while self._open and not self._messages:
                    self._changed.wait()
                if not self._messages:
                    return
                topic, message = self._messages.popleft()
            scene.log(topic, message)


def watch(bus: Bus, robot: str, waiting: Waiting) -> None:
    """Keeps every message that arrives from now on for the viewer, however old it is: a viewer controls nothing."""

    def receive(topic: Topic[Any], decoder: msgspec.msgpack.Decoder[Message], _key: str, payload: Payload) -> None:
        with suppress(msgspec.MsgspecError, ValueError, RecursionError):
            waiting.put(topic.name, decoder.decode(bytes(payload)))  # a copy: the bus takes its memory back

    for topic in TOPICS:
        if PER_SERVICE not in topic.name:
            handler = partial(receive, topic, msgspec.msgpack.Decoder(topic.type))
            bus.subscribe(topic.key(robot), topic.qos, handler, depth=DEPTH)
