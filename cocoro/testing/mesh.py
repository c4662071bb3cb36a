"""Observers of a mesh: all messages that travel, and what one component does on its bus."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, TypeVar, cast

import msgspec

from cocoro.bus.base import Handle, OnBatch, OnSample, Payload, Qos, Reply, Server
from cocoro.bus.local import LocalBus, LocalMesh, LocalPublisher, LocalSubscription
from cocoro.component import Component
from cocoro.installed import topic_named
from cocoro.keys import recorder_key
from cocoro.messages import Message
from cocoro.topics import ABOUT, CLOCK, EXCHANGES, HEALTH, STEPS, Request, Topic

M = TypeVar("M", bound=Message)

BY_EVERY_NODE = {row.name for row in (HEALTH, STEPS, EXCHANGES, ABOUT, CLOCK)}
"""Topics and requests of the node itself, which components do not declare."""


class Tap:
    """Keeps all messages of one robot, in order for each topic, as they travel. It declares itself a recorder, because
    a core whose steps are recorded waits for one."""

    def __init__(self, bus: LocalBus, robot_name: str) -> None:
        self._prefix = f"{robot_name}/"
        self._payloads: dict[str, list[bytes]] = {}
        self._decoded: dict[str, list[Message]] = {}
        self._left_out: set[str] = set()
        bus.subscribe(f"{robot_name}/**", Qos.EVENT, self._take, depth=1)
        bus.declare_alive(recorder_key(robot_name, "tap"))

    def _take(self, key: str, payload: Payload) -> None:
        name = key.removeprefix(self._prefix)
        if name not in self._left_out:
            self._payloads.setdefault(name, []).append(bytes(payload))

    def leave_out(self, topic: Topic[Any]) -> None:
        """Keep no more messages of a topic: frames are large."""
        self._left_out.add(topic.name)

    def messages(self, topic: Topic[M]) -> list[M]:
        """All messages of a topic so far. Raises msgspec.ValidationError for a message that is not valid."""
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
        """Drop the messages so far."""
        self._payloads.clear()
        self._decoded.clear()


class NotedBus(LocalBus):
    """A participant of a `LocalMesh` whose uses of the bus are noted, by names without the robot."""

    def __init__(self, mesh: LocalMesh, robot_name: str) -> None:
        super().__init__(mesh)
        self.publishes: set[str] = set()
        self.reads: set[str] = set()
        self.serves: set[str] = set()
        self.calls: set[str] = set()
        self.records = False
        self._prefix = f"{robot_name}/"

    def publisher(self, key: str, qos: Qos) -> LocalPublisher:
        self.publishes.add(self._name(key))
        return super().publisher(key, qos)

    def subscribe(self, keyexpr: str, qos: Qos, handler: OnSample, *, depth: int) -> LocalSubscription:
        self.reads.add(self._name(keyexpr))
        return super().subscribe(keyexpr, qos, handler, depth=depth)

    def listen(self, keyexpr: str, handler: OnBatch, every_s: float) -> Handle:
        self.records = True
        return super().listen(keyexpr, handler, every_s)

    def serve(self, key: str, server: Server) -> Handle:
        self.serves.add(self._name(key))
        return super().serve(key, server)

    async def call(self, keyexpr: str, payload: bytes, timeout_s: float, qos: Qos = Qos.COMMAND) -> list[Reply]:
        self.calls.add(self._name(keyexpr))
        return await super().call(keyexpr, payload, timeout_s, qos)

    def _name(self, key: str) -> str:
        return key.removeprefix(self._prefix)


def misdeclared(component: Component, *buses: NotedBus) -> list[str]:
    """The differences, in words, between a component's declaration and its uses of these buses; empty when they agree.
    A use that these runs did not come to counts as a difference."""
    found = [*_differences("publishes", component.all_publishes(), {name for bus in buses for name in bus.publishes})]
    found += _differences("reads", component.reads, {name for bus in buses for name in bus.reads})
    newest = {name for bus in buses for name in bus.publishes}  # which a node serves of itself
    found += _differences("serves", component.all_serves(), {name for bus in buses for name in bus.serves} - newest)
    found += _differences("calls", component.calls, {name for bus in buses for name in bus.calls})
    if component.records != any(bus.records for bus in buses):
        found.append(f"records is declared as {component.records}")
    return found


def _differences(verb: str, declared: Iterable[Topic[Any] | Request[Any, Any]], used: set[str]) -> Iterator[str]:
    names = {row.name for row in declared}
    unused = set(names)
    for name in sorted(used):
        general = "{service}/" + name.partition("/")[2]
        if {name, general} & names:
            unused -= {name, general}
        elif not {name, general} & BY_EVERY_NODE:
            yield f"it {verb} {name}, which it does not declare"
    yield from (f"it declares that it {verb} {name}, and does not" for name in sorted(unused))
