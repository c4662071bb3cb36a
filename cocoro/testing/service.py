"""One service on a mesh of its own."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import msgspec

from cocoro.bus.base import Handle
from cocoro.bus.local import LocalMesh
from cocoro.clock import NS, Clock, VirtualClock
from cocoro.component import Component, Implementation, load
from cocoro.keys import alive_key
from cocoro.messages import Message, TopicHealth
from cocoro.node import Node
from cocoro.robot import Robot
from cocoro.testing.mesh import NotedBus, Tap
from cocoro.testing.virtual import settle
from cocoro.topics import Request, Topic

M = TypeVar("M", bound=Message)
Q = TypeVar("Q", bound=msgspec.Struct)
R = TypeVar("R", bound=msgspec.Struct)


class ServiceUnderTest:
    """One component that runs on a mesh of its own. Use it as an asynchronous context manager, in virtual time."""

    def __init__(
        self,
        component: str | Component | Implementation[Any],
        config: Mapping[str, Any] | msgspec.Struct | None = None,
        *,
        name: str | None = None,
        robot: Robot | None = None,
        clock: Clock | None = None,
        mesh: LocalMesh | None = None,
        record_steps: bool = False,
        latches: Path | None = None,
    ) -> None:
        """`component` is a declaration, a module with an implementation ('services.planning.service'), or an
        implementation; `config` its settings, defaults where there are none. The service's name is the declared one,
        else that of the module's folder, unless one is given."""
        if isinstance(component, str):
            component = Component(name=name or _service_name(component), module=component, doc="Under test.")
        implementation = component if isinstance(component, Implementation) else load(component)
        module = component.run.__module__ if isinstance(component, Implementation) else component.module
        self.name = name or (component.name if isinstance(component, Component) else _service_name(module))
        self.robot = robot or Robot.load()
        self.mesh = mesh or LocalMesh()
        self._run = implementation.run
        if isinstance(config, msgspec.Struct):
            self._config = config
        else:
            self._config = msgspec.convert(config or {}, implementation.config)
        self._clock = clock or VirtualClock()
        self.bus = NotedBus(self.mesh, self.robot.name)
        """The bus of the service, for `misdeclared(component, service.bus)`."""
        self.node = Node(
            self.name, self.bus, self._clock, self.robot, record_steps=record_steps,
            module=module, config=self._config, latches=latches,
        )  # fmt: skip
        self.tester = Node("tester", self.mesh.join(), self._clock, self.robot)
        """Another participant of the mesh, for everything that this class has no method for."""
        self.tap = Tap(self.mesh.join(), self.robot.name)
        self._others: dict[str, Handle] = {}
        self._work: asyncio.Future[None] | None = None

    async def __aenter__(self) -> ServiceUnderTest:
        await self.tester.__aenter__()
        await self.node.__aenter__()
        self._work = asyncio.ensure_future(self._run(self.node, self._config))
        await self.settle()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._end()
        await self.node.__aexit__()
        await self.tester.__aexit__()

    # --- feeding ------------------------------------------------------------------------------------

    def feed(self, topic: Topic[M], message: M, stamp_ns: int | None = None) -> M:
        """Publish to the service; stamped with `stamp_ns`, else with the message's own stamp, else with now."""
        return self.tester.publish(topic, message, stamp_ns)

    def feed_raw(self, topic: Topic[Any], payload: bytes) -> None:
        """Publish bytes as they are, for example malformed ones."""
        self.mesh.publish(topic.key(self.robot.name), payload)

    async def ask(self, request: Request[Q, R], question: Q, timeout_s: float | None = None) -> R:
        """Call the service. Raises as `Node.call` does."""
        return await self.tester.call(request, question, timeout_s)

    def serve(self, request: Request[Q, R], handler: Callable[[Q], Awaitable[R]]) -> None:
        """Answer a request of the service."""
        self.tester.serve(request, handler)

    def others_live(self, *services: str) -> None:
        """Declare other services alive."""
        for service in services:
            self._others[service] = self.tester.bus.declare_alive(alive_key(self.robot.name, service))

    def other_dies(self, service: str) -> None:
        self._others.pop(service).close()

    # --- time ---------------------------------------------------------------------------------------

    async def settle(self) -> None:
        """Let the service read its input; no time passes. Raises what the service raised."""
        await settle()
        self._check()

    async def advance(self, seconds: float) -> None:
        """Let virtual time pass. Raises what the service raised meanwhile."""
        await asyncio.sleep(seconds)
        await self.settle()

    async def until(self, content: Callable[[], object], timeout_s: float = 60.0) -> None:
        """Let time pass until `content()` is true. Raises AssertionError when it is not after `timeout_s`."""
        end_ns = self.tester.now_ns() + round(timeout_s * NS)
        while not content():
            assert self.tester.now_ns() < end_ns, f"still not so after {timeout_s:g} s"
            await self.advance(0.01)

    # --- reading ------------------------------------------------------------------------------------

    def outputs(self, topic: Topic[M]) -> list[M]:
        """All messages that the service published on a topic since the start, or since `forget`."""
        mine = self.tester.publisher(topic).incarnation
        return [message for message in self.tap.messages(topic) if message.incarnation != mine]

    def latest(self, topic: Topic[M]) -> M:
        """The newest of `outputs`. Raises AssertionError when there is none."""
        outputs = self.outputs(topic)
        assert outputs, f"{self.name} has published nothing on {topic.name}"
        return outputs[-1]

    def forget(self) -> None:
        """Drop the outputs so far."""
        self.tap.forget()

    def received(self, topic: Topic[Any]) -> TopicHealth:
        """The service's counts of accepted, lost, skipped and rejected messages of a topic."""
        return self.node.inbox(topic).health(self.node.now_ns())

    @property
    def running(self) -> bool:
        return self._work is not None and not self._work.done()

    @property
    def alive(self) -> bool:
        """Whether it has declared its liveliness."""
        return self.mesh.tokens[alive_key(self.robot.name, self.name)] > 0

    # --- ending -------------------------------------------------------------------------------------

    async def kill(self) -> None:
        """End the service as SIGKILL does."""
        self.bus.kill()
        await self._end()

    async def _end(self) -> None:
        if self._work is not None:
            self._work.cancel()
            await asyncio.gather(self._work, return_exceptions=True)
            self._work = None

    def _check(self) -> None:
        if self._work is not None and self._work.done():
            self._work.result()
            raise AssertionError(f"{self.name} ended by itself, though a component runs for ever")


def _service_name(module: str) -> str:
    folders = module.split(".")
    return folders[-2] if folders[-1] == "service" and len(folders) > 1 else folders[-1]
