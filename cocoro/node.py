"""Node: what a component is written against.

    async with Node("planning", bus, clock, robot) as node:
        await node.drive(PlanningCore(...))

A node publishes with stamp, sequence and incarnation filled in, reads with every sample checked and counted,
answers typed requests, tells its health once a second, and holds the service's liveliness token.
"""

from __future__ import annotations

import asyncio
import logging
import os
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Mapping
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from cocoro import topics
from cocoro.about import about
from cocoro.bus.base import Bus, Handle, Payload, Qos, Reply
from cocoro.clock import NS, Clock, FollowedClock, VirtualClock
from cocoro.clock import sleep as clock_sleep
from cocoro.contact import Contact
from cocoro.core import Core
from cocoro.errors import CocoroError, MeshError, RemoteError
from cocoro.inbox import Inbox, Latest, Stream
from cocoro.loops import LoopMeter, every
from cocoro.messages import AboutReply, AboutRequest, Exchange, Health, Message
from cocoro.meter import ProcessMeter
from cocoro.publisher import Publisher
from cocoro.robot import Robot
from cocoro.stepper import Stepper, drive
from cocoro.tokens import alive_key
from cocoro.topics import EXCHANGES, HEALTH, Request, Topic

M = TypeVar("M", bound=Message)
Q = TypeVar("Q", bound=msgspec.Struct)
R = TypeVar("R", bound=msgspec.Struct)

QUESTION_BYTES = 1024 * 1024
"""A larger question is refused unread."""


class Node:
    """One service on the mesh. Use it as an asynchronous context manager."""

    def __init__(
        self,
        name: str,
        bus: Bus,
        clock: Clock,
        robot: Robot,
        *,
        robot_name: str | None = None,
        latency_s: float = 0.0,
        record_steps: bool = False,
        health_hz: float = 1.0,
        module: str = "",
        config: Any = None,
        profile: Mapping[str, Any] | None = None,
        latches: Path | None = None,
        contact: Contact | None = None,
    ) -> None:
        """`latency_s` is added to every step of a driven core that gives outputs, as if computing them took longer.
        `module` and `config` are the component that runs here, for those who ask (see `cocoro.about`).
        `profile` is the resolved profile that it was started with, as data.
        `latches` is the folder of the emergency stop's records; without it nothing is kept, and the stop path is not
        listened to (a service in a process of its own has it). `contact` knows what became of services that are not
        heard any more."""
        self.name = name
        self.bus = bus
        self.clock = clock
        self.robot = robot
        self.robot_name = robot_name or robot.name
        self.latency_s = latency_s
        self.record_steps = record_steps
        self.module = module
        self.config = config
        self.profile = profile or {}
        self.latches = latches
        self.contact = contact or Contact()
        self.log = logging.getLogger(f"cocoro.{name}")
        self.state: str = "starting"
        self.text = ""
        self.faults: tuple[str, ...] = ()
        self._health_hz = health_hz
        self._started_ns: int | None = None
        self._inboxes: dict[str, Inbox[Any]] = {}
        self._publishers: dict[str, Publisher[Any]] = {}
        self._meters: list[LoopMeter] = []
        self._handles: list[Handle] = []
        self._tasks: set[asyncio.Task[Any]] = set()
        self._watches = False
        self._process = None if isinstance(clock, VirtualClock) else ProcessMeter()

    # --- lifecycle --------------------------------------------------------------------------------

    async def __aenter__(self) -> Node:
        if isinstance(self.clock, FollowedClock) and not self.clock.driven:
            self.inbox(topics.CLOCK).judge = self._tick
        self.serve(topics.ABOUT.of(self.name), self._tell_about)
        self.spawn(self._tell_health())
        return self

    async def __aexit__(self, *_: object) -> None:
        self.state = "stopping"
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for handle in reversed(self._handles):
            handle.close()
        self._handles.clear()

    def ready(self, text: str = "") -> None:
        """Say that the service works from now on: declares its liveliness token."""
        if self.state == "starting":
            self._handles.append(self.bus.declare_alive(alive_key(self.robot_name, self.name)))
        self.state = "ready"
        self.text = text

    def degraded(self, text: str) -> None:
        """Say that it works, but not as it should."""
        if self.state == "starting":
            self.ready()
        self.state = "degraded"
        self.text = text

    def spawn(self, work: Coroutine[Any, Any, Any]) -> asyncio.Task[Any]:
        """Run something beside; it ends with the node. An exception in it is logged and degrades the node."""
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._spawn_ended)
        return task

    def _spawn_ended(self, task: asyncio.Task[Any]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            self.log.error("background work failed", exc_info=error)
            self.degraded(f"background work failed: {error}")

    def _tick(self, clock: Message) -> str:
        assert isinstance(self.clock, FollowedClock)
        return self.clock.tick(clock.stamp_ns, clock.incarnation, getattr(clock, "rate", 1.0))

    def drive_clock(self) -> FollowedClock:
        """The caller ticks this node's clock from now on, since it makes the time, or hears its key anyway."""
        assert isinstance(self.clock, FollowedClock)
        self.clock.driven = True
        inbox = self._inboxes.pop(topics.CLOCK.name, None)
        if inbox is not None and inbox.subscription is not None:
            self._handles.remove(inbox.subscription)
            inbox.subscription.close()
        return self.clock

    def sibling(self, name: str) -> Node:
        """Another service in this process, on the same bus and clock: the simulator stands in for four."""
        return Node(
            name, self.bus, self.clock, self.robot, robot_name=self.robot_name, health_hz=self._health_hz,
            module=self.module, config=self.config, profile=self.profile, latches=self.latches,
        )  # fmt: skip

    def keep(self, handle: Handle) -> None:
        """Close this when the node ends."""
        self._handles.append(handle)

    # --- reading ----------------------------------------------------------------------------------

    def inbox(self, topic: Topic[M], *, service: str | None = None) -> Inbox[M]:
        """The one inbox of a topic; `service='*'` reads a per-service topic of all services."""
        if service is not None:
            topic = topic.of(service)
        if topic.name not in self._inboxes:
            key = topic.key(self.robot_name)
            inbox = self._inboxes[topic.name] = Inbox(topic, key, self.clock)
            depth = 2 if topic.qos is Qos.FRAME else 256
            inbox.subscription = self.bus.subscribe(key, topic.qos, inbox.deliver, depth=depth)
            inbox.trouble.changed = self._readable_or_not
            self._handles.append(inbox.subscription)
        return self._inboxes[topic.name]

    def latest(self, topic: Topic[M], *, service: str | None = None) -> Latest[M]:
        return Latest(self.inbox(topic, service=service), self.clock)

    def stream(self, topic: Topic[M], *, service: str | None = None) -> Stream[M]:
        return Stream(self.inbox(topic, service=service))

    def on(self, topic: Topic[M], handler: Callable[[M], None], *, service: str | None = None) -> None:
        """Call `handler(message)` for each message."""
        self.inbox(topic, service=service).add(lambda _key, message: handler(message))

    def watch_alive(self, handler: Callable[[str, bool], None]) -> None:
        """Call `handler(service, alive)` as services of this robot come and go, at once for those that live. One that
        went need not be dead: `contact` tells more."""

        def tell(key: str, alive: bool) -> None:
            service = key.split("/")[1]
            if alive:
                self.contact.met(service)
            handler(service, alive)

        if self.contact.vigil is not None and not self._watches:
            self._watches = True
            self.spawn(self.contact.vigil.keep())
        self._handles.append(self.bus.watch_alive(alive_key(self.robot_name, "*"), tell))

    # --- publishing -------------------------------------------------------------------------------

    def publisher(self, topic: Topic[M]) -> Publisher[M]:
        if topic.name not in self._publishers:
            publisher = Publisher(topic, topic.key(self.robot_name), self.bus, self.clock)
            self._publishers[topic.name] = publisher
            self._handles.append(publisher)
        return self._publishers[topic.name]

    def publish(self, topic: Topic[M], message: M, stamp_ns: int | None = None) -> M:
        return self.publisher(topic).put(message, stamp_ns)

    # --- requests ---------------------------------------------------------------------------------

    async def call(self, request: Request[Q, R], question: Q, timeout_s: float | None = None) -> R:
        """Ask, and wait for the answer. Raises MeshError when nobody serves it (CallTimeoutError when nobody answers in
        time) and RemoteError with the server's own words when it answers with an error."""
        replies = await self._ask(request, question, timeout_s)
        if not replies:
            raise MeshError(f"nobody answers {request.key(self.robot_name)}: is {request.server} running?")
        return _understand(request, replies[0])

    async def call_all(self, request: Request[Q, R], question: Q, timeout_s: float | None = None) -> list[R]:
        """Ask all who serve it (a request with `*` in its name); the good answers."""
        return [_understand(request, reply) for reply in await self._ask(request, question, timeout_s) if reply.ok]

    async def _ask(self, request: Request[Q, R], question: Q, timeout_s: float | None) -> list[Reply]:
        payload = msgspec.msgpack.encode(question)
        wait_s = request.timeout_s if timeout_s is None else timeout_s
        return await self.bus.call(request.key(self.robot_name), payload, wait_s)

    def serve(self, request: Request[Q, R], handler: Callable[[Q], Awaitable[R]]) -> None:
        """Answer a request. A handler that raises CocoroError answers with its text. Question and answer are published
        too, for the record."""
        decoder = msgspec.msgpack.Decoder(request.request)

        async def answer(_key: str, payload: Payload) -> bytes:
            exchange = Exchange(request=request.name)
            started = time.perf_counter()
            try:
                exchange.question = question = _understood(decoder, payload, request)
                exchange.answer = given = await handler(question)
                return msgspec.msgpack.encode(given)
            except CocoroError as error:
                exchange.error = str(error)
                raise
            except Exception as error:
                self.log.exception("%s failed", request.name)
                exchange.error = f"{request.name}: internal error in {self.name}: {error}"
                raise CocoroError(exchange.error) from error
            finally:
                exchange.took_ms = 0.0 if self._process is None else (time.perf_counter() - started) * 1e3
                self.publish(EXCHANGES.of(self.name), exchange)

        self._handles.append(self.bus.serve(request.key(self.robot_name), answer))

    # --- time -------------------------------------------------------------------------------------

    def now_ns(self) -> int:
        return self.clock.now_ns()

    async def sleep(self, seconds: float) -> bool:
        return await clock_sleep(self.clock, seconds)

    def every(self, rate_hz: float, name: str = "loop") -> AsyncIterator[int]:
        """`async for now_ns in node.every(50.0)`: a fixed-rate loop whose jitter and overruns show in the health."""
        return every(self.clock, rate_hz, self.meter(name))

    def meter(self, name: str) -> LoopMeter:
        """Of a loop of this node's, which shows in its health."""
        meter = LoopMeter(name)
        self._meters.append(meter)
        return meter

    # --- driving a core ---------------------------------------------------------------------------

    async def drive(self, core: Core, name: str | None = None) -> None:
        """Step a pure core for ever: at its rate, and at once when a triggering topic arrives.

        An exception in the core ends the service: its state cannot be trusted any more, and the supervisor starts it
        afresh. The hardware stops by itself meanwhile.
        """
        await drive(self, core, name or self.name)

    def stepper(self, core: Core, name: str | None = None) -> Stepper:
        """What gathers a core's inputs, steps it and publishes, for those who drive it themselves."""
        return Stepper(self, core, name or self.name)

    # --- health -----------------------------------------------------------------------------------

    async def _tell_about(self, _: AboutRequest) -> AboutReply:
        return about(self)

    async def _tell_health(self) -> None:
        async for now_ns in every(self.clock, self._health_hz, LoopMeter("health")):
            self._started_ns = now_ns if self._started_ns is None else self._started_ns
            self.publish(HEALTH.of(self.name), self.health(now_ns, self._started_ns))

    def _readable_or_not(self) -> None:
        """What this service reads can be read no more, or again: who waits for it should know at once."""
        now_ns = self.clock.now_ns()
        self.publish(HEALTH.of(self.name), self.health(now_ns, self._started_ns or now_ns))

    def health(self, now_ns: int, started_ns: int) -> Health:
        ports: list[Inbox[Any] | Publisher[Any]] = [*self._inboxes.values(), *self._publishers.values()]
        cpu_share, rss_mb = self._process.take() if self._process else (0.0, 0.0)
        told = tuple(port.health(now_ns) for port in ports if port.topic.name != HEALTH.of(self.name).name)
        return Health(
            service=self.name,
            pid=os.getpid() if self._process else 0,
            state=self.state,  # type: ignore[arg-type] # one of the literals by construction
            text=self.text,
            uptime_s=(now_ns - started_ns) / NS,
            cpu_share=cpu_share,
            rss_mb=rss_mb,
            topics=told,
            loops=tuple(meter.health() for meter in self._meters),
            faults=(
                *self.faults,
                *(topic.fault for topic in told if topic.fault),
                *(port.trouble for port in self._publishers.values() if port.trouble),
            ),
        )


def _understood(decoder: msgspec.msgpack.Decoder[Q], payload: Payload, request: Request[Q, Any]) -> Q:
    if len(payload) > QUESTION_BYTES:
        raise CocoroError(f"{request.name}: a question of {len(payload)} bytes, at most {QUESTION_BYTES} are taken")
    try:
        return decoder.decode(payload)
    except (msgspec.MsgspecError, ValueError) as error:
        raise CocoroError(f"{request.name}: not a good {request.request.__name__}: {error}") from error


def _understand(request: Request[Q, R], reply: Reply) -> R:
    if not reply.ok:
        raise RemoteError(reply.payload.decode(errors="replace"))
    try:
        return msgspec.msgpack.decode(reply.payload, type=request.reply)
    except msgspec.MsgspecError as error:
        raise RemoteError(f"{reply.key} answered something that is not a {request.reply.__name__}: {error}") from error
