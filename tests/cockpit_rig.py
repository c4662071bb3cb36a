"""The cockpit in virtual time: its service on a mesh of its own, and pages that speak to its application directly."""

from __future__ import annotations

import asyncio
import json
import struct
from collections.abc import AsyncIterator, Mapping, MutableMapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cocoro.component import Implementation
from cocoro.messages import EstopReply, EstopRequest, Frame, KnownObject, ObjectsReply, ResetRequest, TasksReply
from cocoro.node import Node
from cocoro.task_table import described
from cocoro.testing import ServiceUnderTest
from cocoro.topics import ESTOP, OBJECTS, RESET, TASKS
from services.cockpit.access import Gate, Visitor
from services.cockpit.access_rules import Role
from services.cockpit.app import App
from services.cockpit.cockpit import Cockpit
from services.cockpit.config import CockpitConfig
from services.executive.tasks import FetchTask, ParkTask

HERE = ("127.0.0.1", 40_000)


class Knows(Gate):
    """Lets in visitors of one role."""

    def __init__(self, role: Role | None) -> None:
        super().__init__()
        self.role = role

    def who(self, scope: Mapping[str, Any]) -> Visitor | None:
        return None if self.role is None else Visitor("tester", self.role)


class Answer(NamedTuple):
    """The answer to an HTTP request."""

    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)


class Page:
    """A page's WebSocket. Use it as an asynchronous context manager."""

    def __init__(self, app: App, path: str = "/live", *, acknowledges: bool = True) -> None:
        self.accepted = False
        self.closed: tuple[int, str] | None = None
        """Code and reason of the server's end of the connection."""
        self.messages: list[dict[str, Any]] = []
        self.pictures: list[dict[str, Any]] = []
        """Headers, with the picture's bytes as `jpeg`."""
        self.acknowledges = acknowledges
        self.stuck = asyncio.Event()
        """While it is not set, nothing can be sent to this page."""
        self.stuck.set()
        self._app = app
        self._path, _, self._query = path.partition("?")
        self._to_app: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        self._work: asyncio.Future[None] | None = None

    async def __aenter__(self) -> Page:
        scope = {
            "type": "websocket", "path": self._path, "query_string": self._query.encode(), "client": HERE,
            "headers": [(b"host", b"127.0.0.1:8770")], "subprotocols": [], "scheme": "ws", "root_path": "",
        }  # fmt: skip
        self._work = asyncio.ensure_future(self._app.asgi(scope, self._to_app.get, self._take))
        self._to_app.put_nowait({"type": "websocket.connect"})
        await asyncio.sleep(0.001)
        return self

    async def __aexit__(self, *_: object) -> None:
        self._to_app.put_nowait({"type": "websocket.disconnect", "code": 1001})
        assert self._work is not None
        await self._work

    def say(self, do: str, **fields: Any) -> None:
        """Send a message."""
        self.say_raw(json.dumps({"do": do, **fields}))

    def say_raw(self, text: str) -> None:
        self._to_app.put_nowait({"type": "websocket.receive", "text": text})

    async def asks(self, do: str, **fields: Any) -> dict[str, Any]:
        """Send a request; returns its answer."""
        id = f"{do}-{len(self.messages)}"
        self.say(do, id=id, **fields)
        for _ in range(2000):
            await asyncio.sleep(0.01)
            for message in self.of("reply"):
                if message["id"] == id:
                    return message
        raise AssertionError(f"no answer to {do}")

    def of(self, kind: str) -> list[dict[str, Any]]:
        """The messages of one kind so far."""
        return [message for message in self.messages if message["kind"] == kind]

    @property
    def state(self) -> dict[str, Any]:
        """The newest state."""
        return self.of("state")[-1]

    async def _take(self, message: Mapping[str, Any]) -> None:
        await self.stuck.wait()
        if message["type"] == "websocket.accept":
            self.accepted = True
        elif message["type"] == "websocket.close":
            self.closed = message.get("code", 1000), message.get("reason") or ""
        elif message.get("text") is not None:
            self.messages.append(json.loads(message["text"]))
        else:
            self._take_picture(message["bytes"])

    def _take_picture(self, data: bytes) -> None:
        (length,) = struct.unpack_from("<I", data)
        header = json.loads(data[4 : 4 + length])
        self.pictures.append(header | {"jpeg": data[4 + length :]})
        if self.acknowledges:
            self.say("seen", stamp_ns=header["stamp_ns"])


class CockpitRig:
    """The cockpit under test, with an executive of few words."""

    def __init__(self, service: ServiceUnderTest, gate: Knows, made: list[tuple[Cockpit, App]]) -> None:
        self.service = service
        self.gate = gate
        self._made = made

    @property
    def app(self) -> App:
        return self._made[0][1]

    @property
    def cockpit(self) -> Cockpit:
        return self._made[0][0]

    def page(self, path: str = "/live", *, acknowledges: bool = True) -> Page:
        return Page(self.app, path, acknowledges=acknowledges)

    async def request(self, method: str, path: str, body: bytes = b"") -> Answer:
        """An HTTP request."""
        scope = {
            "type": "http", "method": method, "path": path, "raw_path": path.encode(), "query_string": b"",
            "headers": [(b"host", b"127.0.0.1:8770")], "client": HERE, "scheme": "http", "root_path": "",
            "http_version": "1.1",
        }  # fmt: skip
        asked: list[MutableMapping[str, Any]] = [{"type": "http.request", "body": body, "more_body": False}]
        answers: list[Mapping[str, Any]] = []

        async def receive() -> MutableMapping[str, Any]:
            if asked:
                return asked.pop()
            return await asyncio.get_running_loop().create_future()  # type: ignore[no-any-return] # never comes

        async def send(message: Mapping[str, Any]) -> None:
            answers.append(message)

        await self.app.asgi(scope, receive, send)
        headers = {name.decode(): value.decode() for name, value in answers[0]["headers"]}
        return Answer(answers[0]["status"], headers, b"".join(part.get("body", b"") for part in answers[1:]))

    def frame(self, *, shade: int = 90, width: int = 320, height: int = 240) -> Frame:
        """A frame of one shade, stamped with now."""
        colour = np.full((height, width, 3), shade, np.uint8)
        depth = np.full((height, width), 800, np.uint16)
        return Frame(
            width=width, height=height, colour=memoryview(colour.tobytes()), depth=memoryview(depth.tobytes()),
            stamp_ns=self.service.tester.now_ns(),
        )  # fmt: skip


def stoppable(rig: CockpitRig, *, silent: tuple[str, ...] = ()) -> list[str]:
    """Has base, arm and hand answer stops, and live; returns who stopped them, as they come."""
    asked: list[str] = []
    for service in ("base", "arm", "hand"):

        async def stop(question: EstopRequest, service: str = service) -> EstopReply:
            asked.append(question.by)
            return EstopReply(service=service, latch="latched")

        async def reset(_: ResetRequest, service: str = service) -> EstopReply:
            return EstopReply(service=service, latch="released")

        if service not in silent:
            rig.service.serve(ESTOP.of(service), stop)
            rig.service.serve(RESET.of(service), reset)
    rig.service.others_live("base", "arm", "hand")
    return asked


@asynccontextmanager
async def cockpit(folder: Path, role: Role | None = "operator", **settings: Any) -> AsyncIterator[CockpitRig]:
    """A cockpit whose captures lie in `folder`."""
    gate, made = Knows(role), list[tuple[Cockpit, App]]()

    async def run(node: Node, config: CockpitConfig) -> None:
        it = Cockpit(node, config)
        made.append((it, App(it, gate)))
        node.ready()
        await it.run()

    async with ServiceUnderTest(
        Implementation(CockpitConfig, run), {"folder": str(folder), **settings}, name="cockpit"
    ) as service:

        async def tasks(_: object) -> TasksReply:
            return TasksReply(tasks=(described(FetchTask), described(ParkTask)))

        async def objects(_: object) -> ObjectsReply:
            return ObjectsReply(
                objects=(KnownObject(label="red_can", shape="cylinder", size_m=(0.07, 0.07, 0.12), graspable=True),)
            )

        service.serve(TASKS, tasks)
        service.serve(OBJECTS, objects)
        service.others_live("executive")
        await service.settle()
        yield CockpitRig(service, gate, made)
