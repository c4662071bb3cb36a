"""What was said on a mesh."""

from __future__ import annotations

from typing import Any, TypeVar, cast

import msgspec

from cocoro.bus.base import Payload, Qos
from cocoro.bus.local import LocalBus
from cocoro.installed import topic_named
from cocoro.keys import recorder_key
from cocoro.messages import Message
from cocoro.topics import Topic

M = TypeVar("M", bound=Message)


class Tap:
    """Everything that is published under one robot's name, in order for each topic, as it travelled. A recorder, to
    those who wait for one before their first step."""

    def __init__(self, bus: LocalBus, robot_name: str) -> None:
        self._prefix = f"{robot_name}/"
        self._payloads: dict[str, list[bytes]] = {}
        self._decoded: dict[str, list[Message]] = {}
        bus.subscribe(f"{robot_name}/**", Qos.EVENT, self._take, depth=1)
        bus.declare_alive(recorder_key(robot_name, "tap"))

    def _take(self, key: str, payload: Payload) -> None:
        self._payloads.setdefault(key.removeprefix(self._prefix), []).append(bytes(payload))

    def messages(self, topic: Topic[M]) -> list[M]:
        """All of one topic so far. Raises msgspec.ValidationError for what should never have been published."""
        payloads, decoded = self._payloads.get(topic.name, []), self._decoded.setdefault(topic.name, [])
        decoder = msgspec.msgpack.Decoder(topic.type)
        decoded.extend(decoder.decode(payload) for payload in payloads[len(decoded) :])
        return cast("list[M]", list(decoded))

    def samples(self) -> dict[tuple[str, int, int], Message]:
        """All messages by (topic, incarnation, sequence), as a StepRecord names them."""
        topics: list[Topic[Any]] = [topic for topic in map(topic_named, self._payloads) if topic is not None]
        return {
            (topic.name, message.incarnation, message.seq): message
            for topic in topics
            for message in self.messages(topic)
        }

    def forget(self) -> None:
        self._payloads.clear()
        self._decoded.clear()
