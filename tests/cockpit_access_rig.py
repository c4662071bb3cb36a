"""The cockpit's gate around a small application: asked as ASGI in virtual time, or over real sockets."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterable
from contextlib import asynccontextmanager
from typing import Any, NamedTuple

from services.cockpit import server
from services.cockpit.access import App, Certificates, Gate, GateLimits, Message, Receive, Send, Visitor
from services.cockpit.access_connection import Connection
from services.cockpit.access_door import Door
from services.cockpit.access_limits import Audit, DoorLimits
from services.cockpit.access_people import People
from services.cockpit.access_rules import LOOPBACK_NAMES, Scope
from services.cockpit.access_tls import Entrance

HOST = "127.0.0.1:8770"
ADDRESS = ("127.0.0.1", 50000)


class Heard(Audit):
    """Keeps the log's lines."""

    def __init__(self, clock: Any = None) -> None:
        super().__init__(clock or (lambda: 0.0))
        self.lines: list[str] = []

    def _line(self, who: str, what: str, detail: str, more: int) -> None:
        super()._line(who, what, detail, more)
        self.lines.append(f"{who}: {what} ({detail})")

    def has(self, *parts: str) -> bool:
        """Whether a line has all these parts."""
        return any(all(part in line for part in parts) for line in self.lines)


class Fixed(Gate):
    """A gate whose visitor is given."""

    visitor: Visitor | None = Visitor("owner", "operator", "user 0")

    def looked_up(self, scope: Scope) -> Visitor | None:
        return self.visitor


class Answer(NamedTuple):
    """What came of a request."""

    status: int
    headers: dict[str, str]
    body: bytes


class Echo:
    """An application that answers everything, and remembers what it got."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.messages: list[str] = []

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            await self._socket(receive, send)
            return
        body, more = b"", True
        while more:
            message = await receive()
            body, more = body + message.get("body", b""), message.get("more_body", False)
        self.asked.append(f"{scope['method']} {scope['path']}")
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-type", b"text/plain")]})
        await send({"type": "http.response.body", "body": b"echo " + body})

    async def _socket(self, receive: Receive, send: Send) -> None:
        await receive()
        await send({"type": "websocket.accept"})
        while (message := await receive())["type"] == "websocket.receive":
            text = message.get("text") or ""
            self.messages.append(text)
            if text.startswith("send "):
                await send({"type": "websocket.send", "bytes": b"x" * int(text[5:])})
            else:
                await send({"type": "websocket.send", "text": text})


def head(
    method: str = "GET",
    path: str = "/",
    headers: Iterable[tuple[str, str]] = (),
    *,
    host: str | None = HOST,
    scheme: str = "http",
    client: tuple[str, int] = ADDRESS,
) -> Scope:
    """A request's scope."""
    rows = [(name.lower().encode("latin-1"), value.encode("latin-1")) for name, value in headers]
    if host is not None:
        rows.insert(0, (b"host", host.encode("latin-1")))
    kind = "websocket" if scheme.startswith("ws") else "http"
    found: Scope = {
        "type": kind, "scheme": scheme, "path": path.partition("?")[0], "raw_path": path.partition("?")[0].encode(),
        "query_string": path.partition("?")[2].encode(), "headers": rows, "client": client, "http_version": "1.1",
    }  # fmt: skip
    if kind == "http":
        found["method"] = method
    return found


async def ask(app: App, scope: Scope, body: bytes = b"") -> Answer:
    """Sends a request of HTTP through an application."""
    parts: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]
    sent: list[Message] = []

    async def receive() -> Message:
        return parts.pop(0) if parts else {"type": "http.disconnect"}

    async def send(message: Message) -> None:
        sent.append(message)

    await app(scope, receive, send)
    start = next(message for message in sent if message["type"] == "http.response.start")
    headers = {name.decode().lower(): value.decode() for name, value in start["headers"]}
    return Answer(start["status"], headers, b"".join(message.get("body", b"") for message in sent))


class Spoken(NamedTuple):
    """What came of a socket."""

    accepted: bool
    code: int
    reason: str
    texts: list[str]


async def speak(app: App, scope: Scope, messages: Iterable[Message | str]) -> Spoken:
    """Opens a socket through an application, and sends messages."""
    waiting: list[Message] = [{"type": "websocket.connect"}]
    waiting += [{"type": "websocket.receive", "text": each} if isinstance(each, str) else each for each in messages]
    sent: list[Message] = []

    async def receive() -> Message:
        await asyncio.sleep(0)
        return waiting.pop(0) if waiting else {"type": "websocket.disconnect", "code": 1000}

    async def send(message: Message) -> None:
        sent.append(message)

    await app(scope, receive, send)
    closed = next((message for message in sent if message["type"] == "websocket.close"), {})
    return Spoken(
        any(message["type"] == "websocket.accept" for message in sent),
        closed.get("code", 0),
        closed.get("reason", ""),
        [message["text"] for message in sent if "text" in message],
    )


class Open(NamedTuple):
    """A cockpit that is served."""

    port: int
    gate: Gate
    door: Door
    echo: Echo
    audit: Heard

    def taken(self) -> list[Connection]:
        return list(self.door.connections.values())


@asynccontextmanager
async def served(
    entrance: Entrance | None = None,
    *,
    people: People | None = None,
    certificates: Certificates | None = None,
    door_limits: DoorLimits | None = None,
    gate_limits: GateLimits | None = None,
    echo: Echo | None = None,
) -> AsyncIterator[Open]:
    """The small application behind gate and door, at a free port of 127.0.0.1."""
    entrance = entrance or Entrance("127.0.0.1", False, LOOPBACK_NAMES)
    audit, echo = Heard(asyncio.get_running_loop().time), echo or Echo()
    gate = Gate(
        names=entrance.names, tls=entrance.served is not None, people=people, certificates=certificates,
        limits=gate_limits, audit=audit, door_limits=door_limits,
    )  # fmt: skip
    listening = server.listen("127.0.0.1", 0)
    async with server.serving(echo, gate, listening, entrance):
        assert gate.door is not None
        yield Open(listening.getsockname()[1], gate, gate.door, echo, audit)
