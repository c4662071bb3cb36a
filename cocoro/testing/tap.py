"""What was said on a mesh."""

from __future__ import annotations

from typing import Any, TypeVar

import msgspec

from cocoro.bus.base import Payload
from cocoro.bus.local import LocalBus
from cocoro.messages import Message
from cocoro.topics import Qos, Topic, topic_named

M = TypeVar("M", bound=Message)


class Tap:
    """Everything that is published under one robot's name, in order, as it travelled."""

    def __init__(self, bus: LocalBus, robot_name: str) -> None:
        self._prefix = f"{robot_name}/"
        self._payloads: list[tuple[str, bytes]] = []
        bus.subscribe(f"{robot_name}/**", Qos.EVENT, self._take, depth=1)

    def _take(self, key: str, payload: Payload) -> None:
        self._payloads.append((key.removeprefix(self._prefix), bytes(payload)))

    def messages(self, topic: Topic[M]) -> list[M]:
        """All of one topic so far. Raises msgspec.ValidationError for what should never have been published."""
        decoder = msgspec.msgpack.Decoder(topic.type)
        return [decoder.decode(payload) for name, payload in self._payloads if name == topic.name]

    def samples(self) -> dict[tuple[str, int, int], Message]:
        """All messages by (topic, incarnation, sequence), as a StepRecord names them."""
        found: dict[tuple[str, int, int], Message] = {}
        for name, payload in self._payloads:
            topic: Topic[Any] | None = topic_named(name)
            if topic is not None:
                message = msgspec.msgpack.decode(payload, type=topic.type)
                found[name, message.incarnation, message.seq] = message
        return found

    def forget(self) -> None:
        self._payloads.clear()
