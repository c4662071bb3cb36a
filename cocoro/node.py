"""Node: the API that a component is written against.

    async with Node("planning", bus, clock, robot) as node:
        await node.drive(PlanningCore(...))

A node reads, calls and watches as every participant does. It also publishes, with stamp, sequence number and
incarnation filled in; serves typed requests; publishes its health once a second; and holds the service's liveliness
token.
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
from cocoro.bus.base import Bus, Handle, Payload
from cocoro.clock import NS, Clock
from cocoro.clock import sleep as clock_sleep
from cocoro.contact import Contact
from cocoro.core import Core
from cocoro.errors import CocoroError
from cocoro.health import LoopMeter, ProcessMeter
from cocoro.inbox import Inbox
from cocoro.keys import alive_key, recorder_key
from cocoro.messages import AboutReply, AboutRequest, Exchange, Health, Message
from cocoro.participant import Participant
from cocoro.publisher import Publisher
from cocoro.robot import Robot
from cocoro.stepper import Stepper, drive, every
from cocoro.topics import EXCHANGES, HEALTH, Request, Topic

M = TypeVar("M", bound=Message)
Q = TypeVar("Q", bound=msgspec.Struct)
R = TypeVar("R", bound=msgspec.Struct)

QUESTION_BYTES = 1024 * 1024
"""Upper bound of an encoded question; a larger one is refused without decoding."""
RECORDER_S = 5.0
"""How long a service whose steps are to be recorded waits for a recorder before its first step."""


class Node(Participant):
    """One service on the mesh. Use it as an asynchronous context manager."""

    def __init__(
        self,
        name: str,
        bus: Bus,
        clock: Clock,
        robot: Robot,
        *,
        robot_name: str | None = None,
        record_steps: bool = False,
        health_hz: float = 1.0,
        module: str = "",
        config: Any = None,
        profile: Mapping[str, Any] | None = None,
        latches: Path | None = None,
        contact: Contact | None = None,
    ) -> None:
        """`module` and `config` are those of the component that runs here; `about` reports them. `profile` is the
        resolved profile of the start, as data. `latches` is the folder of the emergency stop's records; without it
        nothing is kept on disk and the stop path is not listened to (a service in its own process has it). `contact`
        knows what became of services whose tokens dropped."""
        super().__init__(bus, clock, robot_name or robot.name)
        self.name = name
        self.robot = robot
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
        self._publishers: dict[str, Publisher[Any]] = {}
        self._meters: list[LoopMeter] = []
        self._tasks: set[asyncio.Task[Any]] = set()
        self._detects_sleep = False
        self._process = None if clock.virtual else ProcessMeter()

    # --- lifecycle --------------------------------------------------------------------------------

    async def __aenter__(self) -> Node:
        if self.clock.needs_ticks:
            self.inbox(topics.CLOCK).judge = self._tick
        self.serve(topics.ABOUT.of(self.name), self._serve_about)
        self.spawn(self._publish_health())
        return self

    async def __aexit__(self, *_: object) -> None:
        self.state = "stopping"
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self.close()

    def ready(self, text: str = "") -> None:
        """Reports that the service works from now on, and declares its liveliness token."""
        if self.state == "starting":
            self.keep(self.bus.declare_alive(alive_key(self.robot_name, self.name)))
        self.state = "ready"
        self.text = text

    def degraded(self, text: str) -> None:
        """Reports that the service works, but not as it should."""
        if self.state == "starting":
            self.ready()
        self.state = "degraded"
        self.text = text

    def spawn(self, work: Coroutine[Any, Any, Any]) -> asyncio.Task[Any]:
        """Runs a background task that ends with the node. An exception in it is logged and degrades the node."""
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
        return self.clock.tick(clock.stamp_ns, clock.incarnation, getattr(clock, "rate", 1.0))

    def drive_clock(self) -> Clock:
        """Returns the clock for the caller to tick, because it makes the time or receives the clock key anyway. The
        node no longer subscribes to that key."""
        self.clock.drive()
        self.drop(topics.CLOCK)
        return self.clock

    def sibling(self, name: str) -> Node:
        """Another service in this process, on the same bus and clock; a simulator stands in for several."""
        return Node(
            name, self.bus, self.clock, self.robot, robot_name=self.robot_name, health_hz=self._health_hz,
            module=self.module, config=self.config, profile=self.profile, latches=self.latches,
        )  # fmt: skip

    # --- reading (see Participant) ----------------------------------------------------------------

    def inbox(self, topic: Topic[M], *, service: str | None = None) -> Inbox[M]:
        inbox = super().inbox(topic, service=service)
        inbox.rejections.changed = self.report_health
        return inbox

    def watch_alive(self, handler: Callable[[str, bool], None], service: str = "*") -> Handle:
        if self.contact.keeps and not self._detects_sleep:
            self._detects_sleep = True
            self.spawn(self.contact.keep())

        def changed(name: str, alive: bool) -> None:
            if alive:
                self.contact.met(name)
            handler(name, alive)

        return super().watch_alive(changed, service)

    # --- publishing -------------------------------------------------------------------------------

    def publisher(self, topic: Topic[M]) -> Publisher[M]:
        if topic.name not in self._publishers:
            publisher = Publisher(topic, topic.key(self.robot_name), self.bus, self.clock)
            self._publishers[topic.name] = publisher
            self.keep(publisher)
            if topic.askable:
                self.keep(self.bus.serve(publisher.key, publisher.serve_newest))
        return self._publishers[topic.name]

    def publish(self, topic: Topic[M], message: M, stamp_ns: int | None = None) -> M:
        """Publishes a message; see `Publisher.put`."""
        return self.publisher(topic).put(message, stamp_ns)

    # --- serving ----------------------------------------------------------------------------------

    def serve(self, request: Request[Q, R], handler: Callable[[Q], Awaitable[R]]) -> None:
        """Answers a request. When the handler raises CocoroError, the caller gets its text. Question and answer are
        also published, for recorders, unless the request's row says otherwise."""
        decoder = msgspec.msgpack.Decoder(request.request)

        async def answer(_key: str, payload: Payload) -> bytes:
            exchange = Exchange(request=request.name)
            started = time.perf_counter()
            try:
                exchange.question = question = _decoded(decoder, payload, request)
                exchange.answer = reply = await handler(question)
                return msgspec.msgpack.encode(reply)
            except CocoroError as error:
                exchange.error = str(error)
                raise
            except Exception as error:
                self.log.exception("%s failed", request.name)
                exchange.error = f"{request.name}: internal error in {self.name}: {error}"
                raise CocoroError(exchange.error) from error
            finally:
                exchange.took_ms = 0.0 if self._process is None else (time.perf_counter() - started) * 1e3
                if request.recorded:
                    self.publish(EXCHANGES.of(self.name), exchange)

        self.keep(self.bus.serve(request.key(self.robot_name), answer))

    # --- time -------------------------------------------------------------------------------------

    def now_ns(self) -> int:
        return self.clock.now_ns()

    async def sleep(self, seconds: float) -> bool:
        """Waits by the node's clock; False when a new epoch began meanwhile."""
        return await clock_sleep(self.clock, seconds)

    def every(self, rate_hz: float, name: str = "loop") -> AsyncIterator[int]:
        """`async for now_ns in node.every(50.0)`: a fixed-rate loop; health reports its jitter and overruns."""
        return every(self.clock, rate_hz, self.meter(name))

    def meter(self, name: str) -> LoopMeter:
        """A meter for one loop of this node; health reports it."""
        meter = LoopMeter(name)
        self._meters.append(meter)
        return meter

    # --- driving a core ---------------------------------------------------------------------------

    async def drive(self, core: Core, name: str | None = None) -> None:
        """Steps a pure core for ever: at its rate, and as soon as a triggering topic arrives.

        An exception in the core ends the service, since the core's state cannot be trusted any more. The supervisor
        starts it anew; the hardware stops by itself meanwhile.
        """
        if self.record_steps:
            await self._until_recorded()
        step = self.stepper(core, name)
        meter = self.meter(name or self.name)
        self.ready()  # before the clock has started: its source (a replay, a restarted simulator) may come later
        await self.clock.wait_started()
        await drive(step, core.schedule, self.clock, meter)

    def stepper(self, core: Core, name: str | None = None) -> Stepper:
        """Collects a core's inputs, steps it and publishes; for callers that do not use `drive`."""
        return Stepper(self, core, name or self.name)

    async def _until_recorded(self) -> None:
        """Waits for a recorder, for at most `RECORDER_S`: a record of steps is complete only with the first one."""
        found = asyncio.Event()

        def on_token(_key: str, alive: bool) -> None:
            if alive:
                found.set()

        watch = self.bus.watch_alive(recorder_key(self.robot_name), on_token)
        try:
            async with asyncio.timeout(RECORDER_S):
                await found.wait()
        except TimeoutError:
            self.log.warning("steps are to be recorded, but there was no recorder within %g s", RECORDER_S)
        finally:
            watch.close()

    # --- health -----------------------------------------------------------------------------------

    def about(self) -> AboutReply:
        """Describes this service and its start."""
        return about(
            self.name, self.robot_name, self.robot, module=self.module, config=self.config,
            record_steps=self.record_steps, virtual=self.clock.virtual,
        )  # fmt: skip

    async def _serve_about(self, _: AboutRequest) -> AboutReply:
        return self.about()

    async def _publish_health(self) -> None:
        async for now_ns in every(self.clock, self._health_hz, LoopMeter("health")):
            self._started_ns = now_ns if self._started_ns is None else self._started_ns
            self.publish(HEALTH.of(self.name), self.health(now_ns, self._started_ns))

    def report_health(self) -> None:
        """Publishes the health now, besides once a second: for news that somebody waits for, such as that a topic
        became unreadable."""
        now_ns = self.clock.now_ns()
        self.publish(HEALTH.of(self.name), self.health(now_ns, self._started_ns or now_ns))

    def health(self, now_ns: int, started_ns: int) -> Health:
        ports: list[Inbox[Any] | Publisher[Any]] = [*self._inboxes.values(), *self._publishers.values()]
        cpu_share, rss_mb = self._process.take() if self._process else (0.0, 0.0)
        reports = tuple(port.health(now_ns) for port in ports if port.topic.name != HEALTH.of(self.name).name)
        return Health(
            service=self.name,
            pid=os.getpid() if self._process else 0,
            state=self.state,  # type: ignore[arg-type] # one of the literals by construction
            text=self.text,
            uptime_s=(now_ns - started_ns) / NS,
            cpu_share=cpu_share,
            rss_mb=rss_mb,
            topics=reports,
            loops=tuple(meter.health() for meter in self._meters),
            faults=(
                *self.faults,
                *(topic.fault for topic in reports if topic.fault),
                *(port.trouble for port in self._publishers.values() if port.trouble),
            ),
        )


def _decoded(decoder: msgspec.msgpack.Decoder[Q], payload: Payload, request: Request[Q, Any]) -> Q:
    if len(payload) > QUESTION_BYTES:
        raise CocoroError(f"{request.name}: a question of {len(payload)} bytes, at most {QUESTION_BYTES} are taken")
    try:
        return decoder.decode(payload)
    except (msgspec.MsgspecError, ValueError) as error:
        raise CocoroError(f"{request.name}: not a good {request.request.__name__}: {error}") from error
