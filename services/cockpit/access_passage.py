"""The way of each request through the gate to the service, and of each answer back: an ASGI application around another.

An answer gets the security headers. A message that is too long, too frequent or no text ends its socket with a reason
that the page can show. A STOP passes even where its socket has used up its messages.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable

from services.cockpit import access_rules as rules
from services.cockpit.access import App, Gate, Message, Receive, Send, Visitor
from services.cockpit.access_limits import Bucket
from services.cockpit.access_rules import VISITOR, Refusal, Scope

TOO_LONG, NO_TEXT, TOO_MANY, ENDED = 1009, 1003, 1008, 4401
"""Codes with which a socket is closed; the last is the cockpit's own: the visitor's session has ended."""
MALFORMED = (1002, 1007, 1009)
"""Codes with which the server has closed a socket by itself."""
STARTS = ("http.response.start", "websocket.http.response.start")
STOP_MOST = 256
"""A longer message is no STOP."""


class Passage:
    """The ASGI application."""

    def __init__(self, gate: Gate, inner: App) -> None:
        self._gate, self._inner = gate, inner

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._inner(scope, receive, send)
            return
        connection = self._gate.connection(scope)
        if connection is not None:
            connection.begins()
        try:
            await self._passed(scope, receive, send)
        finally:
            if connection is not None:
                connection.ends()

    async def _passed(self, scope: Scope, receive: Receive, send: Send) -> None:
        gate, headers = self._gate, rules.headers_of(scope)
        secured = _Secured(send, headers, gate.names, tls=gate.tls)
        refusal = gate.judge(scope, headers)
        if refusal is not None:
            await self._refuse(scope, receive, secured, refusal)
            return
        visitor = gate.who(scope)
        refusal = gate.overdrawn(scope, visitor)
        if refusal is not None:
            await self._refuse(scope, receive, secured, refusal)
            return
        http = scope["type"] == "http"
        receive = _limited(receive, gate.limits.body_bytes, gate.limits.body_s) if http else receive
        try:
            answer = await gate.own_page(scope, receive) if http else None
            if answer is not None:
                await _answer(secured, *answer)
                return
            if visitor is None:
                await self._send_to_login(scope, receive, secured)
                return
            scope[VISITOR] = visitor
            if http:
                await self._request(scope, receive, secured, visitor)
            else:
                await self._socket(scope, receive, secured, visitor)
        except _BodyError as error:
            if secured.begun:
                raise  # the server ends the connection
            await self._refuse(scope, receive, secured, error.refusal)

    async def _send_to_login(self, scope: Scope, receive: Receive, send: Send) -> None:
        opens = scope["type"] == "http" and scope["method"] == "GET" and scope["path"] == "/"
        if opens and self._gate.tls:
            await _answer(send, 303, [(b"location", b"/login")], b"")
            return
        await self._refuse(scope, receive, send, Refusal(401, "nobody", "Log in at /login.\n"))

    async def _request(self, scope: Scope, receive: Receive, send: Send, visitor: Visitor) -> None:
        if self._gate.allows(visitor, rules.doing_of(scope["method"], scope["path"])):
            await self._inner(scope, receive, send)
        else:
            text = f"A {visitor.role} may look and stop; this is for an operator.\n"
            await _answer(send, 403, [], text.encode())

    async def _socket(self, scope: Scope, receive: Receive, send: Send, visitor: Visitor) -> None:
        sockets, limits = self._gate.sockets, self._gate.limits
        if not self._gate.openings.take(visitor.key):
            refusal = Refusal(429, "too many new sockets", "Too many pages were opened: wait a second.\n")
            await self._refuse(scope, receive, send, refusal)
            return
        if sockets.get(visitor.key, 0) >= limits.sockets or sum(sockets.values()) >= limits.sockets_all:
            refusal = Refusal(503, "too many sockets", "Too many pages are open: close one.\n")
            await self._refuse(scope, receive, send, refusal)
            return
        sockets[visitor.key] = sockets.get(visitor.key, 0) + 1
        try:
            socket = _Socket(self._gate, scope, visitor, receive, send)
            await self._inner(scope, socket.receive, socket.send)
        finally:
            sockets[visitor.key] -= 1
            if not sockets[visitor.key]:
                del sockets[visitor.key]

    async def _refuse(self, scope: Scope, receive: Receive, send: Send, refusal: Refusal) -> None:
        who = self._gate.address(scope)
        self._gate.audit.refused(who, refusal.what, f"{scope.get('method', 'SOCKET')} {scope['path']}")
        body = refusal.text.encode()
        if scope["type"] == "http":
            more = [(b"retry-after", b"1")] if refusal.status in (429, 503) else []
            await _answer(send, refusal.status, [(b"connection", b"close"), *more], body)
            return
        await receive()  # websocket.connect
        if "websocket.http.response" in scope.get("extensions", {}):
            rows = [(b"content-type", b"text/plain; charset=utf-8"), (b"content-length", str(len(body)).encode())]
            await send({"type": "websocket.http.response.start", "status": refusal.status, "headers": rows})
            await send({"type": "websocket.http.response.body", "body": body})
        else:
            await send({"type": "websocket.close", "code": TOO_MANY, "reason": refusal.what})


class _Socket:
    """Counts the messages of one socket."""

    def __init__(self, gate: Gate, scope: Scope, visitor: Visitor, receive: Receive, send: Send) -> None:
        self._gate, self._scope, self._visitor = gate, scope, visitor
        self._receive, self._send = receive, send
        self._messages = Bucket(gate.limits.messages, gate.clock())
        self._again_s = gate.clock() + gate.limits.again_s
        self._closed = False

    async def receive(self) -> Message:
        if self._closed:
            return {"type": "websocket.disconnect", "code": TOO_MANY}
        message = await self._receive()
        if message["type"] != "websocket.receive":
            if message.get("code") in MALFORMED:
                self._gate.audit.refused(f"{self._visitor.name}, {self._visitor.key}", "socket: malformed")
            return message
        text = message.get("text")
        if not self._messages.take(self._gate.clock()):
            if text is not None and is_stop_message(text) and self._gate.stops.take(self._visitor.key):
                return message
            return await self._close(TOO_MANY, "too many messages")
        if text is None:
            return await self._close(NO_TEXT, "messages are text")
        if len(text) > self._gate.limits.message_bytes:
            return await self._close(TOO_LONG, "a message is too long")
        if self._ended():
            return await self._close(ENDED, "the session has ended")
        return message

    async def send(self, message: Message) -> None:
        if self._closed:
            return
        if message["type"] == "websocket.send" and self._ended():
            await self._close(ENDED, "the session has ended")
            return
        await self._send(message)

    def _ended(self) -> bool:
        """Whether the visitor is no longer the one who came."""
        now_s = self._gate.clock()
        if now_s < self._again_s:
            return False
        self._again_s = now_s + self._gate.limits.again_s
        return self._gate.looked_up(self._scope) != self._visitor

    async def _close(self, code: int, reason: str) -> Message:
        if not self._closed:
            self._closed = True
            self._gate.audit.refused(f"{self._visitor.name}, {self._visitor.key}", f"socket: {reason}")
            await self._send({"type": "websocket.close", "code": code, "reason": reason})
        return {"type": "websocket.disconnect", "code": code}


def is_stop_message(text: str) -> bool:
    """Whether a message is a STOP; cheap, for one of a client that sends too many."""
    if len(text) > STOP_MOST or '"stop"' not in text:
        return False
    import msgspec

    try:
        found = msgspec.json.decode(text)
    except msgspec.DecodeError:
        return False
    return isinstance(found, dict) and found.get("do") == "stop"


class _BodyError(Exception):
    def __init__(self, refusal: Refusal) -> None:
        super().__init__(refusal.what)
        self.refusal = refusal


def _limited(receive: Receive, most: int, seconds: float) -> Receive:
    """As `receive`, for a body of at most `most` bytes that is whole within `seconds`. Raises _BodyError."""
    count, whole, until_s = 0, False, asyncio.get_running_loop().time() + seconds

    async def next_part() -> Message:
        nonlocal count, whole
        if whole:  # it waits for the client's end, for as long as its answer takes
            return await receive()
        try:
            async with asyncio.timeout_at(until_s):
                message = await receive()
        except TimeoutError:
            raise _BodyError(Refusal(408, "slow body", "The request's body did not come.\n")) from None
        count += len(message.get("body", b""))
        whole = not message.get("more_body", False)
        if count > most:
            raise _BodyError(Refusal(413, "long body", f"A request's body may have {most} bytes.\n"))
        return message

    return next_part


class _Secured:
    """As `send`, with the security headers in each answer."""

    def __init__(self, send: Send, headers: dict[str, list[str]], names: frozenset[str], *, tls: bool) -> None:
        host = (headers.get("host") or [""])[0]
        known = rules.host_name(host) in names
        self._rows = rules.security_headers(host if known else "localhost", tls=tls)
        self._send = send
        self.begun = False
        """Whether an answer has begun."""

    async def __call__(self, message: Message) -> None:
        self.begun = True
        if message["type"] in STARTS:
            names = {name for name, _ in self._rows}
            rows = [row for row in message.get("headers", ()) if row[0].lower() not in names]
            if not any(name.lower() == b"cache-control" for name, _ in rows):
                rows.append((b"cache-control", b"no-store"))
            message = {**message, "headers": [*rows, *self._rows]}
        await self._send(message)


async def _answer(send: Send, status: int, rows: Iterable[tuple[bytes, bytes]], body: bytes) -> None:
    given = list(rows)
    if not any(name == b"content-type" for name, _ in given):
        given.append((b"content-type", b"text/plain; charset=utf-8"))
    given.append((b"content-length", str(len(body)).encode()))
    await send({"type": "http.response.start", "status": status, "headers": given})
    await send({"type": "http.response.body", "body": body})
