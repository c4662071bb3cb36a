"""A participant of a robot's mesh: reads topics, calls requests, watches which services are alive.

A service is a `cocoro.node.Node`, which also publishes and serves. The command line is a participant alone.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import msgspec

from cocoro.bus.base import Bus, Handle, Qos, Reply
from cocoro.clock import Clock
from cocoro.errors import CallTimeoutError, MeshError, RemoteError
from cocoro.inbox import Inbox, Latest, Stream
from cocoro.keys import alive_key, service_of
from cocoro.messages import Message
from cocoro.topics import Request, Topic

M = TypeVar("M", bound=Message)
Q = TypeVar("Q", bound=msgspec.Struct)
R = TypeVar("R", bound=msgspec.Struct)


_APART = 1.5
"""Periods of a request's limit between two of the same."""


class Answer(NamedTuple, Generic[R]):
    """One service's answer to a request."""

    service: str
    reply: R | None
    """None when the service answered with an error, or with something that is not the request's reply."""
    error: str


class Participant:
    """Reads, calls and watches on one robot's mesh. Everything that it declares is undeclared by `close`."""

    onlooker: ClassVar[bool] = False
    """Whether it acts on nothing that it reads, so that it accepts messages of any age."""
    frame_depth: ClassVar[int] = 2
    """Frames that may wait for the event loop, per key."""
    depth: ClassVar[int] = 256
    """Other messages that may wait for the event loop, per key."""
    paced: bool = False
    """Whether the same request is asked no sooner than a site lets it pass (`Request.most_hz`)."""

    def __init__(self, bus: Bus, clock: Clock, robot_name: str) -> None:
        self.bus = bus
        self.clock = clock
        self.robot_name = robot_name
        self._inboxes: dict[str, Inbox[Any]] = {}
        self._handles: list[Handle] = []
        self._may_ask_s: dict[str, float] = {}
        """When each request may be asked next, on the event loop's clock, by name."""

    def keep(self, handle: Handle) -> None:
        """Closes the handle together with this participant."""
        self._handles.append(handle)

    def close(self) -> None:
        for handle in reversed(self._handles):
            handle.close()
        self._handles.clear()

    # --- reading ----------------------------------------------------------------------------------

    def inbox(self, topic: Topic[M], *, service: str | None = None) -> Inbox[M]:
        """The one inbox of a topic; `service='*'` reads a per-service topic of all services."""
        if service is not None:
            topic = topic.of(service)
        if topic.name not in self._inboxes:
            key = topic.key(self.robot_name)
            inbox = self._inboxes[topic.name] = Inbox(topic, key, self.clock, onlooker=self.onlooker)
            depth = self.frame_depth if topic.qos is Qos.FRAME else self.depth
            inbox.subscription = self.bus.subscribe(key, topic.qos, inbox.deliver, depth=depth)
            self._handles.append(inbox.subscription)
        return self._inboxes[topic.name]

    def drop(self, topic: Topic[Any]) -> None:
        """Ends the subscription of a topic's inbox, if there is one."""
        inbox = self._inboxes.pop(topic.name, None)
        if inbox is not None and inbox.subscription is not None:
            self._handles.remove(inbox.subscription)
            inbox.subscription.close()

    def latest(self, topic: Topic[M], *, service: str | None = None) -> Latest[M]:
        return Latest(self.inbox(topic, service=service), self.clock)

    def stream(self, topic: Topic[M], *, service: str | None = None) -> Stream[M]:
        return Stream(self.inbox(topic, service=service))

    async def newest(self, topic: Topic[M], timeout_s: float) -> list[M]:
        """The newest message of an `askable` topic, from each of its publishers that answers in time: for who has just
        joined and would wait for the next. It is as unchecked as every reply."""
        try:
            replies = await self.bus.call(topic.key(self.robot_name), b"", timeout_s)
        except CallTimeoutError:
            return []
        found = []
        for reply in replies:
            if reply.ok:
                with suppress(msgspec.MsgspecError):
                    found.append(msgspec.msgpack.decode(reply.payload, type=topic.type))
        return found

    def on(self, topic: Topic[M], handler: Callable[[M], None], *, service: str | None = None) -> None:
        """Calls `handler(message)` for each message, alone, as a callback of the event loop. It must be short, and use
        nothing that belongs to a thread: see `cocoro.lending`."""
        self.inbox(topic, service=service).add(lambda _key, message: handler(message))

    # --- requests ---------------------------------------------------------------------------------

    async def call(self, request: Request[Q, R], question: Q, timeout_s: float | None = None) -> R:
        """Calls a request and returns the reply. Raises MeshError when no service serves it (CallTimeoutError when none
        answers in time), and RemoteError with the service's text when it answers with an error."""
        answers = await self._ask(request, question, timeout_s)
        if not answers:
            raise MeshError(self.unserved(request))
        reply = answers[0].reply
        if reply is None:
            raise RemoteError(self.refused(answers[0]))
        return reply

    async def call_all(self, request: Request[Q, R], question: Q, timeout_s: float | None = None) -> list[Answer[R]]:
        """Calls all services that serve a request (with `*` in its name). All answers, errors included; an empty list
        when no service answers in time."""
        try:
            return await self._ask(request, question, timeout_s)
        except CallTimeoutError:
            return []

    async def _ask(self, request: Request[Q, R], question: Q, timeout_s: float | None) -> list[Answer[R]]:
        wait_s = request.timeout_s if timeout_s is None else timeout_s
        if self.paced:
            await self._pause(request)
        replies = await self.bus.call(
            request.key(self.robot_name), msgspec.msgpack.encode(question), wait_s, request.qos
        )
        return [_decoded(request, reply) for reply in replies]

    async def _pause(self, request: Request[Any, Any]) -> None:
        """Wait until the request may be asked again. The network may bring two questions nearer to each other than they
        were, by up to a third of the period."""
        loop = asyncio.get_running_loop()
        at_s = max(loop.time(), self._may_ask_s.get(request.name, 0.0))
        self._may_ask_s[request.name] = at_s + _APART / request.most_hz
        await asyncio.sleep(at_s - loop.time())

    def unserved(self, request: Request[Any, Any]) -> str:
        """The error's text when no service serves a request."""
        return f"nobody answers {request.key(self.robot_name)}: is {request.server} running?"

    def refused(self, answer: Answer[Any]) -> str:
        """The error's text when a service answers with an error."""
        return answer.error

    # --- liveliness -------------------------------------------------------------------------------

    async def alive(self) -> list[str]:
        """The services of this robot that are alive now, sorted."""
        return sorted(service_of(key) for key in await self.bus.alive(alive_key(self.robot_name)))

    def watch_alive(self, handler: Callable[[str, bool], None], service: str = "*") -> Handle:
        """Calls `handler(service, alive)` whenever a service (by default any) of this robot becomes alive or ceases to
        be; first for those that are alive already. One that ceased need not be dead: see `cocoro.contact`."""
        handle = self.bus.watch_alive(
            alive_key(self.robot_name, service), lambda key, alive: handler(service_of(key), alive)
        )
        self._handles.append(handle)
        return handle


def _decoded(request: Request[Q, R], reply: Reply) -> Answer[R]:
    service = service_of(reply.key) or request.server
    if not reply.ok:
        return Answer(service, None, reply.payload.decode(errors="replace"))
    try:
        return Answer(service, msgspec.msgpack.decode(reply.payload, type=request.reply), "")
    except msgspec.MsgspecError as error:
        return Answer(service, None, f"{reply.key} answered something that is not a {request.reply.__name__}: {error}")
