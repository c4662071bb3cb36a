"""A robot live in Foxglove: a WebSocket server of foxglove-sdk that shows the mesh's messages and offers services.

A viewer gets only what it has subscribed to, and only that is made. The server never waits for a viewer: what a slow
one does not take in time is dropped.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from types import TracebackType
from typing import Any, NamedTuple

import foxglove
import msgspec
from foxglove import channels, websocket

from apps.captures.export.foxglove_scene import TOPICS, FoxgloveScene, for_json
from cocoro.capture.types import schema_of
from cocoro.clock import NS
from cocoro.errors import ConfigError
from cocoro.messages import Frame, Message
from cocoro.objects import Catalogue
from cocoro.robot import Robot
from cocoro.topics import Topic

logging.getLogger("foxglove").setLevel(logging.CRITICAL)  # each viewer that is gone is an error to it
BACKLOG = 256
"""Messages that may wait for a viewer; the oldest are dropped."""
AGAIN_NS = NS
"""Period at which what does not change is shown again."""
BACK_NS = NS
"""A stamp that is older than the newest one by more is of a clock that began anew."""
JSON = "json"


class Service(NamedTuple):
    """What a viewer may ask for."""

    name: str
    """Begins with a slash."""
    question: type[msgspec.Struct]
    """Its fields are those of the request, which is a JSON object."""
    answer: Callable[[dict[str, Any]], dict[str, Any]]
    """Called in a thread of the server. The viewer is told the text of what it raises."""


class FoxgloveServer:
    """A context manager; the server listens from its making on."""

    def __init__(
        self,
        name: str,
        robot: Robot,
        catalogue: Catalogue,
        topics: Iterable[Topic[Any]],
        *,
        host: str,
        port: int,
        services: Iterable[Service] = (),
    ) -> None:
        """`name`: the robot's on the mesh. `topics`: those whose messages are there as JSON, for plots, beside what is
        shown. `port`: 0 is any free one. Raises ConfigError when nobody can listen there.

        The server asks nobody where he comes from; `apps.cli.foxglove_door` does.
        """
        self._context = foxglove.Context()
        self._shown = {
            topic: getattr(channels, f"{kind.__name__}Channel")(topic, context=self._context)
            for topic, kind in TOPICS.items()
        }
        self._plain = {
            topic.name: foxglove.Channel(
                topic.key(name), schema=_schema(topic.type), message_encoding=JSON, context=self._context
            )
            for topic in topics
            if topic.type is not Frame
        }
        self._make_scene: Callable[[], FoxgloveScene] = lambda: FoxgloveScene(
            robot, catalogue, wanted=lambda topic: bool(self._shown[topic].has_sinks()), depth=True, again_ns=AGAIN_NS
        )
        self._scene = self._make_scene()
        self._newest_ns = 0
        offered = [_offer(service) for service in services]
        try:
            self._server = foxglove.start_server(
                name=f"CoCoRo mesh: {name}",
                host=host,
                port=port,
                context=self._context,
                services=offered,
                capabilities=[websocket.Capability.Services] if offered else [],
                supported_encodings=[JSON],
                message_backlog_size=BACKLOG,
            )
        except (RuntimeError, OSError) as error:
            raise ConfigError(f"Foxglove cannot be served at {host}:{port}: {error}; give another --port") from error
        self.port: int = self._server.port
        self.host = host

    @property
    def address(self) -> str:
        """Where a viewer connects to, `ws://...`."""
        return f"ws://{f'[{self.host}]' if ':' in self.host else self.host}:{self.port}"

    def log(self, topic: str, message: Message) -> None:
        """Show one of the mesh's messages, of the topic of a name. To be called in one thread."""
        stamp_ns = message.stamp_ns
        if stamp_ns < self._newest_ns - BACK_NS:
            self._scene, self._newest_ns = self._make_scene(), stamp_ns
            self._server.clear_session()
        self._newest_ns = max(self._newest_ns, stamp_ns)
        for shown in self._scene.of(message):
            channel = self._shown[shown.topic]
            if channel.has_sinks():
                channel.log(shown.message, log_time=stamp_ns)
        plain = self._plain.get(topic)
        if plain is not None and plain.has_sinks():
            data = for_json(msgspec.to_builtins(message, builtin_types=(bytes, memoryview)))
            plain.log(msgspec.json.encode(data), log_time=stamp_ns)

    def __enter__(self) -> FoxgloveServer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.stop()


def _schema(kind: type[msgspec.Struct]) -> foxglove.Schema:
    found = schema_of(kind)
    return foxglove.Schema(name=found.name, encoding=found.encoding, data=found.data)


def _offer(service: Service) -> websocket.Service:
    def answer(request: websocket.ServiceRequest) -> bytes:
        given = msgspec.json.decode(request.payload or b"{}")
        if not isinstance(given, dict):
            raise ValueError("give a JSON object, with the names of the fields and their values")
        return msgspec.json.encode(service.answer(given))

    shape = foxglove.MessageSchema(encoding=JSON, schema=_schema(service.question))
    return websocket.Service(service.name, schema=websocket.ServiceSchema(service.name, request=shape), handler=answer)
